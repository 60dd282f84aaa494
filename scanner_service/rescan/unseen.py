"""What the other passes have left of a shadow: the widest place in it without a point; judges nothing.

A shadow hides surface between its two ends. Cut through it along the rays that jump: the hidden surface is a curve in
that plane from one end to the other, wherever it goes in between. So the points of other passes near the plane are a
chain from end to end once the surface is seen, whatever the wall and the floor behind the rim look like; until then
the chain breaks, and its widest step is what is left. Two points belong together when their neighbourhoods touch.
Points on surface that the gap's own pass has seen, or on the side it looks from, belong to no such chain.

A cut may also meet two bodies, or the two walls of a hole, with nothing between but air. A step is no surface when what
was measured goes on all around both of its ends, when these look straight at each other, or when rays went through all
of it. The next widest is then asked.
"""

import numpy as np

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.boxes import Boxes
from scanner_service.rescan.cuts import DETOUR, STEPS, find_crossed, find_steps
from scanner_service.rescan.frames import Frames
from scanner_service.rescan.gaps import Gaps
from scanner_service.rescan.stations import IntArray, Stations

NOTHING, AIR = -1, -2
_FACING = 0.7  # cosine: the walls of a hole face each other, and a straight way between them is air
_BORDER = 0.25  # centroid offset, radii: 0.42 where surface ends straight; below, it goes on all around
_COLUMN_MM = 1.0  # side of the columns that points are found by, or ...
_MOST_COLUMNS = 2000  # ... so wide that there are at most so many side by side

_Columns = tuple[Float64Array, IntArray, Float64Array, float, int, int]  # as `cuts` has them


def windows_of(snapshot: MapSnapshot, gaps: Gaps, rows: IntArray, reach_mm: Float64Array) -> Boxes:
    """The boxes in which points may be that some gaps (k,) ask for; `reach_mm` (k,) are their radii."""
    high, low = snapshot.points_mm[gaps.high[rows]], snapshot.points_mm[gaps.low[rows]]
    middle, length = 0.5 * (high + low), np.linalg.norm(high - low, axis=1)
    return Boxes(middle, middle).grown(0.5 * DETOUR * length + reach_mm)


def left_by_others(
    snapshot: MapSnapshot, frames: Frames, stations: Stations, gaps: Gaps, rows: IntArray, reach_mm: Float64Array,
    points: IntArray,
) -> IntArray:  # fmt: skip
    """The ends of what is left of some gaps.

    Parameters
    ----------
    rows : (k,) the gaps, whose ends are those of the jumps.
    reach_mm : (k,) the neighbourhood radius at each.
    points : rows of the points that may show something; all in the windows of the gaps have to be among them.

    Returns
    -------
    (k, 2) rows of the snapshot, the end first that comes first on the way from the gap's upper end. Gaps in whose cut
    no other pass has a point keep their ends. NOTHING where no step of the chain is wider than two radii (or, of a
    short gap, three fifths of it), or those that are have no border; AIR where all that have are air.
    """
    ends = np.stack([gaps.high[rows], gaps.low[rows]], axis=1).astype(np.int64)
    points = points[(snapshot.neighbours[points] > 0) & snapshot.settled[points] & ~snapshot.isolated[points]]
    start, end = snapshot.points_mm[ends[:, 0]], snapshot.points_mm[ends[:, 1]]
    way, normal, group = _unit(end - start), _normals(snapshot, frames, gaps, rows), gaps.group[rows]
    kept, columns = _in_columns(snapshot, points)
    steps, alone = np.repeat(ends[:, None], STEPS, axis=1), np.zeros(len(rows), dtype=np.bool_)
    find_steps(
        columns, kept, stations.group[snapshot.line[kept]], snapshot.normals[kept], ~(snapshot.offset < _BORDER),
        start, end, way, normal, group, reach_mm, steps, alone,
    )  # fmt: skip
    gap, place = np.nonzero((steps[:, :, 0] >= 0) & ~alone[:, None])
    middle, half = 0.5 * (start + end)[gap], 0.5 * DETOUR * np.linalg.norm(end - start, axis=1)[gap]
    air = np.zeros((len(rows), STEPS), dtype=np.bool_)
    air[gap, place] = _is_air(snapshot, kept, columns, steps[gap, place], normal[gap], reach_mm[gap], middle, half)
    is_left: BoolArray = (steps[:, :, 0] >= 0) & ~air
    left = steps[np.arange(len(rows)), is_left.argmax(axis=1)]
    left[~is_left.any(axis=1)] = NOTHING
    left[~is_left.any(axis=1) & air.any(axis=1)] = AIR
    return np.where(alone[:, None], ends, left)


