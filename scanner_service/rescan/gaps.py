"""Places between two returns where surface may be missing, and why; knows points and stations, judges no density.

Two kinds of neighbours are looked at: consecutive returns of one scanline, and consecutive returns under the same ray
of the fan in the scanlines of a pass. Between the two ends A and B of such a pair lies, when they are far apart,

- a *shadow* (or a wall nobody sees from above): the ends differ in depth along the laser ray by more than the
  neighbourhood radius, AB is closer to the ray than to its perpendicular, and neither end's tangent plane leads to the
  other end. A camera's shadow runs along the camera's ray, at the triangulation angle (20-40°) to the laser's; the
  laser's shadow runs along the laser's ray;
- a *flank*: the same, but three pairs or more in a row jump in the same sense, or neither end has a plane, or the plane
  of one leads to the other (of both, where that is more than six radii away): steep surface;
- *filled*: a shadow of one pass of which other passes have left nothing;
- *out of range*: both ends stand near an end of the measurement range;
- a *hole*: anything else. An inner border of the part, or dropouts: not a reason by itself. So is a jump over places
  without a return to a lone return from which the surface rises again at once: the far wall of a hole; and, without
  a geometry, to a lower end without a sure plane or that the ray grazes: the silhouette of something behind. So is
  what lies between the surface and an isolated return in front of it.
"""

from dataclasses import dataclass
from enum import IntEnum, IntFlag

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array, SensorGeometry, read_only
from scanner_service.analysis.snapshot import MapSnapshot, RadiusRule, UInt8Array
from scanner_service.rescan.frames import Frames
from scanner_service.rescan.stations import IntArray, Stations
from scanner_service.rescan.strips import Strips, in_a_row

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
    FILLED = 5  # a shadow of this pass of which other passes have left nothing


class Mark(IntFlag):
    """What gaps say of the points at their ends."""

    SHADOW_HIGH = 1
    SHADOW_LOW = 2
    FLANK = 4
    OUT_OF_RANGE = 8


@dataclass(frozen=True, slots=True)
class Gaps:
    """The gaps of a map, one row each.

    `high` and `low` (g,) are rows of the snapshot, `high` nearer to the laser; of a shadow that other passes have seen
    in part they are points of theirs. `line` (g,) is the scanline in which the jump's upper end was found, `group` (g,)
    its pass. `across` (g,) is True where the gap lies across the scanlines (along the travel), False along one line.
    `width_mm` (g,) is the spacing of such gaps beside each other: the ray spacing for gaps across, the line stride for
    gaps along the line. `lane` (g,) counts them beside each other within a pass: the ray for gaps across, the place of
    the scanline for gaps along the line.
    `open_side` (g, 3) is the unit way from the straight surface between both ends to the side on which the part ends;
    NaN where that is not known: all but shadows in maps of several passes.
    """

    high: IntArray
    low: IntArray
    line: IntArray
    group: IntArray
    across: BoolArray
    width_mm: Float64Array
    kind: UInt8Array
    lane: IntArray
    open_side: Float64Array

    def __post_init__(self) -> None:
        for name in self.__slots__:
            read_only(getattr(self, name))

    def __len__(self) -> int:
        return len(self.high)

    def of_kind(self, kind: GapKind) -> npt.NDArray[np.intp]:
        """Rows of the gaps of one kind."""
        return np.flatnonzero(self.kind == kind)


def marks_of(count: int, gaps: Gaps) -> UInt8Array:
    """(count,) the marks of all points, as the bits of `Mark`."""
    marks = np.zeros(count, dtype=np.uint8)
    for kind, above, below in (
        (GapKind.SHADOW, Mark.SHADOW_HIGH, Mark.SHADOW_LOW),
        (GapKind.FLANK, Mark.FLANK, Mark.FLANK),
        (GapKind.OUT_OF_RANGE, Mark.OUT_OF_RANGE, Mark.OUT_OF_RANGE),
    ):
        rows = gaps.of_kind(kind)
        marks[gaps.high[rows]] |= np.uint8(above)
        marks[gaps.low[rows]] |= np.uint8(below)
    return marks


