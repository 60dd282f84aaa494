"""The orthogonal distance fit of a plane from exact integer moments; knows no neighbours and no map."""

import math

from numba import njit


@njit(cache=True, nogil=True, inline="never")
def smallest_axis(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float, float, float]:
    """Principal axis of the smallest central moment, and the three moments, of a symmetric 3x3 tensor M.

    Returns (nx, ny, nz, lambda1, lambda2, lambda3) with lambda1 >= lambda2 >= lambda3 >= 0 and a unit axis; all
    moments zero give the z axis. Eqs. 6.7-6.10 (Ahn 2004): the plane's normal is the axis of the smallest moment.

    The eigenvalues come from the trigonometric solution of the characteristic cubic, whose error in the smallest root
    is second order when the two larger ones meet. The axis is the largest cross product of two rows of
    M - lambda3 I. Both hold 1e-6 rad wherever lambda2 - lambda3 >= 1e-3 lambda1.
    """
    scale = max(abs(xx), abs(yy), abs(zz), abs(xy), abs(xz), abs(yz))
    if not scale > 0.0:
        return 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    a, b, c = xx / scale, yy / scale, zz / scale
    d, e, f = xy / scale, xz / scale, yz / scale
    mean = (a + b + c) / 3.0
    a0, b0, c0 = a - mean, b - mean, c - mean
    p2 = (a0 * a0 + b0 * b0 + c0 * c0 + 2.0 * (d * d + e * e + f * f)) / 6.0
    if p2 < 1e-30:
        return 0.0, 0.0, 1.0, mean * scale, mean * scale, mean * scale
    p = math.sqrt(p2)
    half_det = (a0 * (b0 * c0 - f * f) - d * (d * c0 - f * e) + e * (d * f - b0 * e)) / (2.0 * p2 * p)
    angle = math.acos(min(1.0, max(-1.0, half_det))) / 3.0
    large = mean + 2.0 * p * math.cos(angle)
    small = mean + 2.0 * p * math.cos(angle + 2.0943951023931953)

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
    middle = 3.0 * mean - large - small
    if uu < 1e-60:  # the two smaller moments are equal: every direction across the first axis is as good
        small = min(small, middle)
        return 0.0, 0.0, 1.0, large * scale, max(middle, small) * scale, max(0.0, small) * scale
    length = math.sqrt(uu)
    return ux / length, uy / length, uz / length, large * scale, middle * scale, max(0.0, small) * scale
