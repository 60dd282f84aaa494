"""What became of the profiles of a pass, and how exactly they were placed; knows numbers only."""

import math
import statistics
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class PassReport:
    """The accounts of one pass: `profiles == lines + sum(left_out.values())`.

    `left_out` is by reason: `no_position`, `queue_full` (see `TimePairing`), `outside_pass` (run-up and overrun),
    `between_stops` (measured while the stage was on its way to the next line), `before_start` (lines are counted, and
    the stage had not set off), `overflow` (nobody fetched it).
    Uncertainties and steps are NaN without lines; steps are measured, between one line and the next.
    """

    profiles: int
    lines: int
    left_out: dict[str, int]
    nominal_spacing_mm: float
    median_step_mm: float
    smallest_step_mm: float
    largest_step_mm: float
    reversed_steps: int
    median_uncertainty_mm: float
    largest_uncertainty_mm: float
    clock_jumps: int

    @property
    def balances(self) -> bool:
        """True when nothing is unaccounted for."""
        return self.profiles == self.lines + sum(self.left_out.values())

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, None for NaN, ready for JSON."""
        values = {name: getattr(self, name) for name in self.__slots__}
        return {name: None if isinstance(v, float) and math.isnan(v) else v for name, v in values.items()}


_KEPT = 100_000
"""Medians are those of the latest so many lines: an endless pass must not fill the memory."""


@dataclass(slots=True)
class PassAccounts:
    """Running accounts of one pass."""

    nominal_spacing_mm: float
    profiles: int = 0
    lines: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    clock_jumps: int = 0
    last_mm: float = math.nan
    """Where the latest line was placed; NaN before the first."""
    _steps_mm: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    _uncertainties_mm: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    _smallest_mm: float = math.inf
    _largest_mm: float = -math.inf
    _negative: int = 0
    _positive: int = 0
    _worst_mm: float = math.nan

    def place(self, position_mm: float, uncertainty_mm: float) -> float:
        """Enter a line; return its measured step to the line before, NaN for the first."""
        step_mm = position_mm - self.last_mm
        self.last_mm = position_mm
        self.lines += 1
        self._uncertainties_mm.append(uncertainty_mm)
        self._worst_mm = uncertainty_mm if math.isnan(self._worst_mm) else max(self._worst_mm, uncertainty_mm)
        if not math.isnan(step_mm):
            self._steps_mm.append(step_mm)
            self._smallest_mm = min(self._smallest_mm, step_mm)
            self._largest_mm = max(self._largest_mm, step_mm)
            self._negative += step_mm < 0
            self._positive += step_mm > 0
        return step_mm

    def report(self, towards: float) -> PassReport:
        """Return the accounts; `towards` is +1 or -1, the direction of the pass."""
        has_steps = bool(self._steps_mm)
        return PassReport(
            self.profiles,
            self.lines,
            {reason: count for reason, count in sorted(self.left_out.items()) if count},
            self.nominal_spacing_mm,
            _median(self._steps_mm),
            self._smallest_mm if has_steps else math.nan,
            self._largest_mm if has_steps else math.nan,
            self._negative if towards > 0 else self._positive,
            _median(self._uncertainties_mm),
            self._worst_mm,
            self.clock_jumps,
        )


def _median(values: deque[float]) -> float:
    return statistics.median(values) if values else math.nan
