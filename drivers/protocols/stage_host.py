"""What all conversations with a stage controller share: one errand at a time, readings, trust in the position.

No controller in particular, no port, no clock and no thread: bytes and times come in, bytes wait in `outbox`.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from drivers.errors import StageError, StageNotConnected, StageStopped, StageTimeout
from drivers.protocols.listening import listened_s
from drivers.protocols.outbox import Outbox
from drivers.protocols.stage_events import PositionLost, Reading, StageEvent, StageReconnected
from drivers.protocols.text_lines import TextLines

NOT_HOMED = "the stage has not homed since it was connected"
HOMING_S = 120.0
SILENCE_S = 3.0


class Phase(Enum):
    """How far host and controller are."""

    DOWN = "down"
    GREETING = "greeting"
    UP = "up"


class Kind(Enum):
    """What an errand is for."""

    MOVE = "move"
    HOME = "home"
    STOP = "stop"
    UNLOCK = "unlock"


@dataclass(slots=True)
class Errand:
    """Something the controller is to do. It is over when `is_done`, or when `failure` says why not.

    `step` is the conversation's own mark of how far it is, `since_s` when it got there.
    """

    kind: Kind
    give_up_s: float
    target: float = math.nan
    speed_per_s: float = math.nan
    step: str = "new"
    since_s: float = 0.0
    is_done: bool = False
    failure: StageError | None = None

    @property
    def is_over(self) -> bool:
        """True when there is nothing more to wait for."""
        return self.is_done or self.failure is not None

    def go_to(self, step: str, now_s: float) -> None:
        """Mark how far it is."""
        self.step, self.since_s = step, now_s


class StageHost(ABC):
    """The host's half of a conversation with one axis of a controller.

    Parameters
    ----------
    on_reading, on_event : told of what the controller says.
    tolerance : how far from its target, in the controller's unit, an axis that has arrived may stand.

    Notes
    -----
    `position_known` is True after homing, or after the user's own word (`trust`), and until anything happened that
    may have moved the axis without a count of it; `why_unknown` is then one clause.
    """

    def __init__(
        self, on_reading: Callable[[Reading], None], on_event: Callable[[StageEvent], None], tolerance: float
    ) -> None:
        self.outbox = Outbox()
        self.lines = TextLines()
        self.phase = Phase.DOWN
        self.errand: Errand | None = None
        self.identity = ""
        self.position_known = False
        self.why_unknown = NOT_HOMED
        self.heard_bytes = 0
        self.strays = 0
        self.refusal: StageError | None = None
        """Why this controller cannot be driven at all, once that is known."""
        self.last: Reading | None = None
        self._on_reading = on_reading
        self._on_event = on_event
        self._tolerance = tolerance
        self._heard_s = self._opened_s = 0.0
        self._quiet_s = self._ticked_s = 0.0
        self._listening_s = 0.0  # all the time in which this program has listened
        self._lost_s: float | None = None
        self._interrupted: Kind | None = None  # what the stop under way ended

    # ---- the link ---------------------------------------------------------------------------------------------------

    def link_opened(self, now_s: float) -> None:
        """Begin to talk."""
        self.phase = Phase.GREETING
        self.outbox.clear()
        self.lines.forget()
        self._heard_s = self._opened_s = self._ticked_s = now_s
        self._quiet_s = 0.0
        self._greet(now_s)

    def link_lost(self, reason: str, now_s: float) -> None:
        """Stop talking; whatever was under way has failed."""
        if self._lost_s is None:
            self._lost_s = now_s
        self.phase = Phase.DOWN
        self.outbox.clear()
        self.lines.forget()
        self._fail(StageNotConnected(f"the stage is gone: {reason}"))

    def receive(self, data: bytes, now_s: float) -> None:
        """Take in what the controller sent."""
        if data:
            self._heard_s = now_s
            self._quiet_s = 0.0
            self.heard_bytes += len(data)
        for line in self.lines.receive(data):
            self._hear(line, now_s)

    def tick(self, now_s: float) -> None:
        """Do what is due by now."""
        # A program that was held up for a while has not listened: only time in which it did counts as silence, and an
        # errand has as much more time.
        counts_s = listened_s(self._ticked_s, now_s)
        self._listening_s += counts_s
        self._quiet_s += counts_s
        errand = self.errand
        if errand is not None:
            errand.give_up_s += max(0.0, now_s - self._ticked_s) - counts_s
        self._ticked_s = now_s
        if errand is not None and not errand.is_over and now_s > errand.give_up_s:
            self._run_out(errand, now_s)
        if self.phase is not Phase.DOWN:
            self._tick(now_s)

    def is_silent(self) -> bool:
        """True when the controller should have said something and has not; not while it homes, when some are mute."""
        homing = self.errand is not None and self.errand.kind is Kind.HOME and not self.errand.is_over
        return self.phase is Phase.UP and not homing and self._quiet_s > SILENCE_S

    # ---- errands ----------------------------------------------------------------------------------------------------

    @property
    def is_busy(self) -> bool:
        """True while an errand is under way."""
        return self.errand is not None and not self.errand.is_over

    def move(self, target: float, speed_per_s: float, now_s: float) -> Errand:
        """Send the axis to `target`; the caller has checked that it may go there, and that no errand is under way."""
        start = self.last.position if self.last is not None else target
        give_up_s = now_s + 10.0 + 2.0 * abs(target - start) / speed_per_s
        return self._begin(Errand(Kind.MOVE, give_up_s, target, speed_per_s), now_s)

    def home(self, now_s: float) -> Errand:
        """Find the controller's reference; positions are known from then on."""
        return self._begin(Errand(Kind.HOME, now_s + HOMING_S), now_s)

    def unlock(self, now_s: float) -> Errand:
        """Free a controller that locked itself, so that it moves without homing; positions are as before: unknown."""
        return self._begin(Errand(Kind.UNLOCK, now_s + 5.0), now_s)

    def stop(self, now_s: float) -> Errand:
        """Stop, before anything that waits to be sent; what was under way has failed as stopped."""
        self._interrupted = self.errand.kind if self.errand is not None and not self.errand.is_over else None
        self._fail(StageStopped("the motion was stopped before its target"))
        return self._begin(Errand(Kind.STOP, now_s + 10.0), now_s)

    def trust(self) -> None:
        """Take the user's word that the reported position is true."""
        self.position_known, self.why_unknown = True, ""

    def distrust(self, reason: str, now_s: float) -> None:
        """Take note of something outside the conversation that makes positions meaningless."""
        self._lose_position(reason, now_s)

    # ---- for the conversations --------------------------------------------------------------------------------------

    def _begin(self, errand: Errand, now_s: float) -> Errand:
        self.errand = errand
        if self.phase is not Phase.UP:
            self._fail(StageNotConnected("the stage is not connected; wait until it is back"))
            return errand
        errand.since_s = now_s
        {Kind.MOVE: self._move, Kind.HOME: self._home, Kind.STOP: self._stop, Kind.UNLOCK: self._unlock}[errand.kind](
            errand, now_s
        )
        return errand

    def _done(self) -> None:
        if self.errand is not None and not self.errand.is_over:
            if self.errand.kind is Kind.HOME:
                self.trust()
            self.errand.is_done = True

    def _fail(self, failure: StageError) -> None:
        if self.errand is not None and not self.errand.is_over:
            self.errand.failure = failure

    def _run_out(self, errand: Errand, now_s: float) -> None:
        """An errand took too long: an axis that may still move is stopped, which nobody else waits for."""
        self._fail(StageTimeout(f"the stage did not finish its {errand.kind.value} in time; see what holds it"))
        if errand.kind in (Kind.MOVE, Kind.HOME):
            self._begin(Errand(Kind.STOP, now_s + 10.0), now_s)

    def _up(self, now_s: float) -> None:
        """The greeting is over: tell of a link that is back."""
        self.phase = Phase.UP
        if self._lost_s is not None:
            self._on_event(StageReconnected(now_s - self._lost_s, self.position_known))
            self._lost_s = None

    def _lose_position(self, reason: str, now_s: float) -> None:
        if self.position_known:
            self._on_event(PositionLost(reason, now_s))
        self.position_known, self.why_unknown = False, reason

    def _read(self, reading: Reading) -> None:
        self.last = reading
        self._on_reading(reading)

    def _is_at(self, target: float) -> bool:
        return self.last is not None and abs(self.last.position - target) <= self._tolerance

    @abstractmethod
    def _greet(self, now_s: float) -> None:
        """Begin the greeting; it ends with `_up`."""

    @abstractmethod
    def _hear(self, line: str, now_s: float) -> None:
        """Take in one line."""

    @abstractmethod
    def _tick(self, now_s: float) -> None:
        """Do what is due."""

    @abstractmethod
    def _move(self, errand: Errand, now_s: float) -> None: ...

    @abstractmethod
    def _home(self, errand: Errand, now_s: float) -> None: ...

    @abstractmethod
    def _stop(self, errand: Errand, now_s: float) -> None: ...

    @abstractmethod
    def _unlock(self, errand: Errand, now_s: float) -> None: ...
