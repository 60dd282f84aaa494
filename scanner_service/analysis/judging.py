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
    """Why the normal of a column is not to be believed, 0 when it is."""
    total, others, first, second = sums[0, i], sums[1, i], sums[2, i], sums[3, i]
    if total < MIN_POINTS:
        return _TOO_FEW
    # `first` and `second` are the sums of (line - own line) and of its square over the points of other lines: these
    # are all of one line when the mean is a whole number and the spread is nothing.
    mean = first / max(others, 1.0)
    one_other = others > 0.0 and mean == math.floor(mean) and second == first * mean
    enough_lines = others > 0.0 and (not one_other or (others >= 2.0 and total - others >= 2.0))
    if rules.needs_lines and not enough_lines:
        return _SINGLE_LINE
    # sigma / sqrt(lambda2) <= limit, sigma the larger of the scanner's noise and the residual, all squared
    to_mm2 = QUANTUM_MM * QUANTUM_MM
    sigma_sq = max(rules.noise_mm * rules.noise_mm, fits[5, i] * to_mm2 / (total - 3.0))
    limit_sq = rules.max_error_rad * rules.max_error_rad
    if not sigma_sq <= limit_sq * fits[4, i] * to_mm2 or fits[4, i] - fits[5, i] < MIN_GAP * fits[3, i]:
        return _ILL_DETERMINED
    return 0
