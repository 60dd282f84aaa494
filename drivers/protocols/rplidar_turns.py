"""Samples of an RPLIDAR become turns; knows neither bytes nor commands.

There is no number on the wire: what is missing is inferred, from bytes that were skipped and from angles that jump.
Angles come clockwise in degrees and leave counter-clockwise in radians, as `polar.py` has them.
"""

from dataclasses import dataclass, field

import numpy as np

from drivers.protocols.rplidar import SAMPLE_BYTES, AnyCapsule, Sample
from drivers.scanline import BoolArray, Float64Array

_MAX_SAMPLES = 32_768
_BACK_DEG, _AHEAD_DEG = -20.0, 60.0
_BELIEVE_AFTER = 8


@dataclass(frozen=True, slots=True)
class Turn:
    """One turn, sorted by angle; missing samples are last, NaN.

    `angle_rad`, `range_mm`, `missing` are (n,). A range of 0 is a sample without a return. `first_sample` numbers the
    samples of the stream, counting those that are taken to be lost.
    """

    first_sample: int
    angle_rad: Float64Array
    range_mm: Float64Array
    missing: BoolArray


@dataclass(slots=True)
class _Open:
    first_sample: int
    angles_deg: list[Float64Array] = field(default_factory=list)
    ranges_mm: list[Float64Array] = field(default_factory=list)
    n: int = 0
    lost: int = 0

    def add(self, angles_deg: Float64Array, ranges_mm: Float64Array) -> None:
        self.angles_deg.append(angles_deg)
        self.ranges_mm.append(ranges_mm)
        self.n += len(angles_deg)

    def close(self) -> Turn:
        angle = np.concatenate([*self.angles_deg, np.empty(0)])
        distance = np.concatenate([*self.ranges_mm, np.empty(0)])
        counter_clockwise = -np.radians((angle + 180.0) % 360.0 - 180.0)
        order = np.argsort(counter_clockwise, kind="stable")
        lost = min(self.lost, _MAX_SAMPLES)
        gone = np.full(lost, np.nan)
        return Turn(
            self.first_sample,
            np.concatenate([counter_clockwise[order], gone]),
            np.concatenate([distance[order], gone]),
            np.concatenate([np.zeros(len(order), dtype=np.bool_), np.ones(lost, dtype=np.bool_)]),
        )


class TurnCollector:
    """Collects samples or capsules into turns; what comes before the first beginning of a turn belongs to none."""

    def __init__(self) -> None:
        self.n_samples = 0
        """Samples of the stream so far, lost ones counted."""
        self.implausible = 0
        """Standard samples whose angle cannot follow the one before: a flipped bit that no check notices."""
        self._open: _Open | None = None
        self._last_deg: float | None = None
        self._doubted = 0
        self._held: AnyCapsule | None = None
        self._span_deg = 0.0
        self._has_gap = False

    def lost_bytes(self, n_bytes: int) -> None:
        """Bytes of the stream were skipped."""
        self._has_gap = True
        if self._held is None and self._last_deg is not None:
            self._lose(max(1, round(n_bytes / SAMPLE_BYTES)))

    def sample(self, sample: Sample) -> Turn | None:
        """Take a standard sample; return the turn that it ends."""
        angle_deg = sample.angle_q6 / 64
        step_deg = None if self._last_deg is None else (angle_deg - self._last_deg + 180) % 360 - 180
        if step_deg is not None and not _BACK_DEG < step_deg < _AHEAD_DEG and self._doubted < _BELIEVE_AFTER:
            self._doubted += 1
            self.implausible += 1
            self._lose(1)
            return None
        self._doubted = 0
        passed_zero = self._last_deg is not None and self._last_deg > 270 and angle_deg < 90
        self._last_deg = angle_deg
        # The flag may be lost with its sample, or made by a flipped bit: the angle decides where both are known.
        ended = (
            self._begin_turn()
            if (sample.starts_turn and (angle_deg < 90 or angle_deg > 270)) or (passed_zero and self._turn_is_long)
            else None
        )
        self._count(1)
        if self._open is not None:
            self._open.add(np.array([angle_deg]), np.array([sample.distance_q2 / 4]))
        return self._bounded(ended)

    def capsule(self, capsule: AnyCapsule) -> Turn | None:
        """Take a capsule; return the turn that the one held back ends."""
        held, self._held = self._held, capsule
        had_gap, self._has_gap = self._has_gap, False
        if held is None or capsule.is_first:
            return None
        n = held.n_samples
        span_deg = (capsule.start_q6 - held.start_q6) / 64 % 360
        if had_gap:
            lost = max(1, round(span_deg / self._span_deg)) if self._span_deg else 1
            self._lose(n * lost)
            self._last_deg = None if self._last_deg is None else capsule.start_q6 / 64
            passed_zero = held.start_q6 > capsule.start_q6
            return self._begin_turn() if passed_zero else None
        self._span_deg = span_deg
        angles_deg, distance_mm, turned_deg = held.samples(capsule)
        before = np.concatenate([[turned_deg[0] if self._last_deg is None else self._last_deg], turned_deg[:-1]])
        crossing = np.flatnonzero((before > 270) & (turned_deg < 90))
        self._last_deg = float(turned_deg[-1])
        if not len(crossing):
            self._add(angles_deg, distance_mm)
            return self._bounded(None)
        at = int(crossing[0])
        self._add(angles_deg[:at], distance_mm[:at])
        ended = self._begin_turn()
        self._add(angles_deg[at:], distance_mm[at:])
        return ended

    def forget(self) -> None:
        """The stream was interrupted: what is open is no turn."""
        self._open = None
        self._held = None
        self._last_deg = None
        self._has_gap = False
        self._doubted = 0

    @property
    def _turn_is_long(self) -> bool:
        return self._open is not None and self._open.n + self._open.lost > 8

    def _begin_turn(self) -> Turn | None:
        ended, self._open = self._open, _Open(self.n_samples)
        return None if ended is None else ended.close()

    def _add(self, angles_deg: Float64Array, ranges_mm: Float64Array) -> None:
        self._count(len(angles_deg))
        if self._open is not None and len(angles_deg):
            self._open.add(angles_deg, ranges_mm)

    def _count(self, n: int) -> None:
        self.n_samples += n

    def _lose(self, n: int) -> None:
        self.n_samples += n
        if self._open is not None:
            self._open.lost += n

    def _bounded(self, ended: Turn | None) -> Turn | None:
        """A turn without an end would grow for ever."""
        if self._open is not None and self._open.n > _MAX_SAMPLES:
            self._open = None
        return ended
