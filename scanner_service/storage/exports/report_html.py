"""A report as one HTML file that needs nothing else: no script, no font, no picture from elsewhere; judges nothing."""

from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape

from scanner_service.rescan.region import Limit, RescanRegion
from scanner_service.storage.exports.density_png import density_png
from scanner_service.storage.exports.density_raster import judged
from scanner_service.storage.exports.density_scale import scale_of
from scanner_service.storage.exports.report_charts import chart, draw_coverage, draw_histogram, svg_of
from scanner_service.storage.exports.report_content import ReportContent, Verdictful, amount, shown

_PICTURE_DPI = 170
MOST_REGIONS = 200
HISTOGRAM = (
    "How many of the judged points have which density; what lies wholly below the requirement in orange. At the edge "
    "of the part a point has half a neighbourhood only, which is no reason to scan again."
)
AFTER = "Density of the surface seen from above, with the regions to scan again."
BEFORE = "After the first pass, on the same scale as the map at the beginning, which shows the end."
STAGES = "What was known when each pass was over: everything scanned up to then."
FATES = (
    "Regions that the first pass had left, and how many of their points were still wanting at the end. Up to 5 % is "
    "called resolved, half or more open."
)
REPEATABLE = (
    "The raw lines, played again by this software with these settings, give this verdict bit for bit: its hash is then "
    "the same."
)
_CSP = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
_STYLE = """
:root { color-scheme: light; --ink: #1d232b; --soft: #5b6572; --line: #d9dee4; --paper: #fff; --tint: #f4f6f8; }
* { box-sizing: border-box; }
body { margin: 0; background: #e9ecef; color: var(--ink);
  font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 44px 52px; background: var(--paper); }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 19px; margin: 40px 0 10px; padding-bottom: 5px; border-bottom: 2px solid var(--ink); }
h3 { font-size: 15px; margin: 20px 0 6px; }
p { margin: 6px 0; max-width: 76ch; } .soft { color: var(--soft); }
.headlines { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; margin: 22px 0; }
.headlines div { background: var(--tint); border-left: 4px solid #3b6ea5; padding: 10px 14px; }
.headlines b { display: block; font-size: 23px; line-height: 1.25; font-variant-numeric: tabular-nums; }
.headlines span { color: var(--soft); font-size: 13px; }
figure { margin: 12px 0; } img, svg { max-width: 100%; height: auto; display: block; }
figcaption { color: var(--soft); font-size: 13px; margin-top: 4px; }
table { border-collapse: collapse; width: 100%; font-size: 13.5px; font-variant-numeric: tabular-nums; margin: 8px 0; }
th { text-align: left; font-weight: 600; border-bottom: 1.5px solid var(--ink);
  padding: 5px 10px 5px 0; vertical-align: bottom; }
td { border-bottom: 1px solid var(--line); padding: 4px 10px 4px 0; vertical-align: top; overflow-wrap: anywhere; }
.n { text-align: right; white-space: nowrap; } .n + :not(.n) { padding-left: 14px; }
.rows td:first-child { color: var(--soft); width: 44%; }
.two { display: grid; grid-template-columns: 1fr 1fr; gap: 0 36px; } .two > section { min-width: 0; }
code { font: 12.5px ui-monospace, "DejaVu Sans Mono", monospace; overflow-wrap: anywhere; }
.warn { background: #fdf1e7; border-left: 4px solid #c2571a; padding: 8px 14px; }
@media (max-width: 720px) { main { padding: 24px 18px; } .two { grid-template-columns: 1fr; } }
@page { size: A4; margin: 15mm 14mm; }
@media print {
  body { background: none; font-size: 10pt; } main { max-width: none; padding: 0; } h2 { break-after: avoid; }
  figure, tr, .headlines { break-inside: avoid; } thead { display: table-header-group; } table { font-size: 8.5pt; } }
"""


def report_html(content: ReportContent) -> bytes:
    """The whole report as UTF-8 HTML; every text of a user is escaped."""
    parts = [
        f"<h1>{escape(content.title)}</h1>",
        f'<p class="soft">Scan report · session {escape(content.session_id)} · scanned {escape(content.created)} · '
        f"{escape(content.state)}</p>",
        _headlines(content.headlines),
        *_damage(content),
        "<h2>Density</h2>",
        _map(content, content.final, AFTER),
        _histogram(content),
        "<h2>Coverage, pass by pass</h2>",
        *_passes(content),
        "<h2>Regions to scan again</h2>",
        *_regions(content),
        *_before(content),
        "<h2>Losses</h2>",
        "<p>Every line and every point that came in, and what became of it.</p>",
        f'<div class="two">{"".join(_section(name, rows) for name, rows in content.losses)}</div>',
        "<h2>How it was found</h2>",
        f'<div class="two">{_section("Settings", content.settings)}{_section("In figures", content.facts)}</div>',
        "<h2>Where it comes from</h2>",
        _rows(
            [
                ("software", content.software),
                ("report written", content.written),
                ("SHA-256 of the raw lines", content.raw_sha256),
                ("SHA-256 of the verdict", content.verdict_sha256),
            ],
            code=True,
        ),
        f'<p class="soft">{escape(REPEATABLE)}</p>',
    ]
    head = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_CSP}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(content.title)} – scan report</title><style>{_STYLE}</style></head><body><main>\n"
    )
    return (head + "\n".join(parts) + "\n</main></body></html>\n").encode("utf-8", "replace")


def _headlines(items: Iterable[tuple[str, str]]) -> str:
    boxes = "".join(f"<div><b>{escape(value)}</b><span>{escape(name)}</span></div>" for name, value in items)
    return f'<div class="headlines">{boxes}</div>'


