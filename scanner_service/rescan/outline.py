"""Outline and area of a patch of surface given by points: an alpha shape; knows no scan and no reason.

The points are triangulated (Delaunay) on the plane that fits them best, or where they lie near no plane as the scanner
sees them. A triangle belongs to the patch when its circumradius in space is at most the connection length of one of
its corners (Edelsbrunner & Mücke 1994, with a length for each point, since scanlines are further apart than points).
The area is that of the triangles in space. Points that no triangle holds stand for a square of the point spacing each,
so that a single strand of a scanline has an area. Islets and pinholes smaller than a square of the connection length
count with their area, but have no loop.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, QhullError

from drivers.scanline import Float64Array
from scanner_service.rescan.stations import IntArray

_MANY = 20_000  # points beyond which a patch is thinned to one a cube of the connection length
_FLAT = 1e-6  # extents below this share of the longest are no extent: the points are collinear

_STRIP = 0.3  # root mean square width in point spacings above which points are more than a strand


@dataclass(frozen=True, slots=True)
class Patch:
    """A patch of surface: closed `loops` of (k, 3) points (the last point is not repeated), area, fitted plane.

    `normal` (3,) is the unit normal of the plane without a sign, NaN where the points do not lie near a plane.
    """

    loops: tuple[Float64Array, ...]
    area_mm2: float
    centroid_mm: Float64Array
    normal: Float64Array


def patch_of(
    points_mm: Float64Array,
    connection_mm: Float64Array,
    spacing_mm: Float64Array,
    unfolded_mm: Float64Array | None = None,
) -> Patch:
    """Outline the patch that points (n, 3), n >= 1, form.

    Parameters
    ----------
    connection_mm : (n,) how far from each point the surface is taken to go on.
    spacing_mm : (n,) point spacing, for strands that have no triangle.
    unfolded_mm : (n, 2) coordinates in which the patch does not fold, such as ray and line of a scan; None takes the
        plane that fits best, onto which a bent patch may fold.
    """
    centroid = points_mm.mean(axis=0)
    if len(points_mm) > _MANY:
        cube_mm = float(np.median(connection_mm))
        x, y, z = np.floor((points_mm - points_mm.min(axis=0)) / cube_mm).astype(np.int64).T
        order = np.lexsort((z, y, x))
        fresh = np.ones(len(order), dtype=bool)
        fresh[1:] = (np.diff(x[order]) != 0) | (np.diff(y[order]) != 0) | (np.diff(z[order]) != 0)
        one_each = np.sort(order[fresh])
        points_mm, spacing_mm = points_mm[one_each], spacing_mm[one_each]
        unfolded_mm = None if unfolded_mm is None else unfolded_mm[one_each]
        connection_mm = connection_mm[one_each] + cube_mm
    _, extent, axes = np.linalg.svd(points_mm - centroid, full_matrices=False)
    half = 0.5 * float(np.median(spacing_mm))
    normal = np.full(3, np.nan)
    if len(points_mm) < 3 or extent[1] <= _FLAT * extent[0]:
        return Patch(*_strand(points_mm, centroid, axes, half), centroid, normal)
    across_mm = float(extent[1]) / np.sqrt(len(points_mm))
    if extent[2] <= 0.2 * extent[1] and across_mm > _STRIP * 2.0 * half:  # a single strand has no plane but its noise
        normal = axes[2]
    flat = unfolded_mm is None or bool(np.isfinite(normal).all())
    plane = (points_mm - centroid) @ axes[:2].T if flat or unfolded_mm is None else unfolded_mm
    try:
        simplices = Delaunay(plane).simplices.astype(np.int64)
    except QhullError:
        return Patch(*_strand(points_mm, centroid, axes, half), centroid, normal)
    kept, areas = _kept_triangles(points_mm, simplices, connection_mm, flat)
    if not len(kept):
        return Patch(*_strand(points_mm, centroid, axes, half), centroid, normal)
    alone = np.setdiff1d(np.arange(len(points_mm)), kept)
    area = float(areas.sum() + (spacing_mm[alone] ** 2).sum())
    loops = [points_mm[loop] for loop in _loops(kept)]
    return Patch(_drawn(loops, float(np.median(connection_mm)) ** 2), area, centroid, normal)


def _strand(
    points_mm: Float64Array, centroid: Float64Array, axes: Float64Array, half_mm: float
) -> tuple[tuple[Float64Array, ...], float]:
    """The rectangle around points in a row: their length by one point spacing, half a spacing beyond either end."""
    along, aside = axes[0], axes[1] if len(axes) > 1 else np.roll(axes[0], 1)
    aside = aside - along * (aside @ along)
    aside /= np.linalg.norm(aside)
    t = (points_mm - centroid) @ along
    low, high = t.min() - half_mm, t.max() + half_mm
    corners = [(low, -half_mm), (high, -half_mm), (high, half_mm), (low, half_mm)]
    return (np.array([centroid + a * along + b * aside for a, b in corners]),), float((high - low) * 2 * half_mm)


def _kept_triangles(
    points_mm: Float64Array, simplices: IntArray, connection_mm: Float64Array, flat: bool
) -> tuple[IntArray, Float64Array]:
    """Triangles within the connection length of a corner, and their areas in space.

    On a plane that is a triangle whose circumradius is. Unfolded, triangles are as thin in space as the surface is
    steep, and their circumradius says nothing: then the longest side may be that of an equilateral one.
    """
    a, b, c = (points_mm[simplices[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    sides = np.stack([np.linalg.norm(b - a, axis=1), np.linalg.norm(c - b, axis=1), np.linalg.norm(a - c, axis=1)])
    connection = connection_mm[simplices].max(axis=1)
    keep = sides.prod(axis=0) <= 4.0 * area * connection if flat else sides.max(axis=0) <= np.sqrt(3.0) * connection
    return simplices[keep], area[keep]


def _loops(triangles: IntArray) -> list[IntArray]:
    """Closed walks along the edges that belong to one triangle only; no walk visits a vertex twice."""
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    base = int(edges.max()) + 1
    key, back = edges[:, 0] * base + edges[:, 1], edges[:, 1] * base + edges[:, 0]
    onward: dict[int, list[int]] = {}
    for start, end in edges[~np.isin(key, back)].tolist():
        onward.setdefault(start, []).append(end)
    loops = []
    while onward:
        walk: list[int] = []
        place: dict[int, int] = {}
        here = next(iter(onward))
        while here not in place:
            place[here] = len(walk)
            walk.append(here)
            here = _step(onward, here)
            if here in place:  # what was walked since is a loop of its own; the rest goes on from here
                at = place[here]
                loops.append(np.array(walk[at:], dtype=np.int64))
                for vertex in walk[at:]:
                    del place[vertex]
                del walk[at:]
                if not walk and here not in onward:
                    break
    return sorted(loops, key=len, reverse=True)


def _drawn(loops: list[Float64Array], least_mm2: float) -> tuple[Float64Array, ...]:
    """The loops that enclose at least an area, and the largest one: islets and pinholes are not worth a line."""
    areas = []
    for loop in loops:
        arms = loop - loop[0]
        areas.append(0.5 * float(np.linalg.norm(np.cross(arms[:-1], arms[1:]).sum(axis=0))))
    largest = max(areas)
    return tuple(loop for loop, area in zip(loops, areas, strict=True) if area >= least_mm2 or area == largest)


def _step(onward: dict[int, list[int]], here: int) -> int:
    """Take one edge that leaves `here` out of the store, and say where it leads."""
    ends = onward[here]
    there = ends.pop()
    if not ends:
        del onward[here]
    return there
