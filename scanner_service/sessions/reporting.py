"""What the report of a session says: gathers it from the rebuilt session; draws and lays out nothing."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from functools import reduce
from typing import Any

from scanner_service.analysis.passes import PassKey
from scanner_service.sessions.fingerprint import verdict_sha256
from scanner_service.sessions.results import Results, summarise
from scanner_service.sessions.stored import Stage, StoredSession
from scanner_service.sessions.wires import joined
from scanner_service.storage.exports.letters import letters_of
from scanner_service.storage.exports.report_content import (
    FateRow,
    PassRow,
    ReportContent,
    Verdictful,
    amount,
    flat_rows,
    shown,
)


def report_of(stored: StoredSession, now: datetime) -> ReportContent:
    """The content of the report of a session that was read with its stages."""
    results = stored.results
    summary = summarise(results, stored.losses, math.nan, stored.about.version)
    regions = results.regions
    area = sum(region.area_mm2 for region in regions)
    share = results.coverage.share
    return ReportContent(
        title=stored.row.name or stored.row.session_id,
        session_id=stored.row.session_id,
        state=stored.row.state,
        created=stored.row.created_utc[:16].replace("T", " ") + " UTC",
        written=now.isoformat(timespec="seconds").replace("+00:00", "Z"),
        software=stored.about.software,
        raw_sha256=stored.raw_sha256,
        verdict_sha256=verdict_sha256(results),
        final=_verdictful(results),
        first=None if stored.first is None else _verdictful(stored.first),
        passes=tuple(_pass_row(number, stage) for number, stage in enumerate(stored.stages, start=1)),
        pass_ends=stored.pass_ends,
        fates=fates_of(stored.first, results) if stored.first is not None else (),
        required_per_mm2=results.typical_required_per_mm2,
        headlines=(
            *_nominal(results),
            ("observed coverage", _percent(share)),
            ("points", shown(summary["points"])),
            ("scanlines", shown(summary["scanlines"])),
            ("regions to scan again", shown(len(regions))),
            ("their area", f"{amount(area)} mm²"),
        ),
        facts=_facts(summary),
        losses=_losses(stored.losses),
        settings=tuple(_settings(stored.row.settings)),
        damaged=stored.damaged,
    )


def fates_of(first: Results, last: Results) -> tuple[FateRow, ...]:
    """What became of each region of the first pass. Rows of a map stay what they are, so its points are found again."""
    return tuple(
        FateRow(
            letters_of(region.number),
            region.reason.label.replace("_", " "),
            region.area_mm2,
            float(last.report.rescan[region.point_rows].mean()) if len(region.point_rows) else 0.0,
        )
        for region in first.regions
    )


def _verdictful(results: Results) -> Verdictful:
    return Verdictful(results.snapshot, replace(results.report, regions=results.regions), results.coverage)


def _nominal(results: Results) -> tuple[tuple[str, str], ...]:
    """The coverage of the nominal part, where there is one, or why it is not told."""
    if results.reference is not None:
        return (("coverage of the nominal part", _percent(results.reference.share)),)
    return () if results.reference_refused is None else (("coverage of the nominal part", results.reference_refused),)


def _percent(share: float) -> str:
    return "unknown" if math.isnan(share) else f"{100 * share:.1f} %"


def _pass_row(number: int, stage: Stage) -> PassRow:
    return PassRow(
        name=", ".join(_pass_name(key) for key in stage.passes) or f"stage {number}",
        lines=stage.lines,
        points=stage.points,
        coverage=stage.coverage,
        touched_mm2=stage.touched_mm2,
        gap_mm2=stage.gap_mm2,
        regions=stage.regions,
        region_mm2=stage.region_mm2,
    )


def _pass_name(key: PassKey) -> str:
    return f"{key[0]} pass {key[2]}"


def _facts(summary: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """The summary's own figures, spreads as smallest – median – largest."""
    rows = []
    for name, unit in (("line_spacing_mm", "mm"), ("point_spacing_mm", "mm"), ("radius_mm", "mm"),
                       ("density_per_mm2", "points/mm²")):  # fmt: skip
        spread = summary[name]
        values = " – ".join(f"{spread[part]:.4g}" for part in ("min", "median", "max"))
        label = name.removesuffix("_mm").removesuffix("_per_mm2").replace("_", " ")
        rows.append((f"{label}, smallest – median – largest", f"{values} {unit}"))
    rows.append(("points with a reliable normal", f"{100 * summary['reliable_share']:.1f} %"))
    rows.append(("points that are settled", f"{100 * summary['settled_share']:.1f} %"))
    rows.append(("isolated points", shown(summary["isolated"])))
    rows += [(f"radius by {rule.replace('_', ' ')}", shown(count)) for rule, count in summary["radius_rules"].items()]
    rows += [
        (f"no normal: {reason.replace('_', ' ')}", shown(count))
        for reason, count in summary["unreliable"].items()
        if count
    ]
    return tuple(rows)