def _damage(content: ReportContent) -> list[str]:
    if not content.damaged:
        return []
    listed = "; ".join(escape(text) for text in content.damaged[:5])
    count = len(content.damaged)
    return [
        f'<p class="warn">{count} stored line{"s" if count > 1 else ""} cannot be read and are left out: {listed}</p>'
    ]


def map_png(content: ReportContent, found: Verdictful, dpi: int) -> bytes:
    """The density map of one moment, on the scale that all maps share; regions of the first pass have letters."""
    return density_png(
        found.snapshot,
        found.report.regions,
        session_name="",
        coverage=found.coverage.share,
        required_per_mm2=content.required_per_mm2,
        scale=scale_of(
            content.final.snapshot.density_per_mm2[judged(content.final.snapshot)], content.required_per_mm2
        ),
        dpi=dpi,
        lettered=found is content.first,
    )


def _map(content: ReportContent, found: Verdictful, caption: str) -> str:
    data = b64encode(map_png(content, found, _PICTURE_DPI)).decode("ascii")
    text = escape(caption)
    return f'<figure><img alt="{text}" src="data:image/png;base64,{data}"><figcaption>{text}</figcaption></figure>'


def _histogram(content: ReportContent) -> str:
    figure, axes = chart(10.2, 3.0)
    draw_histogram(axes, content.final.snapshot, content.required_per_mm2)
    return (
        f'<figure role="img" aria-label="Histogram of density">{svg_of(figure)}'
        f"<figcaption>{escape(HISTOGRAM)}</figcaption></figure>"
    )


def _passes(content: ReportContent) -> list[str]:
    parts = []
    if len(content.passes) > 1:
        figure, axes = chart(10.2, 3.0)
        draw_coverage(axes, content.passes)
        parts.append(
            f'<figure role="img" aria-label="Coverage after each pass">{svg_of(figure)}'
            f"<figcaption>{escape(STAGES)}</figcaption></figure>"
        )
    if content.pass_ends > len(content.passes):
        parts.append(f"<p>{content.pass_ends} passes ended; {len(content.passes)} of them are shown.</p>")
    heads = ("after", "lines", "points", "coverage", "surface mm²", "gaps mm²", "regions", "to scan again mm²")
    rows = [
        (row.name, shown(row.lines), shown(row.points), percent(row.coverage), amount(row.touched_mm2),
         amount(row.gap_mm2, 1), shown(row.regions), amount(row.region_mm2, 1))
        for row in content.passes
    ]  # fmt: skip
    return [*parts, _table(heads, rows, numbers=range(1, 8))]


def _regions(content: ReportContent) -> list[str]:
    regions = content.final.report.regions
    if not regions:
        return ["<p>None: what was seen meets the requirement.</p>"]
    heads = ("#", "reason", "remedy", "area mm²", "measured", "required", "priority", "at x, y, z mm")
    rows = [region_row(region) for region in regions[:MOST_REGIONS]]
    parts = [_table(heads, rows, numbers=(0, 3, 4, 5, 6))]
    if len(regions) > MOST_REGIONS:
        parts.append(f"<p>The first {MOST_REGIONS} of {len(regions)} regions; regions.json lists all.</p>")
    return parts


def _before(content: ReportContent) -> list[str]:
    """What the passes after the first have done for the regions that the first had left."""
    if content.first is None:
        return ['<p class="soft">There was one pass, so there is no before and after.</p>']
    parts = [
        "<h2>Before and after</h2>",
        f"<p>{escape(FATES)}</p>",
        _map(content, content.first, BEFORE),
    ]
    if not content.fates:
        return [*parts, "<p>The first pass had left none.</p>"]
    rows = [
        (fate.name, fate.reason, amount(fate.area_mm2, 1), percent(fate.left_share), fate.outcome)
        for fate in content.fates[:MOST_REGIONS]
    ]
    parts.append(_table(("in the map above", "reason", "area mm²", "still wanting", "outcome"), rows, numbers=(2, 3)))
    return parts


def region_row(region: RescanRegion) -> tuple[str, ...]:
    """A rescan region as the cells of a table."""
    told = region.to_dict()
    where = ", ".join(f"{value:.1f}" for value in region.centroid_mm)
    limit = region.limit or Limit("density", region.measured_per_mm2, region.required_per_mm2, "points/mm²")
    return (
        str(told["number"]),
        str(told["reason"]).replace("_", " "),
        str(told["remedy"]),
        amount(region.area_mm2, 1),
        limit.has,
        limit.needs,
        f"{region.priority:.2f}",
        where,
    )


def percent(share: float) -> str:
    """A share from 0 to 1."""
    return "unknown" if share != share else f"{100 * share:.1f} %"  # noqa: PLR0124 - NaN


def _section(name: str, rows: Sequence[tuple[str, str]]) -> str:
    return f"<section><h3>{escape(name)}</h3>{_rows(rows)}</section>"


def _rows(rows: Iterable[tuple[str, str]], code: bool = False) -> str:
    cells = "".join(
        f"<tr><td>{escape(name)}</td><td>{f'<code>{escape(value)}</code>' if code else escape(value)}</td></tr>"
        for name, value in rows
    )
    return f'<table class="rows"><tbody>{cells}</tbody></table>'


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: Iterable[int]) -> str:
    right = frozenset(numbers)

    def cell(tag: str, place: int, text: str) -> str:
        return f"<{tag}{' class=n' if place in right else ''}>{escape(text)}</{tag}>"

    head = "".join(cell("th", place, text) for place, text in enumerate(heads))
    body = "".join(f"<tr>{''.join(cell('td', place, text) for place, text in enumerate(row))}</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
