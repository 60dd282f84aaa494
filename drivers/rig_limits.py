"""What a rig can reach and how fast: axis, travel, speeds, spacings and optics as values; knows no device and no file.

Stage positions are millimetres everywhere. On a turntable a position is the arc at `radius_mm`, the radius for which
line spacings are stated: position = angle * radius. `Rig.part_from_sensor` turns a position into a pose for both.
"""

import math
from dataclasses import dataclass
from enum import StrEnum

from drivers.scanline import SensorGeometry

Interval = tuple[float, float]
"""(lowest, highest)."""
_SPACING_SLACK = 0.01
"""Share by which an ordered line spacing may lie beyond what speeds and rates give: people round."""


class AxisKind(StrEnum):
    """How the sensor moves before the part."""

    LINEAR = "linear"
    TURNTABLE = "turntable"
    FREE_POSE = "free_pose"


@dataclass(frozen=True, slots=True)
class RigLimits:
    """The limits within which a pass can be carried out.

    Parameters
    ----------
    axis : a linear axis, a turntable, or a sensor that is put into any pose (arm, robot, hand).
    travel_mm : lowest and highest stage position; (-inf, inf) where nothing ends it: a conveyor, an endless turntable.
    speed_mm_per_s : lowest and highest speed along the travel.
    line_rate_hz : lowest and highest rate of scanlines; what the scanner does.
    geometry : the scanner's optics in the sensor frame, None when only the scanner itself can tell them.
    field_of_view_mm : usable x span in the sensor frame.
    radius_mm : of the turntable, where line spacings are stated; NaN for other axes.
    reach_mm : for a free pose the box (lowest, highest corner) of sensor positions in the part frame, else None.
    is_driven : whether the host moves the stage; False for a conveyor, an encoder, a hand.
    stops_for_lines : whether each line may be measured with the stage at rest (move and measure).

    Raises
    ------
    ValueError : when an interval is not lowest first, or a number cannot be meant.
    """

    axis: AxisKind
    travel_mm: Interval
    speed_mm_per_s: Interval
    line_rate_hz: Interval
    geometry: SensorGeometry | None
    field_of_view_mm: Interval
    radius_mm: float = math.nan
    reach_mm: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    is_driven: bool = True
    stops_for_lines: bool = True

    def __post_init__(self) -> None:
        for name in ("travel_mm", "speed_mm_per_s", "line_rate_hz", "field_of_view_mm"):
            low, high = getattr(self, name)
            if not low <= high:
                raise ValueError(f"{name} must be (lowest, highest), not ({low}, {high})")
        if self.speed_mm_per_s[0] < 0 or self.line_rate_hz[0] < 0:
            raise ValueError("speeds and line rates are 0 or more")
        if (self.axis is AxisKind.TURNTABLE) != (self.radius_mm > 0):
            raise ValueError("a turntable, and nothing else, has a radius greater than 0 at which lines are spaced")

    @property
    def range_mm(self) -> Interval:
        """Usable z span in the sensor frame (measurement range); (NaN, NaN) when unknown."""
        return self.geometry.range_mm if self.geometry is not None else (math.nan, math.nan)

    @property
    def standoff_mm(self) -> Interval:
        """Nearest and farthest distance from the laser's origin, along its axis, at which a surface is measured."""
        if self.geometry is None:
            return (math.nan, math.nan)
        laser_z_mm = float(self.geometry.laser_mm[2])
        low, high = self.geometry.range_mm
        return (laser_z_mm - high, laser_z_mm - low)

    @property
    def line_spacing_mm(self) -> Interval:
        """Finest and coarsest line spacing in continuous motion: speed over line rate, 0 where nothing bounds it."""
        finest = self.speed_mm_per_s[0] / self.line_rate_hz[1] if self.line_rate_hz[1] > 0 else math.nan
        coarsest = self.speed_mm_per_s[1] / self.line_rate_hz[0] if self.line_rate_hz[0] > 0 else math.inf
        return (finest, coarsest)

    def why_not(self, start_mm: float, end_mm: float) -> str | None:
        """Return one sentence on why a pass from `start_mm` to `end_mm` cannot be driven here; None when it can."""
        if not (math.isfinite(start_mm) and math.isfinite(end_mm)):
            return f"a pass needs two finite positions, not {start_mm} and {end_mm}"
        low, high = self.travel_mm
        for name, at_mm in (("start", start_mm), ("end", end_mm)):
            if not low <= at_mm <= high:
                return f"the {name} at {at_mm:g} mm is outside the stage's travel of {low:g} to {high:g} mm"
        return None

    def why_not_spaced(self, order: "PassOrder") -> str | None:
        """Return one sentence on why lines cannot come as far apart as ordered, in motion; None when they can."""
        if order.speed_mm_per_s == 0:
            return None
        slowest, fastest = self.speed_mm_per_s
        if order.speed_mm_per_s > 0:
            slowest = fastest = order.speed_mm_per_s
        lowest_hz, highest_hz = self.line_rate_hz
        finest_mm = slowest / highest_hz if highest_hz > 0 else 0.0
        coarsest_mm = fastest / lowest_hz if lowest_hz > 0 else math.inf
        if finest_mm * (1.0 - _SPACING_SLACK) <= order.line_spacing_mm <= coarsest_mm * (1.0 + _SPACING_SLACK):
            return None
        bound = (
            f"at least {finest_mm:.4g} mm apart: {slowest:g} mm/s at {highest_hz:g}"
            if order.line_spacing_mm < finest_mm
            else f"at most {coarsest_mm:.4g} mm apart: {fastest:g} mm/s at {lowest_hz:g}"
        )
        return f"lines {order.line_spacing_mm:g} mm apart cannot be had; they come {bound} lines a second"


