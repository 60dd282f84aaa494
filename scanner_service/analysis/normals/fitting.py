"""Planes through neighbourhoods, plain or weighted by distance; knows not how the neighbourhoods were chosen."""

from collections.abc import Iterable, Mapping
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from numba import njit

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.field import (
    MIN_NEIGHBOURS,
    Int64Array,
    NormalField,
    NormalReason,
    Tell,
    tell_nobody,
)
from scanner_service.analysis.normals.neighbourhoods import Neighbourhoods
from scanner_service.analysis.plane import smallest_axis


class Weighting(IntEnum):
    """How a point at distance d within a neighbourhood of radius r weighs."""

    EQUAL = 0
    GAUSSIAN = 1
    """exp(-d²/h²), h being WIDTH_SHARE of r (Pauly et al. 2003)."""
    BIWEIGHT = 2
    """(1 - d²/r²)²: smooth down to the rim, where a Gaussian is cut off (Fan and Gijbels 1996)."""


WIDTH_SHARE = 1.0 / 3.0
"""h of the Gaussian weight, as a share of the neighbourhood's radius."""

MIN_SPREAD = 1e-9
"""The second moment must be at least this share of the first; below, the points lie on a line."""


def fit_all(
    method: str,
    points_mm: Float64Array,
    neighbourhoods: Iterable[Neighbourhoods],
    *,
    max_error_rad: float,
    weighting: Weighting = Weighting.EQUAL,
    notes: tuple[str, ...] = (),
    extra: Mapping[str, Float64Array] | None = None,
    tell: Tell = tell_nobody,
) -> NormalField:
    """Planes of least squared orthogonal distance through every neighbourhood (Ahn 2004, Eqs. 6.5 to 6.10).

    Points weigh as `weighting` says. Together the neighbourhoods have each of the points (n, 3) once.

    The predicted error is the asymptotic one of a principal axis, √(λ2 λ3) / ((λ2 - λ3) √(N - 3)) (Anderson 1963),
    N being the effective number of points, (Σw)² / Σw²; it tends to σ/√λ2 on a flat patch.
    """
    n = len(points_mm)
    normals = np.full((n, 3), np.nan)
    reason = np.zeros(n, dtype=np.uint8)
    error = np.full(n, np.nan)
    radius = np.full(n, np.nan)
    counts = np.zeros(n, dtype=np.int64)
    for some in neighbourhoods:
        axes, moments, effective = plane_fits(points_mm, some, weighting)
        count = np.diff(some.starts)
        normals[some.at], reason[some.at], error[some.at] = judge_planes(axes, moments, effective, count, max_error_rad)
        radius[some.at], counts[some.at] = some.radius_mm, count
        tell((int(some.at[-1]) + 1) / n)
    return NormalField(method, normals, reason, error, radius, counts, notes, extra or {})


def judge_planes(
    axes: Float64Array, moments: Float64Array, effective: Float64Array, count: Int64Array, max_error_rad: float
) -> tuple[Float64Array, npt.NDArray[np.uint8], Float64Array]:
    """Normals (m, 3), NaN where none is given, the reason (m,) and the predicted error (m,) of fitted planes."""
    large, middle, small = moments[:, 0], moments[:, 1], moments[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.sqrt(middle * small) / (middle - small) / np.sqrt(effective - 3.0)
    is_flat = (small <= 1e-14 * middle) & (middle > 0.0) & (count > 3)
    error = np.where(is_flat, 0.0, error)
    reason = np.full(len(count), NormalReason.GIVEN, dtype=np.uint8)
    reason[~(error <= max_error_rad)] = NormalReason.UNCERTAIN if max_error_rad < np.inf else NormalReason.GIVEN
    reason[~(middle > MIN_SPREAD * large)] = NormalReason.UNDETERMINED
    reason[count < MIN_NEIGHBOURS] = NormalReason.TOO_FEW
    normals = np.where((reason == NormalReason.GIVEN)[:, None], axes, np.nan)
    return normals, reason, np.where(np.isfinite(error), error, np.nan)


def plane_fits(
    points_mm: Float64Array, some: Neighbourhoods, weighting: Weighting = Weighting.EQUAL
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Axis of the smallest moment (m, 3), moments in mm² (m, 3), largest first, and effective counts (m,)."""
    m = len(some.at)
    axes, moments, effective = np.empty((m, 3)), np.empty((m, 3)), np.empty(m)
    per_square = per_square_of(some.radius_mm, weighting)
    _fit(points_mm, some.at, some.starts, some.rows, int(weighting), per_square, axes, moments, effective)
    return axes, moments, effective


def per_square_of(radius_mm: Float64Array, weighting: Weighting) -> Float64Array:
    """What `weight_of` multiplies squared distances with, 1/mm² (m,); 0 for a neighbourhood of one place."""
    width_mm = WIDTH_SHARE * radius_mm if weighting == Weighting.GAUSSIAN else radius_mm
    with np.errstate(divide="ignore"):
        return np.where(width_mm > 0.0, 1.0 / (width_mm * width_mm), 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def weight_of(weighting: int, square: float, per_square: float) -> float:
    """The weight of a point at that squared distance."""
    if weighting == 0:
        return 1.0
    share = square * per_square
    if weighting == 1:
        return float(np.exp(-share))
    return (1.0 - share) * (1.0 - share) if share < 1.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def plane_of_sums(
    w: float, w2: float, x: float, y: float, z: float, xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[tuple[float, float, float], tuple[float, float, float], float]:
    """Axis, moments and effective count of weighted sums over a neighbourhood; zeros where nothing weighs anything."""
    if w == 0.0:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
    per = 1.0 / w
    nx, ny, nz, a, b, c = smallest_axis(
        xx - x * x * per,
        xy - x * y * per,
        xz - x * z * per,
        yy - y * y * per,
        yz - y * z * per,
        zz - z * z * per,
    )
    return (nx, ny, nz), (a, b, c), w * w / w2


@njit(cache=True, nogil=True, error_model="numpy")
def _fit(
    points: Float64Array,
    at: Int64Array,
    starts: Int64Array,
    rows: Int64Array,
    weighting: int,
    per_square: Float64Array,
    axes: Float64Array,
    moments: Float64Array,
    effective: Float64Array,
) -> None:
    """Moments of offsets from the point itself, centred on their weighted mean; nothing is checked."""
    for i in range(len(at)):
        px, py, pz = points[at[i], 0], points[at[i], 1], points[at[i], 2]
        w = w2 = x = y = z = xx = xy = xz = yy = yz = zz = 0.0
        for k in range(starts[i], starts[i + 1]):
            dx, dy, dz = points[rows[k], 0] - px, points[rows[k], 1] - py, points[rows[k], 2] - pz
            g = weight_of(weighting, dx * dx + dy * dy + dz * dz, per_square[i])
            w += g
            w2 += g * g
            x, y, z = x + g * dx, y + g * dy, z + g * dz
            xx, xy, xz = xx + g * dx * dx, xy + g * dx * dy, xz + g * dx * dz
            yy, yz, zz = yy + g * dy * dy, yz + g * dy * dz, zz + g * dz * dz
        axes[i], moments[i], effective[i] = plane_of_sums(w, w2, x, y, z, xx, xy, xz, yy, yz, zz)
