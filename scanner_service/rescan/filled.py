"""Shadows of one pass behind which other passes have seen; knows ends and points, judges no surface.

Behind a shadow a wall goes down from its upper end, and the surface of its lower end goes on to the foot of that wall.
Whoever has seen the one need not have seen the other: the wall of a pocket may be measured, and half of its floor not.
"""

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.stations import IntArray, Stations

SIGHT = 1.35
"""No point further than so many half lengths of a gap from its middle tells of it."""
_NEARER = 0.45  # of a length: nearer to its middle than its ends are
_ALONG = 0.1  # of the straight way, for surface that lies along it
_LEAST_RADII = 0.5


def seen_by_others(
    snapshot: MapSnapshot, stations: Stations, high: IntArray, low: IntArray, others: IntArray
) -> BoolArray:
    """True for shadows (g,) whose hidden surface other passes have seen.

    Both wall and floor must have points of other passes about their middles, unless they are shorter than the
    neighbourhood; or there are points about the middle of the straight way from end to end.

    Parameters
    ----------
    high, low : (g,) rows of the ends, `high` nearer to the laser. The floor is the tangent plane of the lower end;
        without a normal it is across the ray.
    others : rows of the points that may tell; those further than `SIGHT` half lengths away are not looked for.
    """
    seen = np.zeros(len(high), dtype=bool)
    others = others[snapshot.neighbours[others] > 0]
    of_gap, of_other = stations.group[snapshot.line[high]], stations.group[snapshot.line[others]]
    for number in np.unique(of_gap):
        mine, points = np.flatnonzero(of_gap == number), snapshot.points_mm[others[of_other != number]]
        if not len(points):
            continue
        tree, radius_mm = cKDTree(points), snapshot.radius_mm[low[mine]]
        top, bottom = snapshot.points_mm[high[mine]], snapshot.points_mm[low[mine]]
        up = _facing(snapshot, low[mine])
        foot = top - np.einsum("ij,ij->i", top - bottom, up)[:, None] * up
        wall, floor = (
            _is_seen(tree, end, foot, _NEARER, 0.0) | (_length(end, foot) < radius_mm) for end in (top, bottom)
        )
        seen[mine] = (wall & floor) | _is_seen(tree, top, bottom, _ALONG, _LEAST_RADII * radius_mm)
    return seen


def _is_seen(
    tree: cKDTree, start: Float64Array, end: Float64Array, nearer: float, least_mm: Float64Array | float
) -> BoolArray:
    """Whether points lie about the middles of some ways."""
    away, _ = tree.query(0.5 * (start + end))
    return np.asarray(away < np.maximum(nearer * _length(start, end), least_mm))


def _length(start: Float64Array, end: Float64Array) -> Float64Array:
    return np.asarray(np.linalg.norm(end - start, axis=1))


def _facing(snapshot: MapSnapshot, rows: IntArray) -> Float64Array:
    """The normals of points, the way to their laser where there is none."""
    to_laser = snapshot.lines.laser_mm[snapshot.line[rows]] - snapshot.points_mm[rows]
    to_laser /= np.linalg.norm(to_laser, axis=1, keepdims=True)
    normals = snapshot.normals[rows]
    return np.where(np.isfinite(normals), normals, to_laser)
