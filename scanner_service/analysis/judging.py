"""Whether a normal is to be believed; knows no map."""

import math

from numba import njit

from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.snapshot import Unreliable

_TOO_FEW = int(Unreliable.TOO_FEW)
_SINGLE_LINE = int(Unreliable.SINGLE_LINE)
_ILL_DETERMINED = int(Unreliable.ILL_DETERMINED)

MIN_POINTS = 6
"""Fewest points, the point itself counted, from which a normal is believed."""

MIN_GAP = 1e-3
"""A plane is determined where lambda2 - lambda3 >= MIN_GAP * lambda1 (the reach of the 1e-6 rad promise)."""


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def reason_against(sums, fits, i, rules):
    """Why the normal of a column is not to be believed, 0 when it is; without a branch, so that many go at once."""
    total, others, first, second = sums[0, i], sums[1, i], sums[2, i], sums[3, i]
    # `first` and `second` are the sums of (line - own line) and of its square over the points of other lines: these
    # are all of one line when the mean is a whole number and the spread is nothing.
    mean = first / (others if others > 1.0 else 1.0)
    several = (mean != math.floor(mean)) | (second != first * mean)
    has_lines = (others > 0.0) & (several | ((others >= 2.0) & (total - others >= 2.0)))
    # sigma / sqrt(lambda2) <= limit, sigma the larger of the scanner's noise and the residual, all squared
    to_mm2 = QUANTUM_MM * QUANTUM_MM
    limit = rules.max_error_rad * rules.max_error_rad * fits[4, i]
    is_sure = (rules.noise_mm * rules.noise_mm <= limit * to_mm2) & (fits[5, i] <= limit * (total - 3.0))
    is_plane = (fits[4, i] > 0.0) & (fits[4, i] - fits[5, i] >= MIN_GAP * fits[3, i])
    reason = 0 if is_sure & is_plane else _ILL_DETERMINED
    reason = reason if has_lines | (not rules.needs_lines) else _SINGLE_LINE
    return reason if total >= MIN_POINTS else _TOO_FEW


@njit(cache=True, nogil=True, error_model="numpy")
def judge(sums, fits, n, rules, reasons):
    """The reason against each of n columns, put into `reasons`."""
    for i in range(n):
        reasons[i] = reason_against(sums, fits, i, rules)