def _losses(losses: Mapping[str, Any]) -> tuple[tuple[str, tuple[tuple[str, str], ...]], ...]:
    names = {
        "lines": "Lines, as they came in",
        "points": "Places in the lines",
        "device": "Scanner and wire, all passes",
    }
    groups = []
    for key, value in losses.items():
        if isinstance(value, Mapping):
            rows = flat_rows({name: value[name] for name in sorted(value, key=_in_order)})
            groups.append((names.get(key, key.replace("_", " ")), tuple(rows)))
    passes = losses.get("passes") or ()
    if passes:
        groups.append(("Scanlines of each pass, from the scanner to the record", tuple(_rows_of_passes(passes))))
    return tuple(groups)


def _rows_of_passes(passes: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    """Lines, and chunks where there are any, of each pass, then of all of them."""
    boots = {device: {told["boot_id"] for told in passes if told["device_id"] == device} for device in
             {told["device_id"] for told in passes}}  # fmt: skip
    for told in passes:
        name = f"{told['device_id']} pass {told['pass_index']}"
        if len(boots[told["device_id"]]) > 1:  # each boot counts its passes anew
            name += f", boot {told['boot_id']}"
        yield from _rows_of_pass(name, told["lines"], told["chunks"])
    if len(passes) > 1:
        lines, chunks = (reduce(joined, [told[of] for told in passes]) for of in ("lines", "chunks"))
        yield from _rows_of_pass("all passes", lines, chunks)


def _rows_of_pass(name: str, lines: Mapping[str, Any], chunks: Mapping[str, Any] | None) -> Iterator[tuple[str, str]]:
    words = {"partial": "of them partial", "under_way": "under way", "duplicates": "came twice"}
    more = [f"{shown(lines[what])} {said}" for what, said in words.items() if lines[what]]
    yield name, _balance(lines, more)
    if chunks is not None:
        yield f"{name}, chunks", _balance(chunks, [])


def _balance(account: Mapping[str, Any], more: list[str]) -> str:
    lost = [f"{shown(count)} {reason.replace('_', ' ')}" for reason, count in account["lost"].items() if count]
    parts = [f"{shown(account['sent'])} sent, {shown(account['stored'])} stored", *more]
    return ", ".join(parts) + "; lost: " + (", ".join(lost) or "none")


def _in_order(name: str) -> tuple[int, str]:
    """Accounts are read from what came in to what is missing."""
    order = ("received", "places", "sent", "stored", "counted", "pending", "duplicates", "conflicts")
    return (order.index(name) if name in order else len(order), name)


def _settings(values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Each setting in a row of its own; of what is asked for, only what is."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _settings({inner: told for inner, told in value.items() if told is not None})
        else:
            yield _setting(name, value)


def _setting(name: str, value: Any) -> tuple[str, str]:
    """A setting with its unit behind the value; angles in degrees, as users give them."""
    for ending, unit, factor in (("_per_mm2", "points/mm²", 1.0), ("_mm", "mm", 1.0), ("_rad", "°", 180 / math.pi)):
        if name.endswith(ending):
            told = "by the rule" if value is None else f"{factor * value:.6g} {unit}"
            return name.removesuffix(ending).replace("_", " "), told
    return name.replace("_", " "), shown(value)
