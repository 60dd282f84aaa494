"""Which stage position a profile was measured at: interpolated between readings, with an uncertainty; knows no device.

A profile is stamped by the scanner's clock and by its arrival. The arrivals are never earlier than the exposures, so
that the smallest difference between the two clocks is the offset, and the jitter of single arrivals does not matter.
"""

import math
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from drivers.rig_description import Pairing
from drivers.scanline import Profile
from drivers.stages.face import StageReading

MAX_WAITING = 20_000
_MAX_READINGS = 20_000
_DRIFT = 1e-4
_JUMP_S = 1.0
_JUMP_LINES = 20


@dataclass(frozen=True, slots=True)
class StagePosition:
    """Where the stage was, and by how much that may be wrong."""

    position_mm: float
    uncertainty_mm: float


@dataclass(frozen=True, slots=True)
class PairedProfile:
    """A profile and the place of the stage at its exposure."""

    profile: Profile
    at: StagePosition


class ClockOffset:
    """Host's clock minus the scanner's: the smallest difference seen, given that the clocks drift by 1e-4 at most.

    A difference more than 1 s larger in 20 lines on end is a clock that was set anew: the offset is then taken anew,
    and `jumps` counts it.
    """

    def __init__(self) -> None:
        self._offset_s = math.nan
        self._at_s = 0.0
        self._late = 0
        self._device_s = math.nan
        self.period_s = 0.0
        """The shortest time between two profiles by the scanner's clock; 0 before there are two."""
        self.jumps = 0

    def enter(self, device_time_s: float, arrival_s: float) -> None:
        """Take in a profile's two stamps."""
        gap_s, self._device_s = device_time_s - self._device_s, device_time_s
        if gap_s > 0.0:
            self.period_s = min(gap_s, self.period_s) if self.period_s else gap_s
        difference_s = arrival_s - device_time_s
        aged_s = self.offset_s(arrival_s)
        if math.isnan(aged_s) or difference_s <= aged_s:
            self._offset_s, self._at_s, self._late = difference_s, arrival_s, 0
        elif difference_s > aged_s + _JUMP_S:
            self._late += 1
            if self._late >= _JUMP_LINES:
                self._offset_s, self._at_s, self._late = difference_s, arrival_s, 0
                self.jumps += 1
        else:
            self._late = 0

    def offset_s(self, arrival_s: float) -> float:
        """Return the offset in force at a time of the host; NaN before the first profile."""
        return self._offset_s + _DRIFT * max(0.0, arrival_s - self._at_s)

    def exposure_s(self, profile: Profile) -> float:
        """Return when a profile would have arrived without any waiting, by the host's clock."""
        return profile.device_time_s + self.offset_s(profile.arrival_s)


