"""Where a stage is and was, in millimetres of travel, and where it may be after it was out of sight; numbers only."""

import math
from collections import deque

from drivers.protocols.stage_events import Reading
from drivers.rig_limits import Interval
from drivers.stages.face import StageReading

_MAX_READINGS = 10_000
_ASTRAY_MM = 0.1
"""How far from where it may be a stage that was out of sight can stand before its position is called lost."""


class Whereabouts:
    """The readings of one stage; `mm_per_unit` is millimetres of travel in one unit of its controller."""

    def __init__(self, mm_per_unit: float) -> None:
        self._mm_per_unit = mm_per_unit
        self._zero_mm = 0.0  # position of the stage where the controller says 0
        self._readings: deque[StageReading] = deque(maxlen=_MAX_READINGS)
        self._expected_mm: Interval | None = None  # where a stage that is back must be, if nobody moved it
        self.latest: StageReading | None = None
        """The last reading; None before the first."""

    def read(self, reading: Reading) -> str | None:
        """Take in a reading of the controller; return a sentence when the stage stands where it cannot have gone."""
        at_mm = self._zero_mm + reading.position * self._mm_per_unit
        self.latest = StageReading(at_mm, reading.asked_s, reading.arrived_s, reading.is_moving)
        self._readings.append(self.latest)
        expected, self._expected_mm = self._expected_mm, None
        if expected is None or expected[0] - _ASTRAY_MM <= at_mm <= expected[1] + _ASTRAY_MM:
            return None
        return f"it came back at {at_mm:g} mm, where it cannot have gone by itself"

    def take(self) -> list[StageReading]:
        """Return the readings since the last call, in order; the latest 10,000 are kept."""
        taken = list(self._readings)
        self._readings.clear()
        return taken

    def lost_sight(self, target: float | None) -> None:
        """The stage can be read no more: it rests, or is on its way to `target`, which is in the controller's units."""
        if self.latest is None:
            self._expected_mm = None
            return
        places = [self.latest.position_mm]
        if target is not None and math.isfinite(target):
            places.append(self._zero_mm + target * self._mm_per_unit)
        self._expected_mm = (min(places), max(places))

    def found_reference(self) -> None:
        """The controller's own zero counts again."""
        self._zero_mm = 0.0

    def state(self, position_mm: float) -> bool:
        """The user says where the stage is; False when no reading tells what the controller says there."""
        latest = self.latest
        if latest is None:
            return False
        self._zero_mm += position_mm - latest.position_mm
        self.latest = StageReading(position_mm, latest.asked_s, latest.arrived_s, latest.is_moving)
        self._readings.clear()
        return True

    def units(self, position_mm: float) -> float:
        """Return a position in the controller's units."""
        return (position_mm - self._zero_mm) / self._mm_per_unit
