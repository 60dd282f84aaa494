"""What a session has found out at one moment: map, verdict, coverage; knows no thread and no device."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.scanline import BoolArray, Float64Array, SensorGeometry
from scanner_service.analysis.snapshot import MapSnapshot, RadiusRule, UInt8Array, Unreliable
from scanner_service.rescan.coverage import Coverage, observed_coverage
from scanner_service.rescan.regions import RegionReport, find_regions
from scanner_service.rescan.requirement import Requirement


@dataclass(frozen=True, slots=True)
class Verdict:
    """What was said of the points of a snapshot: (n,) rescan or not, and the number of the reason."""

    rescan: BoolArray
    reason: UInt8Array


@dataclass(frozen=True, slots=True)
class Results:
    """A snapshot, judged."""

    snapshot: MapSnapshot
    report: RegionReport
    coverage: Coverage

    @property
    def verdict(self) -> Verdict:
        """The verdict on every point."""
        return Verdict(self.report.rescan, self.report.reason)


def judge(
    snapshot: MapSnapshot,
    requirement: Requirement,
    geometry: SensorGeometry | None = None,
    towards_sensor: Float64Array | None = None,
) -> Results:
    """Find the rescan regions and the coverage of a snapshot; the last two as `find_regions` has them."""
    report = find_regions(snapshot, requirement, geometry, towards_sensor=towards_sensor)
    return Results(snapshot, report, observed_coverage(snapshot, report))


def summarise(
    results: Results,
    losses: Mapping[str, Any],
    points_per_s: float,
    version: str,
    notes: tuple[str, ...] = (),
) -> dict[str, Any]:
    """The content of summary.json: lengths in millimetres, densities in points/mm2, NaN for what is not known."""
    snapshot, report, coverage = results.snapshot, results.report, results.coverage
    return _of_points(snapshot, losses, version, notes) | {
        "scanlines": len(snapshot.lines),
        "line_spacing_mm": _spread(snapshot.lines.line_spacing_mm),
        "point_spacing_mm": _spread(snapshot.lines.point_spacing_mm),
        "coverage": {
            "kind": "observed",
            "share": coverage.share,
            "cell_mm": coverage.cell_mm,
            "gap_mm2": coverage.gap_mm2,
        },
        "regions": {
            "count": len(report.regions),
            "area_mm2": float(sum(region.area_mm2 for region in report.regions)),
            "by_reason": _areas(report),
        },
        "points_per_s": points_per_s,
    }


def summarise_cloud(
    snapshot: MapSnapshot, losses: Mapping[str, Any], version: str, notes: tuple[str, ...]
) -> dict[str, Any]:
    """The content of summary.json for a plain cloud: nothing that needs scanlines."""
    return _of_points(snapshot, losses, version, notes)


def _of_points(
    snapshot: MapSnapshot, losses: Mapping[str, Any], version: str, notes: tuple[str, ...]
) -> dict[str, Any]:
    """What is said of the points alone."""
    counted = snapshot.unreliable != Unreliable.NOT_COUNTED
    reliable = snapshot.reliable
    return {
        "version": version,
        "points": len(snapshot),
        "points_counted": int(counted.sum()),
        "radius_mm": _spread(snapshot.radius_mm),
        "radius_rules": {
            rule.name.lower(): int(count)
            for rule in RadiusRule
            if (count := int((snapshot.radius_rule == rule).sum())) > 0
        },
        "density_per_mm2": _spread(snapshot.density_per_mm2[counted]),
        "reliable_share": float(reliable.mean()) if len(snapshot) else math.nan,
        "unreliable": {
            reason.name.lower(): int((snapshot.unreliable == reason).sum())
            for reason in Unreliable
            if reason is not Unreliable.RELIABLE
        },
        "settled_share": float(snapshot.settled.mean()) if len(snapshot) else math.nan,
        "isolated": int(snapshot.isolated.sum()),
        "losses": dict(losses),
        "notes": list(notes),
    }


def _areas(report: RegionReport) -> dict[str, dict[str, float]]:
    found: dict[str, dict[str, float]] = {}
    for region in report.regions:
        entry = found.setdefault(region.reason.label, {"count": 0, "area_mm2": 0.0})
        entry["count"] += 1
        entry["area_mm2"] += region.area_mm2
    return found


def _spread(values: Float64Array) -> dict[str, float]:
    """Smallest, median and largest of the finite values; NaN when there is none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return {"min": math.nan, "median": math.nan, "max": math.nan}
    return {"min": float(finite.min()), "median": float(np.median(finite)), "max": float(finite.max())}