def gap_lengths_mm(snapshot: MapSnapshot, gaps: Gaps, rows: npt.NDArray[np.intp]) -> Float64Array:
    """(k,) distance between the ends of some gaps."""
    vector = snapshot.points_mm[gaps.high[rows]] - snapshot.points_mm[gaps.low[rows]]
    return np.asarray(np.linalg.norm(vector, axis=1), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Fan:
    """Each point in the coordinates of its pass's laser fan: `angle_rad` (n,) across, `depth_mm` (n,) from the laser.

    Depth runs against the sensor's z.
    """

    angle_rad: Float64Array
    depth_mm: Float64Array


@dataclass(frozen=True, slots=True)
class Pairs:
    """Neighbours between which a gap may lie, one row each: along the scanlines, or under one ray across them.

    `first` and `second` (q,) are rows of the snapshot, and a pair whose first is the second of the pair before it goes
    on from there. `kind` (q,) is the GapKind, 0 where the two are no gap; `is_down` (q,) whether the second is the
    lower end.
    """

    first: IntArray
    second: IntArray
    kind: UInt8Array
    is_down: BoolArray


def column_of(fan: Fan, frames: Frames, rows: IntArray, group: IntArray) -> IntArray:
    """(k,) place in the fan of points of passes `group` (k,), two rays a column; all in one where none is known.

    A whole line then leaves no column empty, however its rays fall.
    """
    step = 2.0 * frames.pitch_rad[group]
    return np.floor(fan.angle_rad[rows] / np.where(step > 0, step, np.inf)).astype(np.int64)


def find_pairs(
    snapshot: MapSnapshot,
    stations: Stations,
    frames: Frames,
    strips: Strips,
    fan: Fan,
    geometry: SensorGeometry | None = None,
) -> tuple[Pairs, Pairs]:
    """All pairs of neighbours along the lines, and across them, with the kind of those that are gaps.

    None is FILLED: what other passes have left of a shadow is for `unseen` to say.
    """
    ends = (_pairs_along(snapshot, strips), _pairs_across(snapshot, stations, frames, strips, fan))
    in_the_air = _in_the_air(snapshot, strips)
    found = []
    for (first, second), across in zip(ends, (False, True), strict=True):
        kind, is_down = _classified(snapshot, stations, strips, fan, geometry, first, second, across)
        kind[(kind > 0) & in_the_air[np.where(is_down, first, second)]] = GapKind.HOLE
        found.append(Pairs(first, second, kind, is_down))
    return found[0], found[1]


def gaps_between(
    snapshot: MapSnapshot,
    stations: Stations,
    frames: Frames,
    fan: Fan,
    first: tuple[IntArray, IntArray],
    second: tuple[IntArray, IntArray],
    kind: tuple[UInt8Array, UInt8Array],
    is_down: tuple[BoolArray, BoolArray],
) -> Gaps:
    """Gaps of pairs that are some, those along the lines and those across them, each by its ends and kind."""
    along, across = (snapshot.line[rows] for rows in first)
    group = stations.group[across]
    away = np.linalg.norm(snapshot.points_mm[first[1]] - snapshot.lines.laser_mm[across], axis=1)
    width = (np.nanmin(stations.stride_mm[along], axis=1, initial=np.inf), 2.0 * frames.pitch_rad[group] * away)
    lane = (stations.rank[along], column_of(fan, frames, first[1], group))
    one, other, down = (np.concatenate(parts) for parts in (first, second, is_down))
    high = np.where(down, one, other)
    return Gaps(
        high=high,
        low=np.where(down, other, one),
        line=snapshot.line[high].astype(np.int64),
        group=stations.group[snapshot.line[high]],
        across=np.repeat([False, True], [len(along), len(across)]),
        width_mm=np.concatenate(width),
        kind=np.concatenate(kind),
        lane=np.concatenate(lane),
        open_side=np.full((len(high), 3), np.nan),
    )


def _pairs_along(snapshot: MapSnapshot, strips: Strips) -> tuple[IntArray, IntArray]:
    """Consecutive returns of each scanline."""
    order = strips.order[snapshot.neighbours[strips.order] > 0]
    first, second = order[:-1], order[1:]
    same = snapshot.line[first] == snapshot.line[second]
    return first[same], second[same]


def _pairs_across(
    snapshot: MapSnapshot, stations: Stations, frames: Frames, strips: Strips, fan: Fan
) -> tuple[IntArray, IntArray]:
    """Consecutive returns under the same ray, along the travel of each pass."""
    order = strips.order[snapshot.neighbours[strips.order] > 0]
    group = stations.group[snapshot.line[order]]
    usable = frames.pitch_rad[group] > 0
    order, group = order[usable], group[usable]
    column, rank = column_of(fan, frames, order, group), stations.rank[snapshot.line[order]]
    by_column = np.lexsort((rank, column, group))
    order, column, group, rank = order[by_column], column[by_column], group[by_column], rank[by_column]
    fresh = np.ones(len(order), dtype=bool)
    fresh[1:] = (np.diff(rank) != 0) | (np.diff(column) != 0) | (np.diff(group) != 0)
    order, column, group = order[fresh], column[fresh], group[fresh]
    same = (np.diff(column) == 0) & (np.diff(group) == 0)
    return order[:-1][same], order[1:][same]


def _classified(
    snapshot: MapSnapshot,
    stations: Stations,
    strips: Strips,
    fan: Fan,
    geometry: SensorGeometry | None,
    first: IntArray,
    second: IntArray,
    across: bool,
) -> tuple[UInt8Array, BoolArray]:
    """Kind of each pair (0: no gap), and whether the second is the lower end; pairs follow each other as in `Pairs`."""
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
    near = near_range_end(snapshot, strips, fan, geometry)
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
    kind[~((steep | apart) & settled)] = 0
    return kind, drop >= 0


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


def near_range_end(snapshot: MapSnapshot, strips: Strips, fan: Fan, geometry: SensorGeometry | None) -> BoolArray:
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