class StageTrack:
    """The readings of a stage, in order; between two of them the position is interpolated.

    Notes
    -----
    The uncertainty adds what the readings themselves may be off, the speed times how uncertain both moments are (a
    reading was taken at some moment between question and answer: it counts twice, for the chord and for its bend, and
    the speed between two readings may be as much higher as they may lie closer), and, for one change of speed between
    two readings, dt/4 times the difference of the speeds before and after: the most by which a line with one corner can
    leave its chord.
    """

    def __init__(self) -> None:
        self._readings: deque[StageReading] = deque(maxlen=_MAX_READINGS)

    def add(self, readings: Iterable[StageReading]) -> None:
        """Take in further readings; one that is not later than its predecessor is passed over."""
        for reading in readings:
            if not self._readings or _middle_s(reading) > _middle_s(self._readings[-1]):
                self._readings.append(reading)

    @property
    def latest(self) -> StageReading | None:
        """The last reading; None before the first."""
        return self._readings[-1] if self._readings else None

    def forget_before(self, time_s: float) -> None:
        """Let go of readings that no later profile needs."""
        while len(self._readings) > 3 and _middle_s(self._readings[2]) < time_s:
            self._readings.popleft()

    def covers(self, time_s: float, *, with_next: bool) -> bool:
        """True when there is a reading behind `time_s`, `with_next` two of them."""
        behind = 2 if with_next else 1
        return len(self._readings) >= behind and _middle_s(self._readings[-behind]) >= time_s

    def begins_after(self, time_s: float) -> bool:
        """True when the first reading is later than `time_s`: no reading will ever lie before it."""
        return bool(self._readings) and _middle_s(self._readings[0]) > time_s

    def at(self, time_s: float, half_width_s: float) -> StagePosition | None:
        """Return the position at `time_s` ± `half_width_s`; None when it does not lie between two readings."""
        after = next((k for k in range(1, len(self._readings)) if _middle_s(self._readings[k]) >= time_s), None)
        if after is None or _middle_s(self._readings[after - 1]) > time_s:
            return None
        a, b = self._readings[after - 1], self._readings[after]
        span_s = _middle_s(b) - _middle_s(a)
        speed = (b.position_mm - a.position_mm) / span_s
        position_mm = a.position_mm + speed * (time_s - _middle_s(a))
        speeds = [speed]
        if after >= 2:
            speeds.append(self._speed(after - 2))
        if after + 1 < len(self._readings):
            speeds.append(self._speed(after))
        reading_s = max(_half_s(a), _half_s(b))
        fastest = max(map(abs, speeds)) * span_s / max(span_s - 2.0 * reading_s, 0.25 * span_s)
        bend_mm = (max(speeds) - min(speeds)) * span_s / 4.0
        own_mm = max(a.uncertainty_mm, b.uncertainty_mm)
        return StagePosition(position_mm, own_mm + fastest * (2.0 * reading_s + half_width_s) + bend_mm)

    def _speed(self, first: int) -> float:
        a, b = self._readings[first], self._readings[first + 1]
        return (b.position_mm - a.position_mm) / (_middle_s(b) - _middle_s(a))


def _middle_s(reading: StageReading) -> float:
    return 0.5 * (reading.asked_s + reading.arrived_s)


def _half_s(reading: StageReading) -> float:
    return 0.5 * (reading.arrived_s - reading.asked_s)


class TimePairing:
    """Profiles of one pass, waiting for the readings around them.

    At any moment `received == paired + waiting + sum(left_out.values())`. Reasons: `no_position` (no two readings lie
    around it), `queue_full` (too many wait for readings that do not come); `on_left_out` is told of each.
    """

    def __init__(
        self, pairing: Pairing, on_left_out: Callable[[Profile, str], None] = lambda _profile, _why: None
    ) -> None:
        self.track = StageTrack()
        self.clock = ClockOffset()
        self.received = self.paired = 0
        self.left_out: Counter[str] = Counter()
        self._pairing = pairing
        self._on_left_out = on_left_out
        self._waiting: deque[Profile] = deque()

    @property
    def waiting(self) -> int:
        """Profiles whose position is not known yet."""
        return len(self._waiting)

    def exposure_s(self, profile: Profile) -> float:
        """Return when a profile was measured, by the host's clock."""
        return self.clock.exposure_s(profile) - self._pairing.latency_s

    def enter(self, profile: Profile) -> None:
        """Take in a profile."""
        self.received += 1
        self.clock.enter(profile.device_time_s, profile.arrival_s)
        if len(self._waiting) >= MAX_WAITING:
            self._leave_out(self._waiting.popleft(), "queue_full")
        self._waiting.append(profile)

    def due(self, *, no_more_readings: bool = False) -> list[PairedProfile]:
        """Return the profiles that can be paired now, in order; at the end of a pass all of them are settled."""
        found: list[PairedProfile] = []
        while self._waiting:
            profile = self._waiting[0]
            time_s = self.exposure_s(profile)
            settled = self.track.covers(time_s, with_next=not no_more_readings)
            if not (settled or no_more_readings or self.track.begins_after(time_s)):
                break
            self._waiting.popleft()
            at = self.track.at(time_s, self._pairing.latency_uncertainty_s)
            if at is None:
                self._leave_out(profile, "no_position")
                continue
            self.paired += 1
            found.append(PairedProfile(profile, at))
            self.track.forget_before(time_s)
        return found

    def _leave_out(self, profile: Profile, reason: str) -> None:
        self.left_out[reason] += 1
        self._on_left_out(profile, reason)