def open_sides(snapshot: MapSnapshot, frames: Frames, gaps: Gaps, rows: IntArray, ends: IntArray) -> Float64Array:
    """(k, 3) unit ways from what is left of gaps `rows`, `ends` as `left_by_others` has them, to where it is open.

    They are perpendicular to the straight way between the ends, within the cut.
    """
    way = _unit(snapshot.points_mm[ends[:, 1]] - snapshot.points_mm[ends[:, 0]])
    return np.cross(way, _normals(snapshot, frames, gaps, rows))


def nearer_first(snapshot: MapSnapshot, gaps: Gaps, rows: IntArray, ends: IntArray) -> IntArray:
    """The ends (k, 2) of what is left of gaps `rows`, the one nearer to the gap's laser first."""
    lasers = snapshot.lines.laser_mm[gaps.line[rows]]
    away = np.linalg.norm(snapshot.points_mm[ends] - lasers[:, None], axis=2)
    return np.where((away[:, 0] > away[:, 1])[:, None], ends[:, ::-1], ends)


def _normals(snapshot: MapSnapshot, frames: Frames, gaps: Gaps, rows: IntArray) -> Float64Array:
    """(k, 3) unit normals of the cuts, such that what a gap hides lies along normal x way from its upper end."""
    way = _unit(snapshot.points_mm[gaps.low[rows]] - snapshot.points_mm[gaps.high[rows]])
    along, axis = frames.of_lines(snapshot.lines, gaps.line[rows], gaps.group[rows])
    aside = np.where(gaps.across[rows, None], along, np.cross(along, axis))
    normal = _unit(aside - way * np.einsum("ij,ij->i", aside, way)[:, None])
    towards_seen = np.einsum("ij,ij->i", np.cross(normal, way), _onward(snapshot, gaps, rows))
    return np.where(towards_seen[:, None] > 0, -normal, normal)


def _onward(snapshot: MapSnapshot, gaps: Gaps, rows: IntArray) -> Float64Array:
    """(k, 3) the way from the ray of the upper end to that of the lower: where it goes on to, the pass has seen."""
    high, low = gaps.high[rows], gaps.low[rows]
    lasers = snapshot.lines.laser_mm[snapshot.line[high]], snapshot.lines.laser_mm[snapshot.line[low]]
    rays = _unit(snapshot.points_mm[high] - lasers[0]), _unit(snapshot.points_mm[low] - lasers[1])
    return np.asarray(np.where(gaps.across[rows, None], lasers[1] - lasers[0], rays[1] - rays[0]))


def _is_air(
    snapshot: MapSnapshot, kept: IntArray, columns: _Columns, steps: IntArray, normal: Float64Array,
    reach_mm: Float64Array, middle_mm: Float64Array, half_mm: Float64Array,
) -> BoolArray:  # fmt: skip
    """(k,) True for steps, rows (k, 2), whose ends look straight at each other, or that rays to points `kept` cross."""
    first, last = snapshot.points_mm[steps[:, 0]], snapshot.points_mm[steps[:, 1]]
    way = _unit(last - first)
    facing = np.einsum("ij,ij->i", way, snapshot.normals[steps[:, 0]]) > _FACING
    facing &= np.einsum("ij,ij->i", way, snapshot.normals[steps[:, 1]]) < -_FACING
    crossed = np.zeros(len(steps), dtype=np.bool_)
    lines, lasers = snapshot.line[kept], snapshot.lines.laser_mm.copy()  # the lines' own may not be written to
    find_crossed(columns, lines, lasers, first, last, normal, reach_mm, middle_mm, half_mm, crossed)
    return np.asarray(facing | crossed)


def _in_columns(snapshot: MapSnapshot, points: IntArray) -> tuple[IntArray, _Columns]:
    """Some points in the order of the columns they lie in, and these."""
    places = snapshot.points_mm[points]
    low = places.min(axis=0)[:2] if len(points) else np.zeros(2)
    side = max(_COLUMN_MM, float((places[:, :2] - low).max(initial=0.0)) / _MOST_COLUMNS)
    at = np.floor((places[:, :2] - low) / side).astype(np.int64)
    many_x, many_y = (int(one) + 1 for one in at.max(axis=0, initial=0))
    column = at[:, 0] * many_y + at[:, 1]
    begin = np.concatenate([[0], np.cumsum(np.bincount(column, minlength=many_x * many_y))])
    order = np.argsort(column, kind="stable")
    return points[order], (places[order], begin, low, side, many_x, many_y)


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))
