"""How curved the surface is across the scanlines, from a quadric fitted around each point; judges nothing.

Around a point the nearest points form z = (a x² + 2 b x y + c y²)/2 + d x + e y + f in the frame of its normal, x
across the scanlines, y along them. The normal curvature across the lines is a / ((1 + d²) sqrt(1 + d² + e²)) (bivariate
quadratic fit, Ohtake et al. 2003; curvature of a graph). It is unknown where there are too few points, where the fit
leaves more than the noise (an edge has no curvature), or where a is not twice its own standard error: then the surface
is as good as flat.
"""

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.stations import IntArray

REACH = 4.0  # radii around a point within which its quadric is fitted
_NEAREST = 60
_LEAST = 12
_CHUNK = 20_000
_NOISE = 3.0  # times the noise that a fit may leave
_SURE = 2.0  # standard errors that a curvature must have to be believed


def curvature_across_per_mm(
    snapshot: MapSnapshot, rows: IntArray, reach_mm: Float64Array, noise_mm: float | None
) -> Float64Array:
    """(k,) curvature across the scanlines at some points, 1/mm, never negative; 0 flat, NaN unknown.

    Parameters
    ----------
    rows : (k,) rows of the snapshot; those without a normal or a laser plane are unknown.
    reach_mm : (n,) radius of every point's rule.
    noise_mm : one standard deviation of the sensor; None takes the median residual of the points.
    """
    found = np.full(len(rows), np.nan)
    counted = np.flatnonzero(snapshot.neighbours > 0)
    if not len(counted) or not len(rows):
        return found
    if noise_mm is None:
        known = snapshot.residual_mm[np.isfinite(snapshot.residual_mm)]
        noise_mm = float(np.median(known)) if len(known) else 0.0
    tree = cKDTree(snapshot.points_mm[counted])
    for start in range(0, len(rows), _CHUNK):
        part = rows[start : start + _CHUNK]
        distance, near = tree.query(snapshot.points_mm[part], k=min(_NEAREST, len(counted)))
        near = np.asarray(near, dtype=np.int64).reshape(len(part), -1)
        inside = np.asarray(distance).reshape(len(part), -1) <= REACH * reach_mm[part][:, None]
        found[start : start + _CHUNK] = _fitted(snapshot, part, counted[near], inside, noise_mm)
    return found


def _fitted(
    snapshot: MapSnapshot,
    rows: IntArray,
    near: IntArray,
    inside: np.ndarray[tuple[int, int], np.dtype[np.bool_]],
    noise_mm: float,
) -> Float64Array:
    """(k,) curvatures of points whose neighbours are `near` (k, q), as far as they are `inside`."""
    n = snapshot.normals[rows]
    along = np.cross(snapshot.lines.plane_normal[snapshot.line[rows]], n)
    length = np.linalg.norm(along, axis=1)
    usable = np.isfinite(length) & (length > 1e-3) & (inside.sum(axis=1) >= _LEAST)
    curvature = np.full(len(rows), np.nan)
    if not usable.any():
        return curvature
    rows, near, inside, n = rows[usable], near[usable], inside[usable], n[usable]
    y_axis = along[usable] / length[usable][:, None]
    x_axis = np.cross(y_axis, n)
    offset = snapshot.points_mm[near] - snapshot.points_mm[rows][:, None]
    x, y, z = (np.einsum("kqj,kj->kq", offset, axis) for axis in (x_axis, y_axis, n))
    scale = np.sqrt((x * x * inside).sum(axis=1) / inside.sum(axis=1))[:, None]
    scale = np.maximum(scale, 1e-9)
    u, v = x / scale, y / scale
    basis = np.stack([0.5 * u * u, u * v, 0.5 * v * v, u, v, np.ones_like(u)], axis=2) * inside[:, :, None]
    normal_matrix = np.einsum("kqi,kqj->kij", basis, basis)
    right = np.einsum("kqi,kq->ki", basis, z)
    spread = np.linalg.eigvalsh(normal_matrix)
    sound = spread[:, 0] > 1e-6 * spread[:, -1]
    normal_matrix[~sound] = np.eye(6)
    inverse = np.linalg.inv(normal_matrix)
    coefficient = np.einsum("kij,kj->ki", inverse, right)
    left = (z - np.einsum("kqi,ki->kq", basis, coefficient)) * inside
    freedom = np.maximum(inside.sum(axis=1) - 6, 1)
    sigma = np.sqrt((left**2).sum(axis=1) / freedom)
    a = coefficient[:, 0] / scale[:, 0] ** 2
    error = np.maximum(sigma, noise_mm) * np.sqrt(np.maximum(inverse[:, 0, 0], 0.0)) / scale[:, 0] ** 2
    d, e = coefficient[:, 3] / scale[:, 0], coefficient[:, 4] / scale[:, 0]
    value = np.abs(a) / ((1.0 + d**2) * np.sqrt(1.0 + d**2 + e**2))
    value = np.where(np.abs(a) >= _SURE * error, value, 0.0)
    # a quadric that leaves more than noise is no quadric: an edge, or two surfaces
    bend = 0.1 * np.abs(a) * scale[:, 0] ** 2
    value[~sound | (sigma > _NOISE * max(noise_mm, 1e-6) + bend)] = np.nan
    curvature[usable] = value
    return curvature
