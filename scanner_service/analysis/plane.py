"""The orthogonal distance fit of a plane from exact moments; knows no neighbours and no map."""

import math

import numpy as np
import numpy.typing as npt
from numba import njit

_CLOSE = 1e-15
_THIRD = 0.34  # the smallest of three moments is at most a third of their sum


@njit(cache=True, nogil=True, error_model="numpy")
def smallest_axis(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float, float, float]:
    """Principal axis of the smallest central moment, and the three moments, of a symmetric 3x3 tensor M.

    Returns (nx, ny, nz, lambda1, lambda2, lambda3) with lambda1 >= lambda2 >= lambda3 >= 0 and a unit axis; all
    moments zero give the z axis. Eqs. 6.7-6.10 (Ahn 2004): the plane's normal is the axis of the smallest moment.

    The smallest eigenvalue is the first root of the characteristic cubic. From 0 Newton's method climbs to it without
    ever passing it, in two or three steps on a flat patch; where it climbs slowly, because the roots are close, the
    trigonometric solution takes over. The axis is the longest cross product of two rows of M - lambda3 I. The axis
    holds 1e-6 rad wherever lambda2 - lambda3 >= 1e-3 lambda1, the moments 1e-8 lambda1.
    """
    scale = xx + yy + zz
    if not scale > 0.0:
        return 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    per = 1.0 / scale
    a, b, c = xx * per, yy * per, zz * per
    d, e, f = xy * per, xz * per, yz * per
    # det(M - t I) = -(t^3 - t^2 + q t - w), the trace being 1
    minor = b * c - f * f
    q = a * b - d * d + a * c - e * e + minor
    w = a * minor - d * (d * c - f * e) + e * (d * f - b * e)
    small = 0.0
    climbs = False
    for _ in range(8):
        value = w - small * (q + small * (small - 1.0))
        slope = q + small * (3.0 * small - 2.0)
        if not slope > 0.0:
            break
        step = value / slope
        small += step
        if abs(step) <= _CLOSE + 1e-12 * small:
            climbs = True
            break
    if not climbs or small > _THIRD:  # rounding noise at the start of a line of points can throw it anywhere
        small = _smallest_root(a, b, c, d, e, f)
    small = max(small, 0.0)
    rest = 1.0 - small
    product = max(q - small * rest, 0.0)  # of the two larger roots, whose sum is `rest`
    large = 0.5 * (rest + math.sqrt(max(rest * rest - 4.0 * product, 0.0)))
    middle = max(rest - large, small)

    ra, rb, rc = a - small, b - small, c - small
    # Cross products of the rows (ra, d, e), (d, rb, f), (e, f, rc) of M - lambda3 I; the longest is the best known.
    ux, uy, uz = d * f - e * rb, e * d - ra * f, ra * rb - d * d
    vx, vy, vz = d * rc - e * f, e * e - ra * rc, ra * f - d * e
    wx, wy, wz = rb * rc - f * f, f * e - d * rc, d * f - rb * e
    uu, vv, ww = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
    if vv > uu:
        ux, uy, uz, uu = vx, vy, vz, vv
    if ww > uu:
        ux, uy, uz, uu = wx, wy, wz, ww
    if uu < 1e-60:  # the two smaller moments are equal: every direction across the first axis is as good
        return 0.0, 0.0, 1.0, large * scale, middle * scale, small * scale
    per = 1.0 / math.sqrt(uu)
    return ux * per, uy * per, uz * per, large * scale, middle * scale, small * scale


@njit(cache=True, nogil=True, error_model="numpy")
def _smallest_root(a: float, b: float, c: float, d: float, e: float, f: float) -> float:
    """Smallest eigenvalue by the trigonometric solution; its error is second order where the larger two meet."""
    mean = (a + b + c) / 3.0
    a0, b0, c0 = a - mean, b - mean, c - mean
    p2 = (a0 * a0 + b0 * b0 + c0 * c0 + 2.0 * (d * d + e * e + f * f)) / 6.0
    if p2 < 1e-30:
        return mean
    p = math.sqrt(p2)
    half_det = (a0 * (b0 * c0 - f * f) - d * (d * c0 - f * e) + e * (d * f - b0 * e)) / (2.0 * p2 * p)
    angle = math.acos(min(1.0, max(-1.0, half_det))) / 3.0
    return mean + 2.0 * p * math.cos(angle + 2.0943951023931953)


