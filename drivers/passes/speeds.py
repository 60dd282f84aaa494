"""How fast a pass is driven: speed of the stage, rate of the scanner; numbers only, knows no device."""

import math

from drivers.errors import DriverError
from drivers.rig_limits import PassOrder, RigLimits

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


def stage_speed(limits: RigLimits, order: PassOrder, rate_hz: float) -> float:
    """Return the fastest speed, in mm/s, that keeps the line spacing at a scanner's rate, within the limits."""
    return min(rate_hz * order.line_spacing_mm, limits.speed_mm_per_s[1])
