"""Connected patches of points that fail for one reason, each as a region; knows verdicts, takes none."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.snapshot import Int32Array, MapSnapshot
from scanner_service.rescan.frames import Frames
from scanner_service.rescan.gaps import Fan, GapKind, Gaps
from scanner_service.rescan.judgement import REMEDIES, Judgement, Reason
from scanner_service.rescan.kept import Kept
from scanner_service.rescan.outline import patch_of
from scanner_service.rescan.region import Limit, RescanRegion, mean_normal, priority_of, succession
from scanner_service.rescan.requirement import Requirement
from scanner_service.rescan.stations import IntArray, Stations
from scanner_service.rescan.strips import Strips

_NEIGHBOURS = 6
_BRIDGE = 2.0  # steep patches this many radii apart are one: single returns break them up
UPRIGHT = 2.0  # the ends of a flank's gap lie within this many radii of one ray
_LONGEST = 6.0  # radii that an outline reaches at most to join the two ends of a gap
_GAP_SHARE = 0.75  # a triangle with a gap for a side has about this circumradius in gap lengths


@dataclass(frozen=True, slots=True)
class Unfolded:
    """Points by their ray and their scanline, each pass on its own scale: no surface folds there."""

    line: Int32Array
    stations: Stations
    frames: Frames
    fan: Fan
    line_spacing_mm: Float64Array

    def mm(self, rows: IntArray) -> Float64Array:
        """(k, 2) where some points are."""
        line = self.line[rows]
        ray = self.fan.angle_rad[rows] * self.frames.distance_mm[self.stations.group[line]]
        return np.column_stack([ray, self.stations.rank[line] * self.line_spacing_mm[rows]])


def patches(
    snapshot: MapSnapshot,
    requirement: Requirement,
    strips: Strips,
    gaps: Gaps,
    judgement: Judgement,
    unfolded: Unfolded,
    kept: Kept[RescanRegion],
    reason: Reason,
    noise_mm: float | None,
) -> tuple[list[RescanRegion], list[IntArray]]:
    """The patches of one reason as regions without a number, and the rows of those too few for a region."""
    rows = np.flatnonzero(judgement.reason == reason).astype(np.int64)
    if not len(rows):
        return [], []
    width, steep = strips.width_mm[rows], reason is Reason.STEEP
    wide = np.where(judgement.failing_strip[rows] & np.isfinite(width), width, 0.0).max(axis=1)
    near = _BRIDGE * strips.reach_mm[rows] if steep else np.maximum(strips.reach_mm[rows], wide)
    connection = np.maximum(near, wide)
    links, span = _links(snapshot, strips, gaps, reason, rows)
    place = np.full(len(snapshot), -1, dtype=np.int64)
    place[rows] = np.arange(len(rows))
    edges = [_near_edges(snapshot.points_mm[rows], near), place[links]]
    for side in (0, 1):
        link = strips.link[rows, side]
        close = (link >= 0) & (width[:, side] <= connection)
        if steep:
            close[close] = overhang_mm(snapshot, rows[close], link[close]) <= UPRIGHT * strips.reach_mm[rows[close]]
        edges.append(np.column_stack([np.flatnonzero(close), place[link[close]]]))
    edge = np.concatenate(edges)
    edge = edge[(edge >= 0).all(axis=1)]
    cosine = np.einsum("ij,ij->i", snapshot.normals[rows[edge[:, 0]]], snapshot.normals[rows[edge[:, 1]]])
    edge = edge[~(cosine < np.cos(np.radians(requirement.region_angle_deg)))]
    graph = coo_matrix((np.ones(len(edge)), (edge[:, 0], edge[:, 1])), shape=(len(rows), len(rows)))
    label = connected_components(graph, directed=False)[1]
    by_label = np.argsort(label, kind="stable")
    groups = np.split(rows[by_label], np.flatnonzero(np.diff(label[by_label])) + 1)
    np.maximum.at(connection, place[links[:, 0]], span)
    np.maximum.at(connection, place[links[:, 1]], span)
    large = []
    for group in groups:
        if len(group) >= requirement.region_points:
            reaches = connection[place[group]]
            make = partial(
                _region, snapshot, requirement, strips, judgement, unfolded, reason, group, reaches, noise_mm
            )
            large.append(kept.made(_made_of(snapshot, strips, judgement, unfolded, reason, group, reaches), make))
    return large, [group for group in groups if len(group) < requirement.region_points]


def _made_of(
    snapshot: MapSnapshot,
    strips: Strips,
    judgement: Judgement,
    unfolded: Unfolded,
    reason: Reason,
    rows: IntArray,
    connection_mm: Float64Array,
) -> Iterator[npt.NDArray[Any]]:
    """All that a region is made from and that may be other at the next verdict; points stay where they are."""
    yield np.array([reason])
    yield rows
    yield connection_mm
    yield snapshot.normals[rows]
    yield unfolded.mm(rows)
    for of in (strips, judgement):
        for name in of.__slots__:
            yield getattr(of, name)[rows]


def _links(
    snapshot: MapSnapshot, strips: Strips, gaps: Gaps, reason: Reason, rows: IntArray
) -> tuple[IntArray, Float64Array]:
    """(e, 2) rows that are on one surface whatever lies between, and (e,) how far an outline reaches to join them.

    The two ends of a gap in a flank are on the flank, those of a gap at the range's end on what is out of range.
    """
    kind = {Reason.OUT_OF_RANGE: GapKind.OUT_OF_RANGE, Reason.STEEP: GapKind.FLANK}.get(reason)
    if kind is None:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0)
    own = np.zeros(len(snapshot), dtype=bool)
    own[rows] = True
    bridging = gaps.of_kind(kind)
    bridging = bridging[own[gaps.high[bridging]] & own[gaps.low[bridging]]]
    high, low = gaps.high[bridging], gaps.low[bridging]
    share = 1.0 if reason is Reason.OUT_OF_RANGE else _GAP_SHARE
    span = share * np.linalg.norm(snapshot.points_mm[high] - snapshot.points_mm[low], axis=1)
    if reason is Reason.STEEP:  # what a ray meets far aside or far below is another surface
        reach = strips.reach_mm[high]
        own_surface = (overhang_mm(snapshot, high, low) <= UPRIGHT * reach) & (span <= _LONGEST * reach)
        high, low, span = high[own_surface], low[own_surface], span[own_surface]
    return np.column_stack([high, low]), span


def overhang_mm(snapshot: MapSnapshot, first: IntArray, second: IntArray) -> Float64Array:
    """(k,) how far points lie from the rays through others."""
    ray = snapshot.points_mm[first] - snapshot.lines.laser_mm[snapshot.line[first]]
    aside = np.cross(snapshot.points_mm[second] - snapshot.points_mm[first], ray)
    return np.asarray(np.linalg.norm(aside, axis=1) / np.maximum(np.linalg.norm(ray, axis=1), 1e-12))


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


def _halfway(strips: Strips, rows: IntArray, by_gap: BoolArray) -> tuple[IntArray, IntArray]:
    """Pairs of a point of the patch (rows, rising) and a neighbour on its surface that is not of it.

    A point stands for the surface halfway to its neighbours: in its own line, and in the lines beside, but not where
    it fails `by_gap` (k,) only: then it stands at the border of what is missing.
    """
    on_surface = np.isfinite(strips.width_mm[rows]) & ~by_gap[:, None]
    beside = np.where(on_surface, strips.link[rows], -1)
    other = np.concatenate([strips.chain[rows], beside], axis=1).T.reshape(-1)
    owner = np.tile(rows, 4)
    mine = np.minimum(np.searchsorted(rows, other), len(rows) - 1)
    outside = (other >= 0) & (rows[mine] != other)
    return owner[outside], other[outside]


def _region(
    snapshot: MapSnapshot,
    requirement: Requirement,
    strips: Strips,
    judgement: Judgement,
    unfolded: Unfolded,
    reason: Reason,
    rows: IntArray,
    connection_mm: Float64Array,
    noise_mm: float | None,
) -> RescanRegion:
    """One patch of failing points."""
    one_pass = bool((strips.group[rows] == strips.group[rows[0]]).all())
    by_gap: BoolArray = np.asarray(judgement.failing_strip[rows].any(axis=1) & (reason is not Reason.STEEP))
    owner, other = _halfway(strips, rows, by_gap)
    if reason is Reason.OUT_OF_RANGE:  # what is missing lies beyond the points, not around them
        owner, other = rows[:0], rows[:0]
    points = np.concatenate([snapshot.points_mm[rows], 0.5 * (snapshot.points_mm[owner] + snapshot.points_mm[other])])
    flat = np.concatenate([unfolded.mm(rows), 0.5 * (unfolded.mm(owner) + unfolded.mm(other))])
    connection = np.concatenate([connection_mm, connection_mm[np.searchsorted(rows, owner)]])
    spacing = np.fmin(strips.nominal_point_spacing_mm[np.concatenate([rows, owner])], connection)
    patch = patch_of(points, connection, spacing, flat if one_pass else None)
    normal = mean_normal(snapshot.normals[rows])
    if np.isnan(normal).any():
        towards = snapshot.lines.laser_mm[snapshot.line[rows]].mean(axis=0) - patch.centroid_mm
        normal = np.where(patch.normal @ towards < 0, -patch.normal, patch.normal)
    measured = judgement.spacing_per_mm2[rows]
    by_count = judgement.judged_per_mm2[rows]
    values = by_count if reason is Reason.NOISY else np.where(np.isfinite(measured), measured, by_count)
    required = float(np.median(judgement.required_per_mm2[rows]))
    middle = float(np.median(values))
    deficit = 1.0 - middle / required
    limit = requirement.noise_limit_mm(noise_mm)
    allowed = float(np.median(judgement.allowed_mm[rows]))
    too_wide = judgement.failing_strip[rows] & (judgement.width_mm[rows] > allowed)
    if reason is Reason.NOISY and limit is not None:
        deficit = 1.0 - limit / float(np.median(judgement.noise_mm[rows]))
    elif reason is Reason.STEEP:
        deficit = max(deficit, 1.0 - float(np.median(strips.reach_mm[rows] / connection_mm)))
    elif reason is Reason.OUT_OF_RANGE:
        deficit = 1.0
    elif reason is Reason.ISOLATED:
        deficit = 0.0
    elif too_wide.any():  # chord error and line spacing ask for more than the density does
        deficit = max(deficit, 1.0 - allowed / float(np.median(judgement.width_mm[rows][too_wide])))
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
        priority=priority_of(deficit, patch.area_mm2),
        point_count=len(rows),
        remedy=REMEDIES[reason],
        point_rows=rows,
        limit=_limit(snapshot, requirement, strips, judgement, reason, rows, float(np.median(by_count)), limit),
        confidence=succession(int(_fails_alone(judgement, rows, values, required).sum()), len(rows)),
        line_spacing_mm=allowed,
    )


def _limit(
    snapshot: MapSnapshot,
    requirement: Requirement,
    strips: Strips,
    judgement: Judgement,
    reason: Reason,
    rows: IntArray,
    counted_per_mm2: float,
    noise_limit_mm: float | None,
) -> Limit | None:
    """Which limit the patch misses; a strip that is too wide goes before what follows from it, the density."""
    if reason is Reason.OUT_OF_RANGE:
        return None
    if reason is Reason.NOISY and noise_limit_mm is not None:
        return Limit("noise", float(np.median(judgement.noise_mm[rows])), noise_limit_mm, "mm")
    wide = rows[judgement.failing_strip[rows].any(axis=1)]
    if 2 * len(wide) >= len(rows):
        widest = np.where(judgement.failing_strip[wide], judgement.width_mm[wide], -np.inf).max(axis=1)
        largest = np.fmin(judgement.allowed_mm[wide], strips.reach_mm[wide] if reason is Reason.STEEP else np.inf)
        return Limit("line_spacing", float(np.median(widest)), float(np.median(largest)), "mm")
    if reason is Reason.STEEP and requirement.incidence_rad is not None:
        ray = snapshot.lines.laser_mm[snapshot.line[rows]] - snapshot.points_mm[rows]
        cosine = np.einsum("ij,ij->i", ray, snapshot.normals[rows]) / np.linalg.norm(ray, axis=1)
        known = np.abs(cosine[np.isfinite(cosine)])
        leaning = float(np.arccos(np.clip(np.median(known), 0.0, 1.0))) if len(known) else 0.0
        if leaning > requirement.incidence_rad:
            return Limit("incidence", float(np.degrees(leaning)), float(np.degrees(requirement.incidence_rad)), "°")
    by_spacing = float(np.fmin(np.median(judgement.spacing_per_mm2[rows]), np.inf))
    density = min(counted_per_mm2, by_spacing)
    return Limit("density", density, float(np.median(judgement.required_per_mm2[rows])), "points/mm²")


def _fails_alone(judgement: Judgement, rows: IntArray, values: Float64Array, required: float) -> BoolArray:
    """(k,) True for the points whose own measurement says that they fail, whatever their neighbours are."""
    measured_otherwise = np.isin(judgement.reason[rows], (Reason.NOISY, Reason.OUT_OF_RANGE, Reason.ISOLATED))
    alone: BoolArray = judgement.failing_strip[rows].any(axis=1) | (values < required) | judgement.grazing[rows]
    alone |= measured_otherwise
    return alone
