"""Lines that a pass should have had behind its last one, and where they would lie; knows numbers only.

Between two lines a gap shows in the map, and becomes a region. Behind the last one there is nothing that it could
show beside: nobody saw the surface there.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

LOST_END = "lost_at_the_end"
"""The kind of the event that tells of it."""

_SLACK = 0.1
"""Share of a line spacing by which the encoder may be off."""
_UNTIMED = 2.5
"""Line spacings before the end within which the last line of a scanner may lie that is not triggered by the stage."""


@dataclass(frozen=True, slots=True)
class LostEnd:
    """So many lines from the one at `from_mm` to the one at `to_mm`, the stage's positions."""

    lines: int
    from_mm: float
    to_mm: float

    def __str__(self) -> str:
        what = f"the last {self.lines} lines" if self.lines > 1 else "the last line"
        where = f"from {self.from_mm:.6g} to {self.to_mm:.6g} mm" if self.lines > 1 else f"at {self.from_mm:.6g} mm"
        verb = "were" if self.lines > 1 else "was"
        return f"{what} of the pass, {where}, {verb} lost, and no region can show that: scan that stretch again"

    def to_dict(self) -> dict[str, Any]:
        """As the event of the session's record keeps it."""
        return asdict(self) | {"message": str(self)}


def lost_behind(next_mm: float, end_mm: float, step_mm: float, lost_lines: int) -> LostEnd | None:
    """What is missing at the end of a pass that the device drove to its end; None when nothing is.

    Parameters
    ----------
    next_mm : where the line behind the last one that came would lie.
    step_mm : from one line to the next, negative in a pass towards lower positions.
    lost_lines : how many lines of the pass the accounts say are lost, wherever; there are no more behind the last.
    """
    lines = min(math.floor((end_mm - next_mm) / step_mm + _SLACK) + 1, lost_lines)
    return LostEnd(lines, next_mm, next_mm + (lines - 1) * step_mm) if lines > 0 else None


def unseen_behind(last_mm: float, end_mm: float, spacing_mm: float) -> LostEnd | None:
    """The same for a scanner that measures in its own time, whose last line may lie somewhat before the end."""
    left_mm = end_mm - last_mm
    lines = math.floor(abs(left_mm) / spacing_mm)
    if abs(left_mm) <= _UNTIMED * spacing_mm:
        return None
    return LostEnd(lines, last_mm + math.copysign(spacing_mm, left_mm), end_mm)
