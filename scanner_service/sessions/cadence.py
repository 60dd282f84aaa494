"""When the analyst may judge again: verdicts take a share of one processor core and no more; knows seconds only."""

from dataclasses import dataclass

VERDICT_SHARE = 1 / 3
HURRIED_SHARE = 0.1
"""Shares of a core: with time to spare, and while scanlines wait."""

VERDICT_PERIOD_S = 1.0


@dataclass(slots=True)
class Cadence:
    """Spaces runs so that they take at most `share` of a core, and do not follow each other within `period_s`.

    While scanlines wait the share is `hurried`: lines are lost when they come too late, a verdict is not.

    What a run took is followed by a rest (1 / share - 1) times as long: however large the map has become, all runs and
    rests together cost no more than the share. A run that lasts longer only makes the next one later.
    """

    share: float = VERDICT_SHARE
    hurried: float = HURRIED_SHARE
    period_s: float = VERDICT_PERIOD_S
    _due_s: float = float("-inf")

    def is_due(self, now_s: float) -> bool:
        """Whether a run may begin."""
        return now_s >= self._due_s

    def ran(self, begun_s: float, ended_s: float, core_s: float, *, lines_wait: bool = False) -> None:
        """Account for a run between two times that kept a core busy for `core_s`; `lines_wait`, when it ended."""
        share = self.hurried if lines_wait else self.share
        self._due_s = max(begun_s + self.period_s, ended_s + core_s * (1.0 / share - 1.0))
