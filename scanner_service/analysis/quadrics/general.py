"""The general quadric with its 10 coefficients, fitted to many neighbourhoods at once; knows no neighbourhood's choice.

f = c0 + c1 x + c2 y + c3 z + c4 x² + c5 xy + c6 xz + c7 y² + c8 yz + c9 z², in offsets from the point.
"""

import numpy as np
from numba import njit

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.field import Int64Array

COEFFICIENTS = 10
_PREFER_SIMPLE = 1e-11
"""Quadratic terms cost this much more: of surfaces that fit equally well a plane is taken before a pair of planes."""


def fit_general(
    points_mm: Float64Array, at: Int64Array, starts: Int64Array, rows: Int64Array, radius_mm: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Coefficients (m, 10) in offsets in mm from each point, |∇f| being 1 in the mean, and the residual (m,) in mm.

    Minimises Σf² / Σ|∇f|² (Taubin 1991), so that f is nearly the distance from the surface and no constraint excludes
    a shape. `starts` and `rows` list the neighbourhood of each of the rows `at` (m,). NaN where a fit has no answer.
    """
    m = len(at)
    values, gradients = np.zeros((m, 10, 10)), np.zeros((m, 10, 10))
    _accumulate(points_mm, at, starts, rows, radius_mm, values, gradients)
    count = np.diff(starts).astype(np.float64)
    coefficients = np.full((m, 10), np.nan)
    residual = np.full(m, np.nan)
    usable = np.flatnonzero((count >= COEFFICIENTS) & (radius_mm > 0.0))
    if not len(usable):
        return coefficients, residual
    per = (1.0 / count[usable])[:, None, None]
    squares, slopes = values[usable] * per, gradients[usable] * per
    means = squares[:, 0, 1:]
    central = squares[:, 1:, 1:] - means[:, :, None] * means[:, None, :]
    central[:, range(3, 9), range(3, 9)] += _PREFER_SIMPLE
    slope = slopes[:, 1:, 1:]
    slope[:, range(9), range(9)] += 1e-14  # terms that the neighbourhood does not have at all
    lower = np.linalg.cholesky(slope)
    half = np.linalg.solve(lower, central)
    symmetric = np.linalg.solve(lower, np.swapaxes(half, 1, 2))
    ratio, vectors = np.linalg.eigh(0.5 * (symmetric + np.swapaxes(symmetric, 1, 2)))
    nine = np.linalg.solve(np.swapaxes(lower, 1, 2), vectors[:, :, :1])[:, :, 0]
    constant = -(nine * means).sum(axis=1)
    scale = radius_mm[usable]
    ten = np.concatenate([constant[:, None] * scale[:, None], nine[:, :3], nine[:, 3:] / scale[:, None]], axis=1)
    free = np.maximum(count[usable] - (COEFFICIENTS - 1), 1.0)
    coefficients[usable] = ten
    residual[usable] = scale * np.sqrt(np.maximum(ratio[:, 0] - _PREFER_SIMPLE, 0.0) * count[usable] / free)
    return coefficients, residual


def gradient(coefficients: Float64Array, at_mm: Float64Array) -> Float64Array:
    """∇f (m, 3) of quadrics (m, 10) at the places (m, 3)."""
    x, y, z = at_mm.T
    c = coefficients.T
    return np.stack(
        [
            c[1] + 2.0 * c[4] * x + c[5] * y + c[6] * z,
            c[2] + c[5] * x + 2.0 * c[7] * y + c[8] * z,
            c[3] + c[6] * x + c[8] * y + 2.0 * c[9] * z,
        ],
        axis=1,
    )


def value(coefficients: Float64Array, at_mm: Float64Array) -> Float64Array:
    """F (m,) of quadrics (m, 10) at the places (m, 3)."""
    x, y, z = at_mm.T
    c = coefficients.T
    linear = c[0] + c[1] * x + c[2] * y + c[3] * z
    return np.asarray(linear + c[4] * x * x + c[5] * x * y + c[6] * x * z + c[7] * y * y + c[8] * y * z + c[9] * z * z)


def hessian(coefficients: Float64Array) -> Float64Array:
    """Second derivatives (m, 3, 3) of quadrics (m, 10)."""
    c = coefficients.T
    rows = [[2.0 * c[4], c[5], c[6]], [c[5], 2.0 * c[7], c[8]], [c[6], c[8], 2.0 * c[9]]]
    return np.moveaxis(np.array(rows), 2, 0)


def feet(coefficients: Float64Array, at_mm: Float64Array, steps: int = 30) -> Float64Array:
    """The nearest places (m, 3) on quadrics (m, 10) to the places (m, 3), from the near side.

    Newton's method on the conditions foot + t ∇f(foot) = place, f(foot) = 0, starting with steps along the gradient.
    Where it does not arrive the last gradient step stands, which is on the surface but perhaps not nearest.
    """
    foot = at_mm.copy()
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(8):
            slope = gradient(coefficients, foot)
            foot = foot - slope * (value(coefficients, foot) / (slope * slope).sum(axis=1))[:, None]
        begun = foot.copy()
        slope = gradient(coefficients, foot)
        t = ((at_mm - foot) * slope).sum(axis=1) / (slope * slope).sum(axis=1)
        bend = hessian(coefficients)
        system = np.zeros((len(foot), 4, 4))
        right = np.empty((len(foot), 4))
        for _ in range(steps):
            slope = gradient(coefficients, foot)
            system[:, :3, :3] = np.eye(3) + t[:, None, None] * bend
            system[:, :3, 3] = system[:, 3, :3] = slope
            right[:, :3] = at_mm - foot - t[:, None] * slope
            right[:, 3] = -value(coefficients, foot)
            solvable = np.asarray(np.isfinite(system).all(axis=(1, 2)) & np.isfinite(right).all(axis=1))
            solvable[solvable] = np.abs(np.linalg.det(system[solvable])) > 1e-300
            step = np.full((len(foot), 4), np.nan)
            if solvable.any():
                step[solvable] = np.linalg.solve(system[solvable], right[solvable][:, :, None])[:, :, 0]
            foot, t = foot + step[:, :3], t + step[:, 3]
            if not (np.abs(step[:, :3]).max(axis=1, initial=0.0) > 1e-13).any():
                break
        off = np.abs(value(coefficients, foot))
        slope = np.sqrt((gradient(coefficients, foot) ** 2).sum(axis=1))
        away, first = ((foot - at_mm) ** 2).sum(axis=1), ((begun - at_mm) ** 2).sum(axis=1)
        arrived = (
            np.isfinite(foot).all(axis=1) & (off <= 1e-6 * slope * np.sqrt(first) + 1e-12) & (away <= first * 1.0001)
        )
    return np.where(arrived[:, None], foot, begun)


def curvatures(coefficients: Float64Array, foot_mm: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Principal curvatures (m, 2), the larger first, directions (m, 2, 3) and unit normals (m, 3) at places (m, 3).

    The normal is ∇f/|∇f|, the shape operator the Hessian over |∇f| within the tangent plane; positive where the
    surface bends towards the normal (Goldman 2005).
    """
    slope = gradient(coefficients, foot_mm)
    with np.errstate(divide="ignore", invalid="ignore"):
        length = np.sqrt((slope * slope).sum(axis=1))
        normal = slope / length[:, None]
        shape = -hessian(coefficients) / length[:, None, None]
    helper = np.zeros_like(normal)
    helper[np.arange(len(normal)), np.argmin(np.abs(normal), axis=1)] = 1.0
    u = np.cross(normal, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(normal, u)
    tangents = np.stack([u, v], axis=1)
    small = np.einsum("mik,mkl,mjl->mij", tangents, shape, tangents)
    known = np.isfinite(small).all(axis=(1, 2))
    curvature, direction = np.full((len(normal), 2), np.nan), np.full((len(normal), 2, 3), np.nan)
    bends, axes = np.linalg.eigh(small[known])
    curvature[known] = bends[:, ::-1]
    direction[known] = np.einsum("mki,mkl->mil", axes[:, :, ::-1], tangents[known])
    return curvature, direction, normal


@njit(cache=True, nogil=True, error_model="numpy")
def _accumulate(
    points: Float64Array,
    at: Int64Array,
    starts: Int64Array,
    rows: Int64Array,
    radius: Float64Array,
    values: Float64Array,
    gradients: Float64Array,
) -> None:
    """Sums of products of the ten terms, and of their gradients, in offsets over the radius."""
    term = np.empty(10)
    slope = np.zeros((3, 10))
    for i in range(len(at)):
        if not radius[i] > 0.0:
            continue
        per = 1.0 / radius[i]
        for k in range(starts[i], starts[i + 1]):
            x = (points[rows[k], 0] - points[at[i], 0]) * per
            y = (points[rows[k], 1] - points[at[i], 1]) * per
            z = (points[rows[k], 2] - points[at[i], 2]) * per
            term[0], term[1], term[2], term[3] = 1.0, x, y, z
            term[4], term[5], term[6], term[7], term[8], term[9] = x * x, x * y, x * z, y * y, y * z, z * z
            slope[0, 1], slope[0, 4], slope[0, 5], slope[0, 6] = 1.0, 2.0 * x, y, z
            slope[1, 2], slope[1, 5], slope[1, 7], slope[1, 8] = 1.0, x, 2.0 * y, z
            slope[2, 3], slope[2, 6], slope[2, 8], slope[2, 9] = 1.0, x, y, 2.0 * z
            for a in range(10):
                for b in range(a + 1):
                    values[i, a, b] += term[a] * term[b]
                    product = slope[0, a] * slope[0, b] + slope[1, a] * slope[1, b] + slope[2, a] * slope[2, b]
                    gradients[i, a, b] += product
        for a in range(10):
            for b in range(a):
                values[i, b, a] = values[i, a, b]
                gradients[i, b, a] = gradients[i, a, b]
