"""A session's map, ledger and regions built again from its record, on behalf of whoever opens it; starts nothing."""

import threading
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from scanner_service.analysis.errors import AnalysisError
from scanner_service.analysis.passes import PassKey, pass_key
from scanner_service.sessions.engine import Engine, is_partial
from scanner_service.sessions.left_regions import LeftRegions, last_left
from scanner_service.sessions.withdrawals import ends_of_passes, withdrawn_passes
from scanner_service.storage.record import Record


@dataclass(slots=True)
class Opening:
    """A session whose map is being built from the record: lines taken of those there are."""

    of: int
    lines: int = 0
    done: threading.Event = field(default_factory=threading.Event)

    @property
    def share(self) -> float:
        """How much is done, 0 to 1."""
        return min(1.0, self.lines / self.of) if self.of else 1.0


@dataclass(frozen=True, slots=True)
class Reopened:
    """What the record held of a session: the account of losses that was kept last, the regions as they were followed.

    `damaged` tells of the lines that are left out, `ended_since` whether a scan ended after the last line.
    """

    kept: Mapping[str, Any] | None
    regions: LeftRegions | None
    damaged: tuple[str, ...]
    ended_since: bool

    @property
    def message(self) -> str | None:
        """One sentence about what is left out."""
        if not self.damaged:
            return None
        return f"{len(self.damaged)} stored lines are left out; the first: {self.damaged[0]}"


def take_in(record: Record, engine: Engine, on_progress: Callable[[int], None]) -> Reopened:
    """Put the lines of a session into its engine, which was not started; `on_progress` gets the number of each.

    Raises RecordError when the record cannot be read; a damaged line is told of and left out.
    """
    session_id = engine.session_id
    damaged: list[str] = []
    events = list(record.events(session_id))
    ends = ends_of_passes(events)
    partial: Counter[PassKey] = Counter()
    for number, line in record.lines(session_id, on_damage=lambda found: damaged.append(found.reason)):
        while ends and ends[0] <= number:
            engine.close_passes()
            ends.pop(0)
        try:
            engine.restore(line)
        except (AnalysisError, ValueError) as error:
            damaged.append(f"line {number}: {error}")
        partial[pass_key(line)] += is_partial(line)
        on_progress(number)
    for key in withdrawn_passes(events):
        engine.withdraw_pass(key)
    kept = record.ledger(session_id)
    engine.ledger.reopened(kept, record.lines_of_passes(session_id), partial)
    return Reopened(kept, last_left(events), tuple(damaged), bool(ends))
