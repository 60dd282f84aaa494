"""The picture of a density map (PNG): what a person looks at before the part leaves the fixture; judges nothing.

Only matplotlib's objects are used, on the Agg canvas: no global state, so several threads may draw at once.
"""

import textwrap
from collections.abc import Callable, Sequence
from functools import cache
from io import BytesIO
from typing import Any, Literal, Protocol

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from drivers.scanline import Float64Array
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.storage.exports.density_raster import DensityRaster, View, judged, rasterise, view_along
from scanner_service.storage.exports.density_scale import DensityScale, scale_of
from scanner_service.storage.exports.label_places import label_places, pointed_at
from scanner_service.storage.exports.letters import letters_of

Colours = Literal["viridis", "blue-red"]

_FONT = "DejaVu Sans"
_NOT_JUDGED = "#9d9d9d"
_PAPER = "#f6f6f4"
_INK = "#222222"
_DOWN = np.array([0.0, 0.0, -1.0])
_PIXELS = 900
_LABELS = 24
"""So many regions are named, the most urgent ones; more than that nobody can read, and the others are drawn thinner."""
_LEAST_REACHES = 12.0
"""The picture is at least so many times as wide and high as the reach of one point."""

# Dense is blue and sparse is red, by way of yellow and not of plain green, which some cannot tell from red.
_BLUE_RED = LinearSegmentedColormap.from_list(
    "blue-red", ["#b2182b", "#ef6548", "#fdd870", "#c7e9b4", "#67a9cf", "#2166ac", "#08306b"]
)
_STYLES: dict[str, tuple[float, tuple[float, ...]]] = {
    "steep": (0, ()),
    "sparse": (0, (6, 2)),
    "shadow": (0, (1.2, 1.4)),
    "out_of_range": (0, (7, 2, 1.2, 2)),
    "lost_lines": (0, (7, 2, 1.2, 2, 1.2, 2)),
    "noisy": (0, (3, 1.2)),
    "isolated": (0, (1, 3)),
    "untouched": (0, (9, 2, 2, 2)),
}
_OTHER_STYLE = (0.0, (10.0, 3.0))


class OutlinedRegion(Protocol):
    """What the picture needs of a rescan region: its number, its reason and closed loops of (k, 3) points."""

    @property
    def number(self) -> int:
        """The number by which everybody calls the region."""

    @property
    def reason(self) -> object:
        """Why: a text, or anything with a text as its `label`."""

    @property
    def outline_mm(self) -> Sequence[Float64Array]:
        """Closed loops; the last point is not repeated."""


def density_figure(
    snapshot: MapSnapshot,
    regions: Sequence[OutlinedRegion] = (),
    *,
    session_name: str,
    when: str = "",
    coverage: float = float("nan"),
    required_per_mm2: float = float("nan"),
    direction: Float64Array = _DOWN,
    colours: Colours = "viridis",
    dpi: int = 150,
    scale: DensityScale | None = None,
    lettered: bool = False,
) -> Figure:
    """Draw the density of the surface seen along `direction`; at most 11 inches wide and 8.25 high, at `dpi`.

    The scale is absolute, in points per mm², over most of the judged points, with what is required in the middle of the
    colours. Points that are not reliable or not settled are grey. Regions, the most urgent first, are outlined with a
    line style for each reason, and the first twenty-four are numbered.

    Parameters
    ----------
    coverage : share of the surface that meets the requirement, 0 to 1; NaN if unknown.
    required_per_mm2 : marked on the scale, and in the middle of its colours; NaN if unknown.
    direction : (3,) the way the eye looks, part frame; down z by default: x to the right, y up.
    colours : "viridis", or "blue-red" (blue dense, red sparse).
    scale : of two pictures that are to be compared; None takes it from the data.
    lettered : call regions A, B, … for 1, 2, …, beside another picture whose numbers are of other regions.

    Raises
    ------
    ValueError : a direction without length, or unknown colours.
    """
    if colours not in ("viridis", "blue-red"):
        raise ValueError(f"colours are viridis or blue-red, not {colours!r}")
    view = view_along(direction)
    raster = rasterise(snapshot, view, _PIXELS) if len(snapshot) else None
    figure = Figure(figsize=_size_inches(raster), dpi=dpi, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)  # makes itself the figure's canvas
    grid = figure.add_gridspec(1, 2, width_ratios=[1, 0.11])
    part, bar = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1])
    _title(figure, session_name, when, coverage, snapshot)
    _frame(part, view)
    colour_map: Colormap = _BLUE_RED if colours == "blue-red" else colormaps["viridis"]
    densities = snapshot.density_per_mm2[judged(snapshot)]
    scale = scale_of(densities, required_per_mm2) if scale is None else scale
    if raster is not None:
        _surface(part, raster, colour_map, scale)
        shown = _outlines(part, regions, view)
        _labels(part, regions, view, letters_of if lettered else str)
        _legend(figure, raster, shown, regions)
    else:
        part.text(0.5, 0.5, "no points yet", transform=part.transAxes, ha="center", color=_INK, fontsize=14)
        part.set_xticks([])
        part.set_yticks([])
    if len(densities):
        _bar(bar, densities, colour_map, scale, required_per_mm2)
    else:
        bar.set_axis_off()  # a scale of which nothing has a colour
    return figure


