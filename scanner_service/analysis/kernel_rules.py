"""What the kernels are told of rules, lines and passes; computes nothing but r_max."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from scanner_service.analysis.points import GROWTH_REACH
from scanner_service.analysis.snapshot import UInt8Array


class Rules(NamedTuple):
    """What makes a normal believed, and how far a radius may grow; the same for the whole map.

    With `is_flexible` each point's radius is the distance to its 20th point, between `uncertainty_mm` and
    `max_radius_mm`; otherwise the scanline's rule gave it, and it grows where that is needed.
    """

    needs_lines: bool
    noise_mm: float
    max_error_rad: float
    max_radius_mm: float
    is_flexible: bool
    uncertainty_mm: float


class Lines(NamedTuple):
    """What the kernel reads of scanlines and passes.

    `laser_q` (L, 3) laser positions in quanta from the origin; `pass_bit` (L,) the bit of the line's pass while that
    is open, else 0; `open_bits` (1,) all of these together. For each of the MAX_OPEN_PASSES: `heading` (., 3) the unit
    normal of its laser planes in the direction of travel, NaN when unknown or not steady, and `front_q` (.,) how far
    along it the latest plane lies. `waits` (L,) the bits of the passes that the line's points wait for, 255 when it is
    not known which, 0 when they wait for none.
    """

    laser_q: npt.NDArray[np.float64]
    pass_bit: UInt8Array
    open_bits: UInt8Array
    heading: npt.NDArray[np.float64]
    front_q: npt.NDArray[np.float64]
    waits: UInt8Array


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def radius_limit_mm(base_mm, rules):
    """r_max of a point whose rule gave `base_mm`."""
    if rules.is_flexible:
        return rules.max_radius_mm
    return max(base_mm, min(rules.max_radius_mm, GROWTH_REACH * base_mm))
