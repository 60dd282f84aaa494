"""What a rig has to tell while it drives a pass, waiting to be fetched: lines and events; knows no device."""

import threading
from collections import deque
from dataclasses import dataclass
from typing import TypeAlias

from drivers.pass_accounts import PassReport
from drivers.protocols.scanner_events import Advice, ScannerEvent
from drivers.protocols.stage_events import StageEvent
from drivers.scanline import Scanline


@dataclass(frozen=True, slots=True)
class RigPassEnded:
    """A pass of the rig is over: `reached_end`, `stopped` or `failed`; `failure` is then one sentence."""

    reason: str
    failure: str | None
    report: PassReport


RigEvent: TypeAlias = Scanline | ScannerEvent | StageEvent | RigPassEnded

_MAX_LINES = 4096
_MAX_EVENTS = 1_000


class Told:
    """Lines and events in order, both bounded; whoever drives the pass never waits for whoever fetches."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._out: deque[RigEvent] = deque()
        self._lines_waiting = 0
        self._events_lost = 0

    @property
    def has_room(self) -> bool:
        """True while another line would be kept."""
        with self._changed:
            return self._lines_waiting < _MAX_LINES

    def line(self, line: Scanline) -> None:
        """Keep a line; whoever calls has seen that there is room."""
        with self._changed:
            self._out.append(line)
            self._lines_waiting += 1
            self._changed.notify_all()

    def event(self, event: RigEvent) -> None:
        """Keep an event; of a thousand that nobody fetches the further ones are counted, the end is kept."""
        with self._changed:
            if len(self._out) - self._lines_waiting < _MAX_EVENTS or isinstance(event, RigPassEnded):
                self._out.append(event)
            else:
                self._events_lost += 1
            self._changed.notify_all()

    def take(self, timeout_s: float) -> list[RigEvent]:
        """Return all there is, in order; waits at most `timeout_s` for the first. Lost events are told as an Advice."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._out), timeout_s)
            taken = list(self._out)
            self._out.clear()
            self._lines_waiting = 0
            lost, self._events_lost = self._events_lost, 0
        if lost:
            is_over = isinstance(taken[-1], RigPassEnded)
            told = Advice(f"{lost} events of the rig were lost, since nobody fetched them; fetch events more often")
            taken.insert(len(taken) - is_over, told)
        return taken