def _size_inches(raster: DensityRaster | None) -> tuple[float, float]:
    """Width and height of a picture about what is drawn, with room for title, legend and scale."""
    if raster is None:
        return 7.0, 4.2
    left, right, bottom, upper = _frame_mm(raster)
    ratio = (right - left) / (upper - bottom)
    return float(np.clip(6.5 * ratio + 2.7, 6.5, 11.0)), float(np.clip(8.3 / ratio + 1.7, 3.9, 8.25))


def _frame_mm(raster: DensityRaster) -> tuple[float, float, float, float]:
    """Left, right, bottom and top of what is drawn: the surface and a margin; a few points stay small in it."""
    left, right, bottom, upper = raster.extent_mm
    margin = 0.03 * max(right - left, upper - bottom)
    wide, tall = (
        max(0.5 * size + margin, 0.5 * _LEAST_REACHES * raster.reach_mm) for size in (right - left, upper - bottom)
    )
    x, y = 0.5 * (left + right), 0.5 * (bottom + upper)
    return x - wide, x + wide, y - tall, y + tall


def density_png(
    snapshot: MapSnapshot, regions: Sequence[OutlinedRegion] = (), *, session_name: str, **options: Any
) -> bytes:
    """The picture of `density_figure` as a PNG; takes what that takes and raises what that raises."""
    figure = density_figure(snapshot, regions, session_name=session_name, **options)
    picture = BytesIO()
    figure.savefig(picture, format="png", metadata={"Title": drawable(session_name), "Software": "scanner-service"})
    return picture.getvalue()


def _title(figure: Figure, session_name: str, when: str, coverage: float, snapshot: MapSnapshot) -> None:
    points = f"{len(snapshot):,} points".replace(",", "\u202f")
    scanlines = f"{len(snapshot.lines):,} scanlines".replace(",", "\u202f")
    facts = [points if len(snapshot.lines) == 1 else f"{points} in {scanlines}"]
    if np.isfinite(coverage):
        facts.insert(0, f"observed coverage {100 * coverage:.1f} %")
    if when:
        facts.append(when)
    lines = textwrap.wrap(drawable(session_name), int(7.5 * figure.get_figwidth()), max_lines=2, placeholder=" …")
    title = figure.suptitle("\n".join(lines), fontsize=15, fontweight="bold", color=_INK, fontfamily=_FONT)
    title.set_parse_math(False)
    second = figure.axes[0].set_title(drawable("  ·  ".join(facts)), fontsize=10, color="#555555", fontfamily=_FONT)
    second.set_parse_math(False)


def _frame(axes: Axes, view: View) -> None:
    axes.set_facecolor(_PAPER)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel(f"{_axis_name(view.right, 'right')} (mm)", color=_INK)
    axes.set_ylabel(f"{_axis_name(view.up, 'up')} (mm)", color=_INK)
    axes.grid(True, color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(colors="#555555", labelsize=9)
    for side in axes.spines.values():
        side.set_color("#bbbbbb")


def _axis_name(direction: Float64Array, otherwise: str) -> str:
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < 1 - 1e-9:
        return otherwise
    return ("" if direction[axis] > 0 else "-") + "xyz"[axis]


def _surface(axes: Axes, raster: DensityRaster, colour_map: Colormap, scale: DensityScale) -> None:
    colours = colour_map(scale.share(np.nan_to_num(raster.density_per_mm2)))
    colours[np.isnan(raster.density_per_mm2)] = _rgba(_NOT_JUDGED)
    colours[~raster.seen] = 0
    left, right, bottom, upper = raster.extent_mm
    axes.imshow(
        (255 * colours).astype(np.uint8),
        origin="lower",
        extent=(left, right, bottom, upper),
        interpolation="nearest",
        zorder=2,
    )
    frame = _frame_mm(raster)
    axes.set_xlim(frame[:2])
    axes.set_ylim(frame[2:])


def _rgba(colour: str) -> tuple[float, float, float, float]:
    return (*(int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)), 1.0)  # type: ignore[return-value]


def _outlines(axes: Axes, regions: Sequence[OutlinedRegion], view: View) -> dict[str, int]:
    """Draw the regions' outlines; how many regions there are of each reason."""
    counts: dict[str, int] = {}
    for rank, region in enumerate(regions):
        width = 1.3 if rank < _LABELS else 0.7
        reason = _reason(region)
        counts[reason] = counts.get(reason, 0) + 1
        for loop in _loops(region):
            closed = np.concatenate([loop, loop[:1]])
            axes.plot(
                closed @ view.right,
                closed @ view.up,
                color="black",
                linewidth=width,
                linestyle=_STYLES.get(reason, _OTHER_STYLE),
                path_effects=[withStroke(linewidth=2.5 * width, foreground="white")],
                zorder=4 - 0.001 * rank,
            )
    return counts


