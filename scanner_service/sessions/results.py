"""What a session has found out at one moment: map, verdict, coverage; knows no thread and no device."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.scanline import BoolArray, Float64Array, SensorGeometry
from scanner_service.analysis.snapshot import MapSnapshot, RadiusRule, UInt8Array, Unreliable
from scanner_service.rescan.coverage import Coverage, observed_coverage
from scanner_service.rescan.reference import (
    ReferenceCoverage,
    ReferenceSurface,
    ReferenceUnusable,
    check_place,
    reference_coverage,
)
from scanner_service.rescan.region import RescanRegion
from scanner_service.rescan.regions import RegionReport, find_regions
from scanner_service.rescan.remarks import remarks_on
from scanner_service.rescan.requirement import Requirement


@dataclass(frozen=True, slots=True)
class Verdict:
    """What was said of the points of a snapshot: (n,) rescan or not, and the number of the reason."""

    rescan: BoolArray
    reason: UInt8Array


@dataclass(frozen=True, slots=True)
class Results:
    """A snapshot, judged.

    `regions` are those of the report, followed through the session: with ids, status and history, by falling priority;
    `resolved` those that were mended. `reference` is the coverage of the nominal part, None without one, or as long as
    there are too few points, or when `reference_refused` says why it cannot be told; `nominal` is that part itself.
    `remarks` say what of the requirement cannot be met by such a scan, or lies beside it.
    """

    snapshot: MapSnapshot
    report: RegionReport
    coverage: Coverage
    requirement: Requirement
    regions: tuple[RescanRegion, ...]
    resolved: tuple[RescanRegion, ...] = ()
    reference: ReferenceCoverage | None = None
    reference_refused: str | None = None
    nominal: ReferenceSurface | None = None
    remarks: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict:
        """The verdict on every point."""
        return Verdict(self.report.rescan, self.report.reason)

    @property
    def share(self) -> float:
        """Coverage: of the nominal part where there is one, else of the surface seen; NaN when unknown."""
        return self.coverage.share if self.reference is None else self.reference.share

    @property
    def coverage_kind(self) -> str:
        """`reference` where the coverage is of the nominal part, else `observed`."""
        return "observed" if self.reference is None else "reference"

    @property
    def typical_required_per_mm2(self) -> float:
        """The median of what is required over the surface, points per mm²; NaN when nothing is known of it."""
        known = self.coverage.required_per_mm2[np.isfinite(self.coverage.required_per_mm2)]
        return float(np.median(known)) if len(known) else math.nan

    @property
    def said(self) -> tuple[str, ...]:
        """What somebody should be told of what is asked for."""
        return self.remarks if self.reference_refused is None else (self.reference_refused, *self.remarks)

    @property
    def holds(self) -> bool | None:
        """Whether the coverage asked for is reached; None when none is asked for, or none is known."""
        asked = self.requirement.coverage_share
        return None if asked is None or math.isnan(self.share) else self.share >= asked

    def regions_dict(self) -> dict[str, Any]:
        """For JSON: the report, with the regions as they are followed."""
        return self.report.to_dict() | {
            "requirement": self.requirement.to_dict(),
            "remarks": list(self.remarks),
            "regions": [region.to_dict() for region in self.regions],
            "resolved": [region.to_dict() for region in self.resolved],
        }

    def coverage_dict(self) -> dict[str, Any]:
        """For JSON: what is asked for, what is reached, and of the nominal part what was never touched."""
        observed = self.coverage
        return {
            "kind": self.coverage_kind,
            "share": self.share,
            "required": self.requirement.coverage_share,
            "holds": self.holds,
            "observed_share": observed.share,
            "cell_mm": observed.cell_mm,
            "gap_mm2": observed.gap_mm2,
            "reference": None if self.reference is None else self.reference.to_dict(),
            "reference_refused": self.reference_refused,
        }


def judge(
    snapshot: MapSnapshot,
    requirement: Requirement,
    geometry: SensorGeometry | None = None,
    towards_sensor: Float64Array | None = None,
    reference: ReferenceSurface | None = None,
    reference_refused: str | None = None,
) -> Results:
    """Find the rescan regions and the coverage of a snapshot; geometry and direction as `find_regions` has them.

    `reference_refused` says why there is no reference although one was asked for.
    """
    report = find_regions(snapshot, requirement, geometry, towards_sensor=towards_sensor)
    return conclude(snapshot, requirement, report, observed_coverage(snapshot, report), reference, reference_refused)


def conclude(
    snapshot: MapSnapshot,
    requirement: Requirement,
    report: RegionReport,
    coverage: Coverage,
    reference: ReferenceSurface | None = None,
    reference_refused: str | None = None,
) -> Results:
    """The results of a snapshot whose regions and coverage are known."""
    measured, refused = None, reference_refused
    if reference is not None:
        try:
            if check_place(reference, snapshot):
                measured = reference_coverage(reference, snapshot, report, requirement)
        except ReferenceUnusable as error:
            refused = str(error)
    regions = report.regions + (measured.untouched if measured is not None else ())
    return Results(
        snapshot=snapshot,
        report=report,
        coverage=coverage,
        requirement=requirement,
        regions=tuple(replace(region, number=number) for number, region in enumerate(regions, start=1)),
        reference=measured,
        reference_refused=refused,
        nominal=reference,
        remarks=remarks_on(requirement, snapshot),
    )


def summarise(
    results: Results,
    losses: Mapping[str, Any],
    points_per_s: float,
    version: str,
    notes: tuple[str, ...] = (),
) -> dict[str, Any]:
    """The content of summary.json: lengths in millimetres, densities in points/mm2, NaN for what is not known."""
    snapshot = results.snapshot
    return _of_points(snapshot, losses, version, (*notes, *results.remarks)) | {
        "scanlines": len(snapshot.lines),
        "line_spacing_mm": _spread(snapshot.lines.line_spacing_mm),
        "point_spacing_mm": _spread(snapshot.lines.point_spacing_mm),
        "coverage": results.coverage_dict(),
        "requirement": results.requirement.to_dict(),
        "regions": {
            "count": len(results.regions),
            "area_mm2": float(sum(region.area_mm2 for region in results.regions)),
            "by_reason": _areas(results.regions),
            "resolved": len(results.resolved),
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


def _areas(regions: Sequence[RescanRegion]) -> dict[str, dict[str, float]]:
    found: dict[str, dict[str, float]] = {}
    for region in regions:
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
