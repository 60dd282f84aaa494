"""The orthogonal distance fit of a plane from exact moments; knows no neighbours and no map."""

import math

from numba import njit

_CLOSE = 1e-15


@njit(cache=True, nogil=True)
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
    if not climbs:
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


@njit(cache=True, nogil=True)
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