def _labels(axes: Axes, regions: Sequence[OutlinedRegion], view: View, name: Callable[[int], str]) -> None:
    """Name the first regions beside their longest outline, with a line to it."""
    named = [(region.number, loops[0]) for region in regions if (loops := _loops(region))][:_LABELS]
    flat = [np.stack([loop @ view.right, loop @ view.up], axis=1) for _, loop in named]
    boxes = [(loop.min(axis=0), loop.max(axis=0)) for loop in flat]
    span = axes.get_xlim()[1] - axes.get_xlim()[0]
    tall = axes.get_ylim()[1] - axes.get_ylim()[0]
    size = max(span, tall) * 0.030
    middles = [pointed_at(loop) for loop in flat]
    halves = [(float(high[0] - low[0]) / 2, float(high[1] - low[1]) / 2) for low, high in boxes]
    places = label_places(middles, halves, (size, 0.8 * size))
    for (number, _), place, middle in zip(named, places, middles, strict=True):
        axes.plot([middle[0], place[0]], [middle[1], place[1]], color="black", linewidth=0.7, zorder=4.5)
        axes.text(
            float(place[0]),
            float(place[1]),
            name(number),
            fontsize=9,
            fontweight="bold",
            ha="center",
            va="center",
            color="black",
            bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "black", "linewidth": 0.7},
            zorder=5,
        )


def _loops(region: OutlinedRegion) -> list[Float64Array]:
    """The region's loops that have points, the last not repeated."""
    loops = (np.asarray(loop, dtype=np.float64).reshape(-1, 3) for loop in region.outline_mm)
    return [loop for loop in loops if len(loop)]


def _reason(region: OutlinedRegion) -> str:
    return str(getattr(region.reason, "label", region.reason))


def _legend(figure: Figure, raster: DensityRaster, shown: dict[str, int], regions: Sequence[OutlinedRegion]) -> None:
    keys: list[Line2D | Patch] = [Patch(facecolor=_NOT_JUDGED, label="not judged (unreliable or not settled)")]
    for reason, count in shown.items():
        style = _STYLES.get(reason, _OTHER_STYLE)
        label = drawable(f"{reason.replace('_', ' ')}: {count} region{'s' if count > 1 else ''}")
        keys.append(Line2D([], [], color="black", linewidth=1.4, linestyle=style, label=label))
    legend = figure.legend(
        handles=keys,
        loc="outside lower center",
        ncols=min(len(keys), 4 if figure.get_figwidth() > 9.0 else 2),
        frameon=False,
        fontsize=9,
        handlelength=3.4,
        labelcolor=_INK,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)
    remark = f"pixel {raster.pixel_mm:.2g} mm; each shows points within {raster.reach_mm:.2g} mm"
    if len(regions) > _LABELS:
        others = len(regions) - _LABELS
        remark += f"; of {len(regions)} regions the {_LABELS} most urgent are named, the {others} others drawn thinner"
    legend.set_title(remark, prop=FontProperties(size=7))
    legend.get_title().set_color("#777777")


def _bar(axes: Axes, densities: Float64Array, colour_map: Colormap, scale: DensityScale, required: float) -> None:
    """The colour bar, and beside it how many points have which density."""
    bottom, top = scale.bottom, scale.top
    steps = np.linspace(bottom, top, 512)
    axes.imshow(
        colour_map(scale.share(steps))[:, None], origin="lower", extent=(0, 0.35, bottom, top), aspect="auto", zorder=2
    )
    edges = np.linspace(bottom, top, 41)
    share, _ = np.histogram(np.clip(densities, bottom, top), edges)
    if share.any():
        axes.barh(
            edges[:-1], 0.6 * share / share.max(), np.diff(edges), left=0.4, align="edge", color="#8a8a8a", zorder=2
        )
    if np.isfinite(required):
        axes.axhline(required, color="black", linewidth=1.4, path_effects=[withStroke(linewidth=3, foreground="white")])
        axes.text(1.06, required, f"required\n{required:.3g}", fontsize=8, va="center", ha="left", color=_INK)
    for beyond, end, sign, side in ((densities < bottom, bottom, "≤", "top"), (densities > top, top, "≥", "bottom")):
        if beyond.any():
            axes.annotate(
                f"{sign} {end:g}",
                (0.175, end),
                (0, -3 if side == "top" else 3),
                textcoords="offset points",
                fontsize=8,
                ha="center",
                va=side,
                color=_INK,
                annotation_clip=False,
            )
    axes.set_xlim(0, 1.02)
    axes.set_ylim(bottom, top)
    axes.set_xticks([])
    axes.set_ylabel("density (points/mm²), bars: how many points", color=_INK)
    axes.yaxis.set_label_position("left")
    axes.tick_params(colors="#555555", labelsize=9)
    for side_line in axes.spines.values():
        side_line.set_visible(False)


@cache
def _glyphs() -> frozenset[int]:
    return frozenset(get_font(findfont(_FONT)).get_charmap())


def drawable(text: str) -> str:
    """Text with a replacement sign for what the font cannot draw, on one line."""
    return "".join(sign if ord(sign) in _glyphs() else "\ufffd" for sign in " ".join(text.split()))
