"""How fast a pass is driven: speed of the stage, rate of the scanner; numbers only, knows no device."""

import math
from collections.abc import Sequence
from itertools import pairwise

from drivers.errors import DriverError
from drivers.rig_limits import PassOrder, RigLimits
from drivers.scanline import Profile

_UNBOUNDED_MM_PER_S = 20.0


def approach_speed(limits: RigLimits) -> float:
    """Return the speed with which a stage goes to where a pass begins: its fastest, 20 mm/s where that is unbounded."""
    highest = limits.speed_mm_per_s[1]
    return highest if math.isfinite(highest) else _UNBOUNDED_MM_PER_S


def line_rate(limits: RigLimits, order: PassOrder) -> float:
    """Return the rate of a scanner that is told one: by the speed ordered, else the fastest within the limits, in Hz.

    Raises
    ------
    DriverError : nothing bounds it.
    """
    if order.speed_mm_per_s > 0:
        return order.speed_mm_per_s / order.line_spacing_mm
    rate_hz = min(limits.line_rate_hz[1], limits.speed_mm_per_s[1] / order.line_spacing_mm)
    if not math.isfinite(rate_hz):
        raise DriverError("give the pass a speed, or line_rate_hz and speed_mm_per_s in the rig file")
    return rate_hz


def line_rate_of(profiles: Sequence[Profile]) -> float | None:
    """Return lines a second by the scanner's own clock, lines that are missing counted in; None of less than three.

    It is that of the middle gap: one that a clock got wrong does not matter. Of two gaps it is the longer one: a stage
    that is too slow by a wrong clock scans finer than asked, one that is too fast would miss what was asked for.
    """
    gaps_s = sorted(
        (later.device_time_s - earlier.device_time_s) / (later.line_index - earlier.line_index)
        for earlier, later in pairwise(profiles)
        if later.line_index > earlier.line_index
    )
    if len(gaps_s) < 2 or not gaps_s[len(gaps_s) // 2] > 0:
        return None
    return 1.0 / gaps_s[len(gaps_s) // 2]


def stage_speed(limits: RigLimits, order: PassOrder, rate_hz: float) -> float:
    """Return the fastest speed, in mm/s, that keeps the line spacing at a scanner's rate, within the limits."""
    return min(rate_hz * order.line_spacing_mm, limits.speed_mm_per_s[1])