@dataclass(frozen=True, slots=True)
class PassOrder:
    """One pass to be driven: from `start_mm` to `end_mm`, lines `line_spacing_mm` apart.

    `speed_mm_per_s` of 0 moves to each line and measures it at rest; NaN lets the rig choose the fastest speed that
    keeps the spacing.
    """

    start_mm: float
    end_mm: float
    line_spacing_mm: float
    speed_mm_per_s: float = math.nan

    def __post_init__(self) -> None:
        if not (math.isfinite(self.start_mm) and math.isfinite(self.end_mm)):
            raise ValueError(f"a pass needs a finite start and end, not {self.start_mm} and {self.end_mm} mm")
        if self.start_mm == self.end_mm:
            raise ValueError(f"a pass from {self.start_mm:g} mm to {self.end_mm:g} mm has no length")
        if not (math.isfinite(self.line_spacing_mm) and self.line_spacing_mm > 0):
            raise ValueError(f"the line spacing must be greater than 0 mm, not {self.line_spacing_mm}")
        if self.speed_mm_per_s < 0 or math.isinf(self.speed_mm_per_s):
            raise ValueError(f"the speed of a pass must be 0 or more, not {self.speed_mm_per_s}")

    @property
    def line_count(self) -> int:
        """Lines of the pass, both ends included."""
        return lines_between(self.start_mm, self.end_mm, self.line_spacing_mm)

    @property
    def sign(self) -> float:
        """+1 where positions grow along the pass, -1 where they fall."""
        return 1.0 if self.end_mm > self.start_mm else -1.0

    def position_mm(self, number: int) -> float:
        """Return where the line of that number belongs, the first being 0."""
        return self.start_mm + self.sign * number * self.line_spacing_mm


def lines_between(start_mm: float, end_mm: float, line_spacing_mm: float) -> int:
    """Return how many lines lie `line_spacing_mm` apart from `start_mm` towards `end_mm`, both ends included."""
    return math.floor(abs(end_mm - start_mm) / line_spacing_mm + 1e-9) + 1
