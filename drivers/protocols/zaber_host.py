"""The host's half of a conversation with a Zaber axis: greet, home, move, stop; no port, no clock, no thread.

Every command carries a number and a checksum, so that every answer carries both: an answer belongs to its command, and
a damaged one is none.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from drivers.errors import StageAlarm, StageRefused
from drivers.protocols.stage_events import Reading, StageEvent
from drivers.protocols.stage_host import Errand, Kind, Phase, StageHost
from drivers.protocols.zaber import (
    SPEED_SCALE,
    Alert,
    Damaged,
    Reply,
    command,
    explain_warning,
    loses_position,
    parse,
)

POLL_S = 0.1
_REST_POLL_S = 0.5
_ANSWER_S = 0.5
_TRIES = 4
_QUIET_S = 0.15
_DRAIN_S = 1.0
_GREETING = ("stop", "get deviceid", "get version", "get system.serial", "warnings", "get pos")


@dataclass(slots=True)
class _Question:
    words: str
    number: int
    asked_s: float
    due_s: float
    tries: int = 1


class ZaberHost(StageHost):
    """One axis of a Zaber device; positions are `unit_per_microstep` times its own, in mm or degrees."""

    def __init__(
        self,
        on_reading: Callable[[Reading], None],
        on_event: Callable[[StageEvent], None],
        unit_per_microstep: float,
        device: int = 1,
        axis: int = 1,
        tolerance: float = 0.002,
    ) -> None:
        if not unit_per_microstep > 0:
            raise ValueError(f"the length of a microstep must be greater than 0, not {unit_per_microstep}")
        super().__init__(on_reading, on_event, max(tolerance, 1.5 * unit_per_microstep))
        self._unit = unit_per_microstep
        self._device, self._axis = device, axis
        self._waiting: deque[str] = deque()
        self._question: _Question | None = None
        self._number = 0
        self._next_poll_s = 0.0
        self._draining = False
        self._facts: dict[str, str] = {}

    # ---- greeting ---------------------------------------------------------------------------------------------------

    def _greet(self, now_s: float) -> None:
        self._waiting.clear()
        self._question = None
        self._draining = True
        self._facts.clear()

    def _tick_greeting(self, now_s: float) -> None:
        if self._draining and (now_s - self._heard_s >= _QUIET_S or now_s - self._opened_s >= _DRAIN_S):
            self._draining = False
            for words in _GREETING:
                self._put(words, now_s)

    def _greeted(self, now_s: float) -> None:
        about = {name: self._facts.get(f"get {name}", "?") for name in ("deviceid", "version", "system.serial")}
        self.identity = f"Zaber {about['deviceid']}, firmware {about['version']}, serial {about['system.serial']}"
        flags = self._facts.get("warnings", "00").split()[1:]
        lost = [flag for flag in flags if loses_position(flag)]
        if lost:
            self._lose_position(explain_warning(lost[0]), now_s)
        elif self._facts.get("warnings"):  # the axis itself keeps its reference until it is switched off
            self.trust()
        self._up(now_s)

    # ---- what comes -------------------------------------------------------------------------------------------------

    def _hear(self, line: str, now_s: float) -> None:
        match parse(line, needs_checksum=line.startswith("@")):
            case Reply() as reply if reply.device == self._device:
                self._answered(reply, now_s)
            case Alert(device=device, axis=axis) if device == self._device and axis in (0, self._axis):
                self._next_poll_s = now_s  # something has changed: look
            case Damaged():
                self.strays += 1

    def _answered(self, reply: Reply, now_s: float) -> None:
        question = self._question
        if question is None or reply.message_id != question.number:
            self.strays += 1
            return
        self._question = None
        if loses_position(reply.warning) and not (self.is_busy and self.errand and self.errand.kind is Kind.HOME):
            self._lose_position(explain_warning(reply.warning), now_s)
        if reply.is_ok:
            self._facts[question.words] = reply.data
            if question.words == "get pos":
                self._located(reply, question, now_s)
        errand = self.errand
        if errand is not None and not errand.is_over:
            self._step(errand, question.words, reply, now_s)
        if self._waiting:
            self._send_next(now_s)
        elif self.phase is Phase.GREETING and self._question is None:
            self._greeted(now_s)

    def _located(self, reply: Reply, question: _Question, now_s: float) -> None:
        try:
            steps = int(reply.data.split()[0])
        except ValueError:
            self.strays += 1
            return
        self._read(Reading(steps * self._unit, question.asked_s, now_s, reply.is_busy))

    # ---- errands ----------------------------------------------------------------------------------------------------

    def _step(self, errand: Errand, words: str, reply: Reply, now_s: float) -> None:
        if not reply.is_ok:
            if words == "get pos":
                return
            self._fail(StageRefused(f"the stage refused {words!r}: {reply.data}"))
            return
        order = words.split(" ", 1)[0]
        match errand.kind, errand.step, order:
            case (Kind.MOVE, "sent", "move") | (Kind.HOME, "sent", "home") | (Kind.STOP, "sent", "stop"):
                errand.go_to("under way", now_s)
                self._put("get pos", now_s)
            case (_, "under way", "get") if words == "get pos" and not reply.is_busy:
                self._at_rest(errand, reply, now_s)
            case (Kind.HOME, "checking", "warnings"):
                lost = [flag for flag in reply.data.split()[1:] if loses_position(flag)]
                if lost:
                    self._fail(StageAlarm(f"the stage did not home: {explain_warning(lost[0])}"))
                else:
                    self._done()
            case (Kind.UNLOCK, _, "warnings"):
                self._done()

    def _at_rest(self, errand: Errand, reply: Reply, now_s: float) -> None:
        if errand.kind is Kind.STOP:
            self._done()
        elif errand.kind is Kind.HOME:
            errand.go_to("checking", now_s)
            self._put("warnings", now_s)
        elif self._is_at(errand.target):
            self._done()
        else:
            at = self.last.position if self.last is not None else float("nan")
            why = f": {explain_warning(reply.warning)}" if reply.warning != "--" else ""
            self._fail(StageRefused(f"the stage came to rest at {at:g} instead of {errand.target:g}{why}"))

    def _move(self, errand: Errand, now_s: float) -> None:
        errand.go_to("sent", now_s)
        speed = max(1, round(errand.speed_per_s / self._unit * SPEED_SCALE))
        self._put(f"set maxspeed {speed}", now_s)
        self._put(f"move abs {round(errand.target / self._unit)}", now_s)

    def _home(self, errand: Errand, now_s: float) -> None:
        self._lose_position("homing is under way", now_s)
        errand.go_to("sent", now_s)
        self._put("home", now_s)

    def _unlock(self, errand: Errand, now_s: float) -> None:
        self._put("warnings clear", now_s)

    def _stop(self, errand: Errand, now_s: float) -> None:
        """The axis hears every command at once: nothing can hold a stop up but what waits here."""
        self._waiting.clear()
        errand.go_to("sent", now_s)
        self._question = self._ask("stop", now_s)
        self.outbox.overtake(self._line(self._question))

    # ---- sending ----------------------------------------------------------------------------------------------------

    def _put(self, words: str, now_s: float) -> None:
        self._waiting.append(words)
        if self._question is None:
            self._send_next(now_s)

    def _send_next(self, now_s: float) -> None:
        self._question = self._ask(self._waiting.popleft(), now_s)
        self.outbox.put(self._line(self._question))

    def _ask(self, words: str, now_s: float) -> _Question:
        self._number = (self._number + 1) % 100
        return _Question(words, self._number, now_s, now_s + _ANSWER_S)

    def _line(self, question: _Question) -> bytes:
        about_device = question.words.startswith(("get deviceid", "get version", "get system.", "warnings"))
        return command(self._device, 0 if about_device else self._axis, question.words, question.number)

    def _tick(self, now_s: float) -> None:
        if self.phase is Phase.GREETING:
            self._tick_greeting(now_s)
        question = self._question
        if question is not None:
            if now_s > question.due_s:
                self._repeat(question, now_s)
        elif self.phase is Phase.UP and now_s >= self._next_poll_s:
            self._next_poll_s = now_s + (POLL_S if self.is_busy else _REST_POLL_S)
            self._put("get pos", now_s)

    def _repeat(self, question: _Question, now_s: float) -> None:
        """Ask again under a new number; after some tries the axis is silent, and the port is opened anew."""
        if question.tries >= _TRIES:
            self._question = None
            if self.phase is Phase.GREETING:
                self._greet(now_s)
            return
        again = self._ask(question.words, now_s)
        again.tries = question.tries + 1
        self._question = again
        self.outbox.put(self._line(again))