@njit(cache=True, nogil=True, error_model="numpy")
def fit_planes(sums: npt.NDArray[np.float64], n: int, fits: npt.NDArray[np.float64]) -> None:
    """Fit many planes at once: the same as `smallest_axis`, without a branch, for vector registers.

    No fast-math: fused operations would give a column other last bits in a full register than in the remainder, and
    the answer must not depend on who shares the batch.

    `sums` (13, N) in its first n columns: count, three rows not read here, sums of x, y, z, and of xx xy xz yy yz zz,
    of offsets from the points themselves. `fits` (8, N): axis (3 rows), lambda1, lambda2, lambda3, 1 where Newton's
    method has arrived (elsewhere the column means nothing: call `smallest_axis`), squared offset of the centroid.
    """
    for i in range(n):
        per = 1.0 / sums[0, i]
        x, y, z = sums[4, i], sums[5, i], sums[6, i]
        xx, xy, xz = sums[7, i] - x * x * per, sums[8, i] - x * y * per, sums[9, i] - x * z * per
        yy, yz, zz = sums[10, i] - y * y * per, sums[11, i] - y * z * per, sums[12, i] - z * z * per
        trace = xx + yy + zz
        scale = trace if trace > 0.0 else 1.0
        to_one = 1.0 / scale
        a, b, c = xx * to_one, yy * to_one, zz * to_one
        d, e, f = xy * to_one, xz * to_one, yz * to_one
        minor = b * c - f * f
        q = a * b - d * d + a * c - e * e + minor
        w = a * minor - d * (d * c - f * e) + e * (d * f - b * e)
        small, step = 0.0, 0.0
        for _ in range(5):
            slope = q + small * (3.0 * small - 2.0)
            step = (w - small * (q + small * (small - 1.0))) / (slope if slope > 1e-300 else 1e-300)
            small += step
        near = _CLOSE + 1e-12 * small
        has_arrived = trace > 0.0 and step <= near and step >= -near and small < _THIRD
        small = small if small > 0.0 else 0.0
        rest = 1.0 - small
        spread = rest * rest - 4.0 * (q - small * rest)
        large = 0.5 * (rest + math.sqrt(spread if spread > 0.0 else 0.0))
        middle = rest - large
        middle = middle if middle > small else small

        ra, rb, rc = a - small, b - small, c - small
        ux, uy, uz = d * f - e * rb, e * d - ra * f, ra * rb - d * d
        vx, vy, vz = d * rc - e * f, e * e - ra * rc, ra * f - d * e
        wx, wy, wz = rb * rc - f * f, f * e - d * rc, d * f - rb * e
        uu = ux * ux + uy * uy + uz * uz
        vv = vx * vx + vy * vy + vz * vz
        ww = wx * wx + wy * wy + wz * wz
        is_v = vv > uu
        ux, uy, uz, uu = vx if is_v else ux, vy if is_v else uy, vz if is_v else uz, vv if is_v else uu
        is_w = ww > uu
        ux, uy, uz, uu = wx if is_w else ux, wy if is_w else uy, wz if is_w else uz, ww if is_w else uu
        length = 1.0 / math.sqrt(uu if uu > 1e-60 else 1.0)
        fits[0, i], fits[1, i], fits[2, i] = ux * length, uy * length, uz * length
        fits[3, i], fits[4, i], fits[5, i] = large * scale, middle * scale, small * scale
        fits[6, i] = 1.0 if has_arrived and uu > 1e-60 else 0.0
        fits[7, i] = (x * x + y * y + z * z) * per * per


@njit(cache=True, nogil=True, error_model="numpy")
def fit_column(sums: npt.NDArray[np.float64], fits: npt.NDArray[np.float64], i: int) -> None:
    """Fit the plane of one column, of `fit_planes`, by the solver that always arrives."""
    per = 1.0 / max(sums[0, i], 1.0)
    x, y, z = sums[4, i], sums[5, i], sums[6, i]
    fits[0, i], fits[1, i], fits[2, i], fits[3, i], fits[4, i], fits[5, i] = smallest_axis(
        sums[7, i] - x * x * per,
        sums[8, i] - x * y * per,
        sums[9, i] - x * z * per,
        sums[10, i] - y * y * per,
        sums[11, i] - y * z * per,
        sums[12, i] - z * z * per,
    )
    fits[7, i] = (x * x + y * y + z * z) * per * per
