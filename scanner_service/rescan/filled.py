"""Shadows of one pass behind which other passes have seen; knows ends and points, judges no surface.

What a shadow hides goes from its upper end to its lower one, and lies between the straight way from end to end and the
corner below: the place on the plane of the lower end that the upper end stands above. Every way from the straight one
into that corner meets it. Whoever has seen some of it need not have seen the rest: the walls of a pocket may be
measured, and half of its floor not.
"""

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.stations import IntArray, Stations

_WAYS = 16  # into the corner, evenly along the straight way
_OPEN = 1  # so many of them may meet no point by chance
_STEPS = 8  # along each
_NEAR = 0.55  # of a step, where that is more than the neighbourhood: no surface slips through between two
_AT_ONCE = 10_000


def seen_by_others(
    snapshot: MapSnapshot, stations: Stations, high: IntArray, low: IntArray, others: IntArray
) -> BoolArray:
    """True for shadows (g,) whose hidden surface other passes have seen.

    Parameters
    ----------
    high, low : (g,) rows of the ends, `high` nearer to the laser. The plane of the lower end is its tangent plane;
        without a normal it is across the ray.
    others : rows of the points that may tell; those further than `sight_mm` from the middle of a gap are not looked
        for.
    """
    seen = np.zeros(len(high), dtype=bool)
    others = others[snapshot.neighbours[others] > 0]
    of_gap, of_other = stations.group[snapshot.line[high]], stations.group[snapshot.line[others]]
    for number in np.unique(of_gap):
        mine, points = np.flatnonzero(of_gap == number), snapshot.points_mm[others[of_other != number]]
        if len(points):
            tree = cKDTree(points)
            for some in np.array_split(mine, max(1, len(mine) // _AT_ONCE)):
                seen[some] = _are_met(snapshot, high[some], low[some], tree)
    return seen


def sight_mm(half_mm: Float64Array, radius_mm: Float64Array) -> Float64Array:
    """(g,) how far from the middle of a gap points tell of it: its corner is on the circle about both ends (Thales)."""
    return half_mm + np.maximum(radius_mm, _NEAR * half_mm / (_STEPS - 1))


def _are_met(snapshot: MapSnapshot, high: IntArray, low: IntArray, tree: cKDTree) -> BoolArray:
    """Whether points lie on nearly all ways into the corners of some gaps."""
    ways = _ways_into_corners(snapshot, high, low)
    step_mm = np.linalg.norm(ways[:, :, 1] - ways[:, :, 0], axis=2)
    near_mm = np.maximum(snapshot.radius_mm[low][:, None], _NEAR * step_mm)
    away_mm, _ = tree.query(ways, distance_upper_bound=float(near_mm.max()))
    is_met = (away_mm < near_mm[:, :, None]).any(axis=2)
    return np.asarray((~is_met).sum(axis=1) <= _OPEN)


def _ways_into_corners(snapshot: MapSnapshot, high: IntArray, low: IntArray) -> Float64Array:
    """Places (g, ways, steps, 3) from the straight way between both ends to the two sides of the corner."""
    top, bottom = snapshot.points_mm[high], snapshot.points_mm[low]
    fall = top - bottom
    length = np.linalg.norm(fall, axis=1)
    up = _facing(snapshot, low)
    height = np.einsum("ij,ij->i", fall, up)
    corner = top - height[:, None] * up
    foot = np.clip(np.einsum("ij,ij->i", corner - bottom, fall) / length**2, 0.0, 1.0)  # of the corner, from below
    inwards = corner - (bottom + foot[:, None] * fall)  # across the straight way
    share = (np.arange(_WAYS) + 0.5) / _WAYS
    with np.errstate(divide="ignore", invalid="ignore"):
        deep = np.fmin(share[None, :] / foot[:, None], (1.0 - share[None, :]) / (1.0 - foot[:, None]))
    start = bottom[:, None, :] + share[None, :, None] * fall[:, None, :]
    steps = np.linspace(0.0, 1.0, _STEPS)
    return np.asarray(start[:, :, None, :] + (deep[:, :, None] * steps)[..., None] * inwards[:, None, None, :])


def _facing(snapshot: MapSnapshot, rows: IntArray) -> Float64Array:
    """The normals of points, the way to their laser where there is none."""
    to_laser = snapshot.lines.laser_mm[snapshot.line[rows]] - snapshot.points_mm[rows]
    to_laser /= np.linalg.norm(to_laser, axis=1, keepdims=True)
    normals = snapshot.normals[rows]
    return np.where(np.isfinite(normals), normals, to_laser)
