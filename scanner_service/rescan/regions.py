"""Rescan regions: connected patches of surface worth another pass, each with its reason; knows no poses."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array, SensorGeometry, read_only
from scanner_service.analysis.snapshot import MapSnapshot, UInt8Array
from scanner_service.rescan.gaps import Gaps, fan_of, find_gaps
from scanner_service.rescan.judgement import REMEDIES, Judgement, Reason, judge
from scanner_service.rescan.outline import patch_of
from scanner_service.rescan.requirement import Requirement
from scanner_service.rescan.shadows import shadow_groups
from scanner_service.rescan.stations import IntArray, stations_of
from scanner_service.rescan.strips import Strips, strips_of

_NEIGHBOURS = 6
_HALF_PRIORITY_MM2 = 25.0


@dataclass(frozen=True, slots=True)
class RescanRegion:
    """A patch of surface worth another pass; part frame, millimetres.

    `outline_mm` are closed loops of (k, 3) points on the surface, the longest first. `normal` (3,) is the mean unit
    normal towards the laser, NaN if unknown; a wall's points to its open side. `measured_per_mm2` is the median density
    that the spacing on the surface gives (0 in a shadow), `counting_error_per_mm2` the robust spread of the points
    around it (1.4826 times the median absolute deviation). `priority` = deficit · area / (area + 25 mm²), where deficit
    is 1 - measured / required, or 1 - limit / noise for noise, at least 1 - r / Δs' for steep surface, 1 out of range
    and 0 for isolated points. 0 is not worth a pass, near 1 is large and empty.
    `point_rows` (point_count,) are rows of the snapshot: the failing points, or a gap's ends.
    """

    number: int
    reason: Reason
    outline_mm: tuple[Float64Array, ...]
    area_mm2: float
    centroid_mm: Float64Array
    normal: Float64Array
    measured_per_mm2: float
    required_per_mm2: float
    counting_error_per_mm2: float
    priority: float
    point_count: int
    remedy: str
    point_rows: IntArray

    def __post_init__(self) -> None:
        for array in (*self.outline_mm, self.centroid_mm, self.normal, self.point_rows):
            read_only(array)

    def to_dict(self) -> dict[str, object]:
        """For JSON: plain numbers and lists, None where a value is unknown, without the point rows."""
        return {
            "number": self.number,
            "reason": self.reason.label,
            "remedy": self.remedy,
            "area_mm2": self.area_mm2,
            "centroid_mm": self.centroid_mm.tolist(),
            "normal": None if np.isnan(self.normal).any() else self.normal.tolist(),
            "measured_per_mm2": _known(self.measured_per_mm2),
            "required_per_mm2": _known(self.required_per_mm2),
            "counting_error_per_mm2": _known(self.counting_error_per_mm2),
            "priority": self.priority,
            "point_count": self.point_count,
            "outline_mm": [loop.tolist() for loop in self.outline_mm],
        }


@dataclass(frozen=True, slots=True)
class RegionReport:
    """The regions of a map, by falling priority, and the verdict on every point (arrays of n rows).

    `rescan` marks the points of regions; `reason` is the point's own verdict, which may be other than NONE outside of
    any region (a patch of fewer points than the requirement asks). `counts` are points by verdict: `ok`, each reason,
    `unsettled`, `not_counted`, `requirement_unknown`; they add up to n. `judgement`, `strips` and `gaps` are what the
    report was made from.
    """

    version: int
    regions: tuple[RescanRegion, ...]
    rescan: BoolArray
    reason: UInt8Array
    counts: dict[str, int]
    judgement: Judgement
    strips: Strips
    gaps: Gaps

    def to_dict(self) -> dict[str, object]:
        """For JSON: the regions and the counts."""
        return {
            "version": self.version,
            "counts": dict(self.counts),
            "regions": [region.to_dict() for region in self.regions],
        }


def find_regions(
    snapshot: MapSnapshot,
    requirement: Requirement | None = None,
    geometry: SensorGeometry | None = None,
    noise_mm: float | None = None,
    towards_sensor: Float64Array | None = None,
) -> RegionReport:
    """Find what is worth another pass.

    Parameters
    ----------
    snapshot : the live map; only its settled points are judged.
    requirement : the target; None for the defaults.
    geometry : the scanner's optics; without it nothing is called `out_of_range`.
    noise_mm : the sensor's noise (one standard deviation); None takes the geometry's where it is above 0, and without
        either nothing is called `noisy`.
    towards_sensor : (3,) unit direction of the sensor's z in the part frame; None: taken from the fan's middle ray.
    """
    requirement = requirement or Requirement()
    if noise_mm is None and geometry is not None and geometry.noise_mm > 0:
        noise_mm = geometry.noise_mm
    stations = stations_of(snapshot.lines)
    strips = strips_of(snapshot, stations, requirement)
    fan = fan_of(snapshot, stations, strips, towards_sensor)
    gaps = find_gaps(snapshot, stations, strips, fan, geometry)
    judgement = judge(snapshot, requirement, stations, strips, fan, gaps, geometry, noise_mm)
    drafts = _shadow_regions(snapshot, requirement, strips, gaps, judgement)
    for reason in Reason:
        if reason not in (Reason.NONE, Reason.SHADOW):
            drafts += _patches(snapshot, requirement, strips, gaps, judgement, reason, noise_mm)
    drafts.sort(key=lambda draft: (-draft.priority, *draft.centroid_mm.tolist()))
    regions = tuple(_numbered(draft, number) for number, draft in enumerate(drafts, start=1))
    rescan = np.zeros(len(snapshot), dtype=bool)
    for region in regions:
        rescan[region.point_rows] = True
    read_only(rescan)
    counts = _counts(snapshot, judgement)
    return RegionReport(snapshot.version, regions, rescan, judgement.reason, counts, judgement, strips, gaps)


def _counts(snapshot: MapSnapshot, judgement: Judgement) -> dict[str, int]:
    """Points by verdict; they add up to the points of the snapshot."""
    judged, counted = judgement.judged, snapshot.neighbours > 0
    counts = {"ok": int((judged & (judgement.reason == Reason.NONE)).sum())}
    for reason in Reason:
        if reason is not Reason.NONE:
            counts[reason.label] = int((judgement.reason == reason).sum())
    counts["unsettled"] = int((counted & ~snapshot.settled).sum())
    counts["not_counted"] = int((~counted).sum())
    counts["requirement_unknown"] = int((counted & snapshot.settled & ~judged).sum())
    return counts


def _patches(
    snapshot: MapSnapshot,
    requirement: Requirement,
    strips: Strips,
    gaps: Gaps,
    judgement: Judgement,
    reason: Reason,
    noise_mm: float | None,
) -> list[RescanRegion]:
    """Connected patches of the points that fail for one reason."""
    rows = np.flatnonzero(judgement.reason == reason).astype(np.int64)
    if len(rows) < requirement.region_points:
        return []
    connection = strips.reach_mm.copy()
    wide = np.where(judgement.failing_strip & np.isfinite(strips.width_mm), strips.width_mm, 0.0).max(axis=1)
    connection = np.maximum(connection, wide)
    edges = [_near_edges(snapshot.points_mm[rows], connection[rows])]
    place = np.full(len(snapshot), -1, dtype=np.int64)
    place[rows] = np.arange(len(rows))
    for side in (0, 1):
        link = strips.link[rows, side]
        close = (link >= 0) & (strips.width_mm[rows, side] <= connection[rows])
        edges.append(np.column_stack([np.flatnonzero(close), place[link[close]]]))
    if reason is Reason.OUT_OF_RANGE:
        edges.append(np.column_stack([place[gaps.high], place[gaps.low]]))
        span = np.linalg.norm(snapshot.points_mm[gaps.high] - snapshot.points_mm[gaps.low], axis=1)
        np.maximum.at(connection, gaps.high, span)
    edge = np.concatenate(edges)
    edge = edge[(edge >= 0).all(axis=1)]
    cosine = np.einsum("ij,ij->i", snapshot.normals[rows[edge[:, 0]]], snapshot.normals[rows[edge[:, 1]]])
    edge = edge[~(cosine < np.cos(np.radians(requirement.region_angle_deg)))]
    graph = coo_matrix((np.ones(len(edge)), (edge[:, 0], edge[:, 1])), shape=(len(rows), len(rows)))
    label = connected_components(graph, directed=False)[1]
    by_label = np.argsort(label, kind="stable")
    groups = np.split(rows[by_label], np.flatnonzero(np.diff(label[by_label])) + 1)
    return [
        _region(snapshot, requirement, strips, judgement, reason, group, connection[group], noise_mm)
        for group in groups
        if len(group) >= requirement.region_points
    ]


def _near_edges(points_mm: Float64Array, connection_mm: Float64Array) -> IntArray:
    """(e, 2) pairs of nearest neighbours within the larger of the two connection lengths."""
    k = min(_NEIGHBOURS + 1, len(points_mm))
    if k < 2:
        return np.zeros((0, 2), dtype=np.int64)
    found = cKDTree(points_mm).query(points_mm, k=k)
    distance, other = np.asarray(found[0]), np.asarray(found[1], dtype=np.int64)
    first = np.repeat(np.arange(len(points_mm)), k - 1)
    second = other[:, 1:].reshape(-1)
    near = distance[:, 1:].reshape(-1) <= np.maximum(connection_mm[first], connection_mm[second])
    return np.column_stack([first[near], second[near]]).astype(np.int64)


def _region(
    snapshot: MapSnapshot,
    requirement: Requirement,
    strips: Strips,
    judgement: Judgement,
    reason: Reason,
    rows: IntArray,
    connection_mm: Float64Array,
    noise_mm: float | None,
) -> RescanRegion:
    """One patch of failing points."""
    spacing = np.fmin(strips.nominal_point_spacing_mm[rows], connection_mm)
    patch = patch_of(snapshot.points_mm[rows], connection_mm, spacing)
    normal = _mean_normal(snapshot.normals[rows])
    if np.isnan(normal).any():
        towards = snapshot.lines.laser_mm[snapshot.line[rows]].mean(axis=0) - patch.centroid_mm
        normal = np.where(patch.normal @ towards < 0, -patch.normal, patch.normal)
    measured = judgement.spacing_per_mm2[rows]
    by_count = judgement.judged_per_mm2[rows]
    values = by_count if reason is Reason.NOISY else np.where(np.isfinite(measured), measured, by_count)
    required = float(np.median(judgement.required_per_mm2[rows]))
    middle = float(np.median(values))
    deficit = 1.0 - middle / required
    if reason is Reason.NOISY and noise_mm is not None:
        deficit = 1.0 - requirement.noise_factor * noise_mm / float(np.median(judgement.noise_mm[rows]))
    elif reason is Reason.STEEP:
        deficit = max(deficit, 1.0 - float(np.median(strips.reach_mm[rows] / connection_mm)))
    elif reason is Reason.OUT_OF_RANGE:
        deficit = 1.0
    elif reason is Reason.ISOLATED:
        deficit = 0.0
    return RescanRegion(
        number=0,
        reason=reason,
        outline_mm=patch.loops,
        area_mm2=patch.area_mm2,
        centroid_mm=patch.centroid_mm,
        normal=normal,
        measured_per_mm2=middle,
        required_per_mm2=required,
        counting_error_per_mm2=1.4826 * float(np.median(np.abs(values - middle))),
        priority=_priority(deficit, patch.area_mm2),
        point_count=len(rows),
        remedy=REMEDIES[reason],
        point_rows=rows,
    )


def _shadow_regions(
    snapshot: MapSnapshot, requirement: Requirement, strips: Strips, gaps: Gaps, judgement: Judgement
) -> list[RescanRegion]:
    """Regions of surface that no ray reached, from the gaps around them."""
    regions = []
    for group in shadow_groups(snapshot, requirement, strips, gaps):
        rows = np.unique(np.concatenate([gaps.high[group.gaps], gaps.low[group.gaps]])).astype(np.int64)
        rows = rows[judgement.judged[rows]]
        if len(rows) < requirement.region_points:
            continue
        span = np.zeros(len(snapshot))
        length = np.linalg.norm(
            snapshot.points_mm[gaps.high[group.gaps]] - snapshot.points_mm[gaps.low[group.gaps]], axis=1
        )
        np.maximum.at(span, gaps.high[group.gaps], length)
        np.maximum.at(span, gaps.low[group.gaps], length)
        patch = patch_of(
            snapshot.points_mm[rows], strips.reach_mm[rows] + span[rows], strips.nominal_point_spacing_mm[rows]
        )
        regions.append(
            RescanRegion(
                number=0,
                reason=Reason.SHADOW,
                outline_mm=patch.loops,
                area_mm2=group.area_mm2,
                centroid_mm=patch.centroid_mm,
                normal=_mean_normal(group.normals),
                measured_per_mm2=0.0,
                required_per_mm2=float(np.median(judgement.required_per_mm2[rows])),
                counting_error_per_mm2=0.0,
                priority=_priority(1.0, group.area_mm2),
                point_count=len(rows),
                remedy=REMEDIES[Reason.SHADOW],
                point_rows=rows,
            )
        )
    return regions


def _mean_normal(normals: Float64Array) -> Float64Array:
    """Unit mean of the known normals; NaN where none is known or they point everywhere."""
    known = normals[np.isfinite(normals).all(axis=1)]
    total = known.sum(axis=0)
    length = float(np.linalg.norm(total))
    if not len(known) or length < 0.5 * len(known):
        return np.full(3, np.nan)
    return np.asarray(total / length, dtype=np.float64)


def _priority(deficit: float, area_mm2: float) -> float:
    """Share of the requirement that is missing, times how large the area is beside 25 mm²."""
    return max(0.0, min(1.0, deficit)) * area_mm2 / (area_mm2 + _HALF_PRIORITY_MM2)


def _numbered(draft: RescanRegion, number: int) -> RescanRegion:
    values = {name: getattr(draft, name) for name in RescanRegion.__slots__}
    return RescanRegion(**{**values, "number": number})


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
