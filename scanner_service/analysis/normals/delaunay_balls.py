"""The largest Delaunay ball at each point, and the outside as a ball without end; knows no normal's quality."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, QhullError

from drivers.scanline import Float64Array
from scanner_service.analysis.errors import MethodRefused
from scanner_service.analysis.normals.field import Int64Array

MIN_POINTS = 5
MAX_POINTS = 2_000_000
_FLAT = 1e-12


@dataclass(frozen=True, slots=True)
class LargestBalls:
    """For n points: direction (n, 3) to the centre of the largest Delaunay ball, and its radius (n,) in mm.

    The centre is the farthest Voronoi vertex of the point's cell, since the corners of a tetrahedron lie on its ball.
    On the convex hull the cell is unbounded: the radius is infinite, and the direction is the mean outward one of the
    hull's facets there, weighted by their areas. Points without a cell have NaN.
    """

    direction: Float64Array
    radius_mm: Float64Array


def largest_balls(points_mm: Float64Array) -> LargestBalls:
    """The largest Delaunay ball at each of the points (n, 3).

    Raises
    ------
    MethodRefused : the points lie in a plane, on a line or in one place, or are more than can be triangulated.
    """
    n = len(points_mm)
    if n > MAX_POINTS:
        raise MethodRefused(
            f"at most {MAX_POINTS:,} points are triangulated, not {n:,}: use a method that works locally"
        )
    centred = points_mm - points_mm.mean(axis=0)
    extent = float(np.abs(centred).max())
    spread = np.linalg.svd(centred, compute_uv=False)
    if n < MIN_POINTS or not extent > 0.0 or spread[2] <= _FLAT * spread[0]:
        raise MethodRefused(
            "the points lie in a plane or on a line, so they have no Delaunay tetrahedra: use a method that fits planes"
        )
    try:
        mesh = Delaunay(centred / extent)
    except QhullError:
        raise MethodRefused(
            "the points cannot be triangulated (too flat, doubled, or with an outlier too far away): use a method that "
            "fits planes, or remove outliers"
        ) from None
    scaled = centred / extent
    corners = np.asarray(mesh.simplices, dtype=np.int64)
    centre, radius = _circumscribed(scaled, corners)
    direction = np.full((n, 3), np.nan)
    reach = np.full(n, np.nan)
    known = np.isfinite(radius)
    order = np.flatnonzero(known)[np.argsort(radius[known], kind="stable")]
    last = np.full(n, -1, dtype=np.int64)
    last[corners[order].ravel()] = np.repeat(order, 4)  # of equal rows the last, largest one stays
    has_ball = last >= 0
    towards = centre[last[has_ball]] - scaled[has_ball]
    direction[has_ball] = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    reach[has_ball] = radius[last[has_ball]] * extent
    outward = _outward(scaled, np.asarray(mesh.convex_hull, dtype=np.int64))
    on_hull = np.isfinite(outward).all(axis=1)
    direction[on_hull] = outward[on_hull]
    reach[on_hull] = np.inf
    return LargestBalls(direction, reach)


def _circumscribed(points: Float64Array, corners: Int64Array) -> tuple[Float64Array, Float64Array]:
    """Centres (t, 3) and radii (t,) of the balls through four points each; infinite radius for flat tetrahedra."""
    a = points[corners[:, 0]]
    b, c, d = (points[corners[:, i]] - a for i in (1, 2, 3))
    cross_cd, cross_db, cross_bc = np.cross(c, d), np.cross(d, b), np.cross(b, c)
    double = 2.0 * (b * cross_cd).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        square = [(side * side).sum(axis=1, keepdims=True) for side in (b, c, d)]
        offset = (square[0] * cross_cd + square[1] * cross_db + square[2] * cross_bc) / double[:, None]
        radius = np.sqrt((offset * offset).sum(axis=1))
    return a + offset, np.where(np.isfinite(radius), radius, np.inf)


def _outward(points: Float64Array, facets: Int64Array) -> Float64Array:
    """Mean outward direction (n, 3) of the hull's facets at each point, weighted by area; NaN off the hull."""
    a, b, c = (points[facets[:, i]] for i in range(3))
    area = np.cross(b - a, c - a)
    middle = points[np.unique(facets)].mean(axis=0)
    area *= np.sign((area * (a - middle)).sum(axis=1))[:, None]
    total = np.zeros_like(points)
    for corner in range(3):
        np.add.at(total, facets[:, corner], area)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(total / np.where(length > 0.0, length, np.nan))
