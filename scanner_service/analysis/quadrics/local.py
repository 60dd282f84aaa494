"""Local quadrics at every point of a cloud, over a radius that grows until the fit has enough points; knows no file."""

import math

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.field import Int64Array, Tell, tell_nobody
from scanner_service.analysis.normals.neighbourhoods import Neighbourhoods, by_radius
from scanner_service.analysis.quadrics import bivariate, general
from scanner_service.analysis.quadrics.bivariate import curvatures_at, fit_bivariate, foot_of_origin, frame_at
from scanner_service.analysis.quadrics.field import QuadricField, QuadricKind, QuadricReason
from scanner_service.analysis.snapshot import UInt8Array

FIRST_RADIUS_MM = 0.1
"""Where the radius starts to grow (Ohtake et al. 2003)."""

SPARE_POINTS = 9
"""Points beyond the number of coefficients, against noise and uneven sampling."""

NEEDED: dict[QuadricKind, int] = {"bivariate": bivariate.COEFFICIENTS, "general": general.COEFFICIENTS}
_REACHES = 1.0 + 1e-12


def local_quadrics(
    points_mm: Float64Array,
    kind: QuadricKind = "bivariate",
    *,
    first_radius_mm: float = FIRST_RADIUS_MM,
    spare_points: int = SPARE_POINTS,
    radius_mm: Float64Array | None = None,
    max_radius_mm: float = math.inf,
    tell: Tell = tell_nobody,
) -> QuadricField:
    """Quadrics fitted to the neighbourhood of every point (n, 3), with curvatures and distance.

    The radius starts at `first_radius_mm` and grows until it covers 6 points for a bivariate quadratic, 10 for a
    general quadric, and `spare_points` more, at most to `max_radius_mm`; `radius_mm` (n,) states it instead.

    Raises
    ------
    ValueError : a kind or length that cannot be meant.
    MethodRefused : a stated radius holds too many points.
    """
    if kind not in NEEDED:
        raise ValueError(f"the quadric must be bivariate or general, not {kind}")
    if not (first_radius_mm > 0 and spare_points >= 0 and max_radius_mm > 0):
        raise ValueError("a radius must be greater than 0 mm, and the number of spare points 0 or more")
    points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 3)
    n = len(points)
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    answer = _Fits(n)
    answer.reason[:] = QuadricReason.NOT_FINITE
    answer.reason[finite] = QuadricReason.TOO_FEW
    needed = NEEDED[kind] + spare_points
    if len(finite) >= needed:
        kept = np.ascontiguousarray(points[finite])
        tree = cKDTree(kept)
        if radius_mm is None:
            reach = np.asarray(tree.query(kept, k=[needed])[0])[:, 0] * _REACHES
            radii = np.minimum(np.maximum(reach, first_radius_mm), max_radius_mm)
        else:
            radii = np.asarray(radius_mm, dtype=np.float64)[finite]
            if not (np.isfinite(radii).all() and (radii > 0).all()):
                raise ValueError("every stated radius must be a number greater than 0 mm")
        for some in by_radius(tree, kept, radii):
            part = _fit_bivariate(kept, some) if kind == "bivariate" else _fit_general(kept, some)
            part.reason[np.diff(some.starts) < NEEDED[kind]] = QuadricReason.TOO_FEW
            part.put_into(answer, finite[some.at])
            tell((int(some.at[-1]) + 1) / len(kept))
    lost = answer.reason != QuadricReason.GIVEN
    for values in (answer.curvature, answer.direction, answer.normals, answer.distance, answer.residual):
        values[lost] = np.nan
    return QuadricField(
        kind,
        answer.curvature,
        answer.direction,
        answer.normals,
        answer.distance,
        answer.residual,
        answer.radius,
        answer.neighbours,
        answer.reason,
    )


