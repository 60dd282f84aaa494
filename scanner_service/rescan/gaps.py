"""Places between two returns where surface may be missing, and why; knows points and stations, judges no density.

Two kinds of neighbours are looked at: consecutive returns of one scanline, and consecutive returns under the same ray
of the fan in the scanlines of a pass. Between the two ends A and B of such a pair lies, when they are far apart,

- a *shadow* (or a wall nobody sees from above): the ends differ in depth along the laser ray by more than the
  neighbourhood radius, AB is closer to the ray than to its perpendicular, and neither end's tangent plane leads to the
  other end. A camera's shadow runs along the camera's ray, at the triangulation angle (20-40°) to the laser's; the
  laser's shadow runs along the laser's ray;
- a *flank*: the same, but three pairs or more in a row jump in the same sense, or neither end has a plane, or the plane
  of one leads to the other (of both, where that is more than six radii away): steep surface;
- *filled*: a shadow of one pass, about whose middle another pass has points;
- *out of range*: both ends stand near an end of the measurement range;
- a *hole*: anything else. An inner border of the part, or dropouts: not a reason by itself. So is a jump over places
  without a return to a lone return from which the surface rises again at once: the far wall of a hole; and, without
  a geometry, to a lower end without a sure plane or that the ray grazes: the silhouette of something behind. So is
  what lies between the surface and an isolated return in front of it.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array, SensorGeometry, read_only
from scanner_service.analysis.snapshot import MapSnapshot, RadiusRule, UInt8Array
from scanner_service.rescan.stations import IntArray, Stations
from scanner_service.rescan.strips import Strips, in_a_row

Pairs = tuple[IntArray, IntArray, Float64Array, IntArray]  # first and second rows, width_mm, lane

_LEAST_SPACINGS = 3.0
_FAR_BELOW = 6.0  # radii: ends further apart are on one flank only if the planes of both say so
_LOST = 3  # places without a return that are more than chance
_FACING = 0.5  # cosine of the largest incidence at the foot of a shadow
_RANGE_SHARE = 0.005  # share of the range within which a point is near its end, whatever the surface does


class GapKind(IntEnum):
    """What lies between the two ends of a gap."""

    SHADOW = 1
    FLANK = 2
    OUT_OF_RANGE = 3
    HOLE = 4
    FILLED = 5  # a shadow of this pass whose middle another pass has seen


@dataclass(frozen=True, slots=True)
class Gaps:
    """The gaps of a map, one row each.

    `high` and `low` (g,) are rows of the snapshot, `high` nearer to the laser. `across` (g,) is True where the gap
    lies across the scanlines (along the travel), False along one line. `width_mm` (g,) is the spacing of such gaps
    beside each other: the ray spacing for gaps across, the line stride for gaps along the line. `lane` (g,) counts
    them beside each other within a pass: the ray for gaps across, the place of the scanline for gaps along the line.
    """

    high: IntArray
    low: IntArray
    across: BoolArray
    width_mm: Float64Array
    kind: UInt8Array
    lane: IntArray

    def __post_init__(self) -> None:
        for array in (self.high, self.low, self.across, self.width_mm, self.kind, self.lane):
            read_only(array)

    def __len__(self) -> int:
        return len(self.high)

    def of_kind(self, kind: GapKind) -> npt.NDArray[np.intp]:
        """Rows of the gaps of one kind."""
        return np.flatnonzero(self.kind == kind)


def gap_lengths_mm(snapshot: MapSnapshot, gaps: Gaps, rows: npt.NDArray[np.intp]) -> Float64Array:
    """(k,) distance between the ends of some gaps."""
    vector = snapshot.points_mm[gaps.high[rows]] - snapshot.points_mm[gaps.low[rows]]
    return np.asarray(np.linalg.norm(vector, axis=1), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Fan:
    """Each point in the coordinates of its pass's laser fan: `angle_rad` (n,) across, `depth_mm` (n,) from the laser.

    Depth runs against the sensor's z, `axis` (p, 3) by pass.
    """

    angle_rad: Float64Array
    depth_mm: Float64Array
    axis: Float64Array


def fan_of(
    snapshot: MapSnapshot, stations: Stations, strips: Strips, towards_sensor: Float64Array | None = None
) -> Fan:
    """Angle and depth of every point.

    `towards_sensor` (3,) is the unit direction of the sensor's z in the part frame; without it the ray halfway between
    the outermost rays of a pass that returned stands for it, which is askew where the part fills one side of the fan.
    """
    group = stations.group[snapshot.line]
    ray = snapshot.points_mm - snapshot.lines.laser_mm[snapshot.line]
    axis = np.tile([0.0, 0.0, -1.0], (len(strips.along), 1))
    for number in np.unique(group):
        mine = ray[group == number]
        along = strips.along[number]
        mean = mine.mean(axis=0)
        mean = mean - along * (mean @ along)
        if np.linalg.norm(mean) > 0:
            mean /= np.linalg.norm(mean)
            angle = np.arctan2(mine @ along, mine @ mean)
            middle = 0.5 * (angle.min() + angle.max())
            axis[number] = np.cos(middle) * mean + np.sin(middle) * along
    if towards_sensor is not None:
        axis[:] = -towards_sensor
    e = strips.along[group] if len(group) else np.zeros((0, 3))
    c = axis[group] if len(group) else np.zeros((0, 3))
    e = e - c * np.einsum("ij,ij->i", e, c)[:, None]
    e /= np.maximum(np.linalg.norm(e, axis=1, keepdims=True), 1e-12)  # a line along the ray has no angle but 0
    depth = np.einsum("ij,ij->i", ray, c)
    return Fan(np.arctan2(np.einsum("ij,ij->i", ray, e), depth), depth, axis)


def find_gaps(
    snapshot: MapSnapshot, stations: Stations, strips: Strips, fan: Fan, geometry: SensorGeometry | None = None
) -> Gaps:
    """All gaps between settled points, classified."""
    pairs = [_pairs_along(snapshot, stations, strips), _pairs_across(snapshot, stations, strips, fan)]
    parts = [
        _classified(snapshot, stations, strips, fan, geometry, first, second, width, lane, across)
        for (first, second, width, lane), across in zip(pairs, (False, True), strict=True)
    ]
    high = np.concatenate([part.high for part in parts])
    kind = np.concatenate([part.kind for part in parts])
    kind[_in_the_air(snapshot, strips)[high]] = GapKind.HOLE
    return Gaps(
        high=high,
        low=np.concatenate([part.low for part in parts]),
        across=np.concatenate([part.across for part in parts]),
        width_mm=np.concatenate([part.width_mm for part in parts]),
        kind=kind,
        lane=np.concatenate([part.lane for part in parts]),
    )


def _pairs_along(snapshot: MapSnapshot, stations: Stations, strips: Strips) -> Pairs:
    """Consecutive returns of each scanline."""
    order = strips.order[snapshot.neighbours[strips.order] > 0]
    first, second = order[:-1], order[1:]
    same = snapshot.line[first] == snapshot.line[second]
    first, second = first[same], second[same]
    line = snapshot.line[first]
    return first, second, np.nanmin(stations.stride_mm[line], axis=1, initial=np.inf), stations.rank[line]


def _pairs_across(snapshot: MapSnapshot, stations: Stations, strips: Strips, fan: Fan) -> Pairs:
    """Consecutive returns under the same ray, along the travel of each pass."""
    order = strips.order[snapshot.neighbours[strips.order] > 0]
    if len(order) < 2:
        return order[:0], order[:0], np.zeros(0), order[:0]
    line = snapshot.line[order]
    group = stations.group[line]
    step = np.abs(np.diff(fan.angle_rad[order]))
    within = (np.diff(line) == 0) & (np.diff(snapshot.index[order]) == 1)
    pitch = np.full(len(strips.along), np.nan)
    for number in np.unique(group):
        mine = step[within & (group[1:] == number)]
        if len(mine):
            pitch[number] = np.median(mine)
    usable = np.isfinite(pitch[group]) & (pitch[group] > 0)
    order, line, group = order[usable], line[usable], group[usable]
    # two rays a column: a whole line then leaves no column empty, however its rays fall
    column = np.floor(fan.angle_rad[order] / (2.0 * pitch[group])).astype(np.int64)
    rank = stations.rank[line]
    by_column = np.lexsort((rank, column, group))
    order, column, group, rank = order[by_column], column[by_column], group[by_column], rank[by_column]
    fresh = np.ones(len(order), dtype=bool)
    fresh[1:] = (np.diff(rank) != 0) | (np.diff(column) != 0) | (np.diff(group) != 0)
    order, column, group = order[fresh], column[fresh], group[fresh]
    same = (np.diff(column) == 0) & (np.diff(group) == 0)
    first, second = order[:-1][same], order[1:][same]
    distance = np.linalg.norm(snapshot.points_mm - snapshot.lines.laser_mm[snapshot.line], axis=1)
    return first, second, 2.0 * pitch[group[:-1][same]] * distance[first], column[:-1][same]


def _classified(
    snapshot: MapSnapshot,
    stations: Stations,
    strips: Strips,
    fan: Fan,
    geometry: SensorGeometry | None,
    first: IntArray,
    second: IntArray,
    width: Float64Array,
    lane: IntArray,
    across: bool,
) -> Gaps:
    """The pairs that are gaps; `first` and `second` follow each other, so a jump that goes on can be told."""
    line = snapshot.line
    vector = snapshot.points_mm[second] - snapshot.points_mm[first]
    length = np.linalg.norm(vector, axis=1)
    ray = snapshot.points_mm[first] - snapshot.lines.laser_mm[line[first]]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    drop = np.einsum("ij,ij->i", vector, ray)
    reach = np.maximum(strips.reach_mm[first], strips.reach_mm[second])
    off_first = np.abs(np.einsum("ij,ij->i", vector, snapshot.normals[first]))
    off_second = np.abs(np.einsum("ij,ij->i", vector, snapshot.normals[second]))
    off_tangent = np.fmin(off_first, off_second)
    on_tangent_mm = np.maximum(0.5 * reach, 0.2 * length)
    place = stations.rank[line] if across else snapshot.index
    lost = np.abs(place[second] - place[first]).astype(np.int64) - 1
    # the sight that grazes a silhouette lies in its tangent plane, but what it hides is lost
    leaves_surface = ~(off_tangent <= on_tangent_mm) | (lost > _LOST)
    sideways = np.sqrt(np.maximum(length**2 - drop**2, 0.0))
    steep = (np.abs(drop) > reach) & (np.abs(drop) > sideways)
    jump = steep & leaves_surface
    lower = np.where(drop >= 0, second, first)
    if geometry is None:  # no camera may have been hidden: over lost places only a surface that goes on is a foot
        facing = np.abs(np.einsum("ij,ij->i", snapshot.normals[lower], ray)) >= _FACING
        jump &= (lost <= _LOST) | (facing & (snapshot.radius_rule[lower] != RadiusRule.GROWN))
    lone = ~in_a_row(snapshot, strips, lower, np.full(len(lower), across))
    jump &= ~(_far_walls(first, second, steep, drop, lost) & lone)
    usual = strips.nominal_point_spacing_mm[first]
    if across:
        usual = stations.stride_mm[line[first]].max(
            axis=1, initial=0.0, where=np.isfinite(stations.stride_mm[line[first]])
        )
    apart = length > np.fmax(_LEAST_SPACINGS * usual, reach)
    goes_on = np.zeros(len(first), dtype=bool)
    follows = (first[1:] == second[:-1]) & steep[1:] & steep[:-1] & (np.sign(drop[1:]) == np.sign(drop[:-1]))
    thrice = follows[1:] & follows[:-1]  # two jumps in a row may be a wall with one return on it
    for shift in range(3):
        goes_on[shift : len(goes_on) - 2 + shift] |= thrice
    goes_on |= np.isnan(off_tangent)  # no plane on either side: the middle of something steep
    kind = np.full(len(first), GapKind.HOLE, dtype=np.uint8)
    near = near_range_end(snapshot, stations, strips, fan, geometry)
    kind[near[first] & near[second]] = GapKind.OUT_OF_RANGE
    # round a silhouette only the upper plane leads down, to something far below
    silhouette = (
        steep & ~leaves_surface & (length > _FAR_BELOW * reach) & (np.fmax(off_first, off_second) > on_tangent_mm)
    )
    if geometry is None:
        silhouette[:] = False
    kind[jump | silhouette] = GapKind.SHADOW
    # far below stands a surface that faces the laser and leads nowhere near: no flank comes down to it
    plane = np.where((drop >= 0)[:, None], snapshot.normals[second], snapshot.normals[first])
    foot = (length > _FAR_BELOW * reach) & (np.abs(np.einsum("ij,ij->i", plane, ray)) >= _FACING)
    foot &= np.where(drop >= 0, off_second, off_first) > on_tangent_mm
    kind[(jump & goes_on & ~foot) | (steep & ~leaves_surface & ~silhouette)] = GapKind.FLANK
    settled = snapshot.settled[first] & snapshot.settled[second]
    rows = np.flatnonzero((steep | apart) & settled)
    kind[rows] = np.where(
        _seen_by_others(snapshot, stations, first[rows], second[rows], kind[rows]), GapKind.FILLED, kind[rows]
    )
    down = drop[rows] >= 0
    return Gaps(
        high=np.where(down, first[rows], second[rows]),
        low=np.where(down, second[rows], first[rows]),
        across=np.full(len(rows), across),
        width_mm=width[rows],
        kind=kind[rows],
        lane=lane[rows],
    )


def _in_the_air(snapshot: MapSnapshot, strips: Strips) -> BoolArray:
    """(n,) True for isolated returns nearer to the laser than the surface on both sides of them in their line.

    They hide nothing: a speck of dust, a droplet, a stray reflection.
    """
    stray = np.zeros(len(snapshot), dtype=bool)
    order = strips.order[snapshot.neighbours[strips.order] > 0]
    lone = snapshot.isolated[order]
    if not lone.any() or lone.all():
        return stray
    place = np.arange(len(order))
    before = np.maximum.accumulate(np.where(lone, -1, place))
    after = np.minimum.accumulate(np.where(lone, len(order), place)[::-1])[::-1]
    rows = np.flatnonzero(lone & (before >= 0) & (after < len(order)))
    own, left, right = order[rows], order[before[rows]], order[after[rows]]
    line = snapshot.line
    within = (line[left] == line[own]) & (line[right] == line[own])
    laser = snapshot.lines.laser_mm[line[own]]
    away, left_away, right_away = (np.linalg.norm(snapshot.points_mm[of] - laser, axis=1) for of in (own, left, right))
    stray[own] = within & (np.fmin(left_away, right_away) > away + strips.reach_mm[own])
    return stray


def _far_walls(first: IntArray, second: IntArray, steep: BoolArray, drop: Float64Array, lost: IntArray) -> BoolArray:
    """Jumps over lost places to a return from which the next pair jumps back up: nothing hangs between the two ends."""
    far = np.zeros(len(first), dtype=bool)
    back = (first[1:] == second[:-1]) & steep[1:] & steep[:-1] & (drop[:-1] > 0) & (drop[1:] < 0)
    far[:-1] |= back & (lost[:-1] > _LOST) & (lost[1:] < lost[:-1])
    far[1:] |= back & (lost[1:] > _LOST) & (lost[:-1] < lost[1:])
    return far


def _seen_by_others(
    snapshot: MapSnapshot, stations: Stations, first: IntArray, second: IntArray, kind: UInt8Array
) -> BoolArray:
    """True for shadows with a point of another pass nearer to their middle than their own ends are."""
    seen = np.zeros(len(first), dtype=bool)
    group = stations.group[snapshot.line]
    counted = snapshot.neighbours > 0
    for number in np.unique(group) if len(np.unique(group)) > 1 else ():
        mine = np.flatnonzero((kind == GapKind.SHADOW) & (group[first] == number))
        others = snapshot.points_mm[counted & (group != number)]
        if len(mine) and len(others):
            start, end = snapshot.points_mm[first[mine]], snapshot.points_mm[second[mine]]
            half = 0.5 * np.linalg.norm(end - start, axis=1)
            seen[mine] = cKDTree(others).query(0.5 * (start + end))[0] < 0.9 * half
    return seen


def near_range_end(
    snapshot: MapSnapshot, stations: Stations, strips: Strips, fan: Fan, geometry: SensorGeometry | None
) -> BoolArray:
    """(n,) True where a point stands near an end of the measurement range; all False without a geometry."""
    if geometry is None:
        return np.zeros(len(snapshot), dtype=bool)
    lowest, highest = geometry.range_mm
    z = geometry.laser_mm[2] - fan.depth_mm
    # near means that one and a half steps further on the surface may be beyond the end
    ray = snapshot.points_mm - snapshot.lines.laser_mm[snapshot.line]
    cosine = np.abs(np.einsum("ij,ij->i", ray, snapshot.normals)) / np.linalg.norm(ray, axis=1)
    slope = np.sqrt(np.maximum(1.0 - cosine**2, 0.0)) / np.maximum(cosine, 1e-6)
    step = np.fmax(strips.line_spacing_mm, strips.nominal_point_spacing_mm)
    margin = np.fmin(np.where(np.isnan(slope), np.inf, 1.5 * slope * step), 2.0 * strips.reach_mm)
    margin += 3.0 * geometry.noise_mm + _RANGE_SHARE * (highest - lowest)
    near: BoolArray = (z < lowest + margin) | (z > highest - margin)
    return near
