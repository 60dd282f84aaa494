"""What the other passes have left of a shadow: the widest place in it without a point; judges nothing.

A shadow hides surface between its two ends. Cut through it along the rays that jump: the hidden surface is a curve in
that plane from one end to the other, wherever it goes in between. So the points of all passes near the plane are a
chain from end to end once the surface is seen, whatever the wall and the floor behind the rim look like; until then
the chain breaks, and its widest step is what is left. Two points belong together when their neighbourhoods touch.

A cut may also meet two bodies, or the two walls of a hole, with nothing between but air. The step from one to the
other is no surface when what was measured goes on all around both of its ends, when these look straight at each other,
or when rays went through the step all along it.
"""

import numpy as np

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.boxes import Boxes
from scanner_service.rescan.cuts import AIR, DETOUR, find_crossed, find_widest_steps
from scanner_service.rescan.frames import Frames
from scanner_service.rescan.gaps import Gaps
from scanner_service.rescan.stations import IntArray, Stations

_FACING = 0.7  # cosine: the walls of a hole face each other, and a straight way between them is air
_BORDER = 0.25  # centroid offset, radii: 0.42 where surface ends straight; below, it goes on all around
_COLUMN_MM = 1.0  # side of the columns that points are found by, or ...
_MOST_COLUMNS = 2000  # ... so wide that there are at most so many side by side
_EVERY = 4  # one return of so many in every other line is asked for its ray

_Columns = tuple[Float64Array, IntArray, Float64Array, float, int, int]
"""Points (n, 3) column by column, where each begins (c + 1,), lowest corner (2,), side, how many in x and in y."""


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
    (k, 2) rows of the snapshot, the end nearer to the gap's own laser first. NOTHING where nothing is left, AIR where
    what is left is no surface. Gaps near which no other pass has a point keep their ends.
    """
    ends = np.stack([gaps.high[rows], gaps.low[rows]], axis=1).astype(np.int64)
    points = points[(snapshot.neighbours[points] > 0) & snapshot.settled[points] & ~snapshot.isolated[points]]
    if not len(points) or not len(rows):
        return ends
    group = gaps.group[rows]
    start, end = snapshot.points_mm[ends[:, 0]], snapshot.points_mm[ends[:, 1]]
    way = _unit(end - start)
    aside = np.where(gaps.across[rows, None], frames.along[group], np.cross(frames.along[group], frames.axis[group]))
    normal = _unit(aside - way * np.einsum("ij,ij->i", aside, way)[:, None])
    kept, columns = _in_columns(snapshot, points)
    is_border = ~(snapshot.offset < _BORDER)
    find_widest_steps(
        columns, kept, stations.group[snapshot.line[kept]], is_border, start, end, way, normal, group, reach_mm, ends
    )  # fmt: skip
    found = np.flatnonzero(ends[:, 0] >= 0)
    first, last = snapshot.points_mm[ends[found, 0]], snapshot.points_mm[ends[found, 1]]
    air = _face_each_other(snapshot, ends[found])
    some = (snapshot.index[points] % _EVERY == 0) & (snapshot.lines.line_index[snapshot.line[points]] % 2 == 0)
    kept, columns = _in_columns(snapshot, points[some])
    lasers = snapshot.lines.laser_mm[snapshot.line[kept]]
    middle, half = 0.5 * (start + end)[found], 0.5 * DETOUR * np.linalg.norm(end - start, axis=1)[found]
    find_crossed(columns, lasers, first, last, normal[found], reach_mm[found], middle, half, air)
    ends[found[air]] = AIR
    found, first, last = found[~air], first[~air], last[~air]
    laser = snapshot.lines.laser_mm[gaps.line[rows[found]]]
    turned = found[np.linalg.norm(first - laser, axis=1) > np.linalg.norm(last - laser, axis=1)]
    ends[turned] = ends[turned, ::-1]
    return ends


def _in_columns(snapshot: MapSnapshot, points: IntArray) -> tuple[IntArray, _Columns]:
    """Some points in the order of the columns they lie in, and these."""
    places = snapshot.points_mm[points]
    low = places.min(axis=0)[:2] if len(points) else np.zeros(2)
    side = max(_COLUMN_MM, float((places[:, :2] - low).max(initial=0.0)) / _MOST_COLUMNS)
    at = np.floor((places[:, :2] - low) / side).astype(np.int64)
    wide, long = (int(one) + 1 for one in at.max(axis=0, initial=0))
    column = at[:, 0] * long + at[:, 1]
    order = np.argsort(column, kind="stable")
    start = np.searchsorted(column[order], np.arange(wide * long + 1))
    return points[order], (places[order], start, low, side, wide, long)


def _face_each_other(snapshot: MapSnapshot, ends: IntArray) -> BoolArray:
    """(k,) True where the surface at both ends looks straight at the other one: the walls of a hole."""
    way = _unit(snapshot.points_mm[ends[:, 1]] - snapshot.points_mm[ends[:, 0]])
    facing: BoolArray = np.einsum("ij,ij->i", way, snapshot.normals[ends[:, 0]]) > _FACING
    facing &= np.einsum("ij,ij->i", way, snapshot.normals[ends[:, 1]]) < -_FACING
    return facing


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))