class _Fits:
    """Arrays that are filled piece by piece, as QuadricField has them."""

    def __init__(self, n: int) -> None:
        self.curvature = np.full((n, 2), np.nan)
        self.direction = np.full((n, 2, 3), np.nan)
        self.normals = np.full((n, 3), np.nan)
        self.distance = np.full(n, np.nan)
        self.residual = np.full(n, np.nan)
        self.radius = np.full(n, np.nan)
        self.neighbours: Int64Array = np.zeros(n, dtype=np.int64)
        self.reason: UInt8Array = np.zeros(n, dtype=np.uint8)

    def put_into(self, whole: "_Fits", rows: Int64Array) -> None:
        """Copy this piece to its rows of the whole."""
        for name in vars(self):
            getattr(whole, name)[rows] = getattr(self, name)


def _fit_bivariate(points: Float64Array, some: Neighbourhoods) -> _Fits:
    part = _Fits(len(some.at))
    part.radius[:], part.neighbours[:] = some.radius_mm, np.diff(some.starts)
    _bivariate_everywhere(
        points,
        some.at,
        some.starts,
        some.rows,
        some.radius_mm,
        part.curvature,
        part.direction,
        part.normals,
        part.distance,
        part.residual,
    )
    part.reason[~np.isfinite(part.residual)] = QuadricReason.UNDETERMINED
    return part


def _fit_general(points: Float64Array, some: Neighbourhoods) -> _Fits:
    part = _Fits(len(some.at))
    part.radius[:], part.neighbours[:] = some.radius_mm, np.diff(some.starts)
    coefficients, part.residual = general.fit_general(points, some.at, some.starts, some.rows, some.radius_mm)
    known = np.isfinite(coefficients).all(axis=1)
    origin = np.zeros((int(known.sum()), 3))
    foot = general.feet(coefficients[known], origin)
    part.distance[known] = np.sqrt((foot * foot).sum(axis=1))
    part.curvature[known], part.direction[known], part.normals[known] = general.curvatures(coefficients[known], foot)
    known &= np.isfinite(part.curvature).all(axis=1) & (part.distance <= some.radius_mm)
    part.reason[~known] = QuadricReason.UNDETERMINED
    return part


@njit(cache=True, nogil=True, error_model="numpy")
def _bivariate_everywhere(
    points: Float64Array,
    at: Int64Array,
    starts: Int64Array,
    rows: Int64Array,
    radius: Float64Array,
    curvature: Float64Array,
    direction: Float64Array,
    normals: Float64Array,
    distance: Float64Array,
    residual: Float64Array,
) -> None:
    """One fit a neighbourhood; what cannot be fitted keeps its NaN."""
    frame = np.empty((3, 3))
    coefficients, variances = np.empty(6), np.empty(6)
    for i in range(len(at)):
        some = rows[starts[i] : starts[i + 1]]
        if len(some) < 6 or not radius[i] > 0.0 or not frame_at(points, at[i], some, frame):
            continue
        rms = fit_bivariate(points, at[i], some, radius[i], frame, coefficients, variances)
        if not rms >= 0.0:
            continue
        x, y = foot_of_origin(coefficients, radius[i])
        a, b, c, d, e, f = coefficients
        z = a + b * x + c * y + d * x * x + e * x * y + f * y * y
        zx, zy = b + 2.0 * d * x + e * y, c + e * x + 2.0 * f * y
        k1, k2, x1, y1, x2, y2 = curvatures_at(coefficients, x, y)
        curvature[i, 0], curvature[i, 1] = k1, k2
        z1, z2 = zx * x1 + zy * y1, zx * x2 + zy * y2
        l1, l2 = math.sqrt(x1 * x1 + y1 * y1 + z1 * z1), math.sqrt(x2 * x2 + y2 * y2 + z2 * z2)
        ln = math.sqrt(1.0 + zx * zx + zy * zy)
        for axis in range(3):
            u, v, n = frame[0, axis], frame[1, axis], frame[2, axis]
            direction[i, 0, axis] = (x1 * u + y1 * v + z1 * n) / l1
            direction[i, 1, axis] = (x2 * u + y2 * v + z2 * n) / l2
            normals[i, axis] = (n - zx * u - zy * v) / ln
        distance[i] = math.sqrt(x * x + y * y + z * z)
        residual[i] = rms
