"""Counts and moments of a point's neighbours, exact in any order; fits and judges nothing."""

import numpy as np
from numba import njit

from scanner_service.analysis.gathering import VECTOR

_EXACT = 2.0**52
"""Whole numbers up to here are exact in float64, and so are their sums in any order."""

EXACT_SIDE_Q = 2**23
"""Up to this cell side the squared distance of any two points gathered is such a number."""

EXACT_LINES = 2**19
"""Up to this many scanlines the sums that tell one line from several are, too."""


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def put(sums, column, values):
    """Write the thirteen sums of a point into a column."""
    for i in range(13):
        sums[i, column] = values[i]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def is_in_floats(count, reach, is_exact):
    """True when the sums over so many neighbours are exact in float64; else the integers' sums are taken."""
    return is_exact and count * reach < _EXACT


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def sums_within(points, row, own, local, n, reach, is_exact):
    """The sums of `_sums`, exact for any radius."""
    px, py, pz = points[row].x, points[row].y, points[row].z
    if is_exact:
        sums = _sums(local, n, float(px), float(py), float(pz), float(own), float(reach))
        if is_in_floats(sums[0], reach, is_exact):
            return sums
    return _sums_of_integers(local, n, px, py, pz, own, reach)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True, fastmath={"reassoc", "nsz", "nnan", "contract"})
def _sums(local, n, px, py, pz, own, reach):
    """Counts and moments of the candidates within reach, without a branch, for vector registers.

    Everything is a whole number below 2^53, so that float64 is exact in any order (and nothing is ever NaN).
    """
    count, others, first, second = 0.0, 0.0, 0.0, 0.0
    sx, sy, sz = 0.0, 0.0, 0.0
    sxx, sxy, sxz, syy, syz, szz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    padded = ((n + VECTOR - 1) // VECTOR) * VECTOR
    for k in range(padded):
        x, y, z = local[0, k] - px, local[1, k] - py, local[2, k] - pz
        inside = 1.0 if x * x + y * y + z * z <= reach else 0.0
        x, y, z = x * inside, y * inside, z * inside
        line = (local[3, k] - own) * inside
        count += inside
        others += 1.0 if line != 0.0 else 0.0
        first += line
        second += line * line
        sx += x
        sy += y
        sz += z
        sxx += x * x
        sxy += x * y
        sxz += x * z
        syy += y * y
        syz += y * z
        szz += z * z
    return count, others, first, second, sx, sy, sz, sxx, sxy, sxz, syy, syz, szz


@njit(cache=True, nogil=True, error_model="numpy")
def _sums_of_integers(local, n, px, py, pz, own, reach):
    """The same as `_sums` for any radius and any number of lines, in 64-bit integers; the lines' sums are 0, 1 or 2."""
    count, others = np.int64(0), np.int64(0)
    other_line, several = np.int64(-1), False
    sx, sy, sz = np.int64(0), np.int64(0), np.int64(0)
    sxx, sxy, sxz = np.int64(0), np.int64(0), np.int64(0)
    syy, syz, szz = np.int64(0), np.int64(0), np.int64(0)
    for k in range(n):
        x, y, z = np.int64(local[0, k]) - px, np.int64(local[1, k]) - py, np.int64(local[2, k]) - pz
        if x * x + y * y + z * z <= reach:
            line = np.int64(local[3, k])
            count += 1
            if line != own:
                others += 1
                several = several or (other_line >= 0 and line != other_line)
                other_line = line
            sx += x
            sy += y
            sz += z
            sxx += x * x
            sxy += x * y
            sxz += x * z
            syy += y * y
            syz += y * z
            szz += z * z
    spread = 1.0 if several else 0.0
    return (
        float(count),
        float(others),
        float(others),
        float(others) + spread,
        float(sx),
        float(sy),
        float(sz),
        float(sxx),
        float(sxy),
        float(sxz),
        float(syy),
        float(syz),
        float(szz),
    )
