"""The host's half of a conversation with Marlin: greet, home, move, stop; no port, no clock, no thread.

M114 tells where the axes *will* be; where they are is in its step counts. A motion has ended when the counts are at the
target and M400 has returned: M400 is not sent before that, since it would block a stop behind it.
"""

import math
from collections import deque
from collections.abc import Callable

from drivers.errors import StageAlarm, StageRefused
from drivers.protocols.marlin import (
    Busy,
    Done,
    Firmware,
    Position,
    Remark,
    Resend,
    SentLines,
    Started,
    Steps,
    Trouble,
    parse,
)
from drivers.protocols.stage_events import Reading, StageEvent
from drivers.protocols.stage_host import Errand, Kind, Phase, StageHost

POLL_S = 0.2
_REST_POLL_S = 0.5
_ANSWER_S = 3.0  # a busy firmware says so every 2 s (M113)
_QUIET_S = 0.25
_DRAIN_S = 2.0
_GREETING = ("M115", "M92", "M114", "M114")


class MarlinHost(StageHost):
    """One axis of a Marlin controller, by its letter; positions are those of its own coordinates, mm or degrees.

    `steps_per_unit` is what the firmware does not tell (M92 answers in most); 0 asks it.
    """

    def __init__(
        self,
        on_reading: Callable[[Reading], None],
        on_event: Callable[[StageEvent], None],
        letter: str = "X",
        steps_per_unit: float = 0.0,
        tolerance: float = 0.02,
    ) -> None:
        super().__init__(on_reading, on_event, tolerance)
        self._letter = letter
        self._given_steps = self._steps_per_unit = steps_per_unit
        self._zero = math.nan  # position = zero + count / steps per unit
        self._sent = SentLines()
        self._waiting: deque[str] = deque()
        self._under_way: str | None = None
        self._swallow_ok = False
        self._complaint = ""  # an error that no answer has followed yet
        self._asked_s = self._answer_due_s = self._next_poll_s = 0.0
        self._position: Position | None = None
        self._draining = False
        self._restless = 0

    # ---- greeting ---------------------------------------------------------------------------------------------------

    def _greet(self, now_s: float) -> None:
        self._waiting.clear()
        self._under_way = None
        self._draining = True
        self._position = None

    def _begin_numbers(self, now_s: float) -> None:
        """Number lines from 1: what was sent under the old numbers is never sent again."""
        self._swallow_ok = False
        self._under_way = "M110"
        self.outbox.put(self._sent.reset())
        self._answer_due_s = now_s + _ANSWER_S

    def _tick_greeting(self, now_s: float) -> None:
        if not self._draining:
            if self._under_way is not None and now_s > self._answer_due_s:
                self._draining = True  # begin again
            return
        if now_s - self._heard_s >= _QUIET_S or now_s - self._opened_s >= _DRAIN_S:
            self._draining = False
            self._waiting.clear()
            self._waiting.extend(_GREETING)
            self._begin_numbers(now_s)

    def _greeted(self, now_s: float) -> None:
        """Every question of the greeting is answered: see whether the axis can be driven, and rests."""
        if not self._steps_per_unit > 0:
            self.refusal = StageRefused(
                f"this Marlin does not tell its steps per unit of {self._letter} (M92), and without them nobody knows "
                "where it is while it moves; give options.steps_per_unit"
            )
            return
        if self._restless:
            self._restless = 0
            self._lose_position("it was still moving, and was stopped at once (M410)", now_s)
            self._waiting.extend(("M410", "M114", "M114"))
            self._send_next(now_s)
            return
        self._align()
        self._up(now_s)

    def _align(self) -> None:
        """At rest the planned position is the true one: it says where the step counts begin."""
        if self._position is not None and self._letter in self._position.counts:
            count = self._position.counts[self._letter]
            self._zero = self._position.planned.get(self._letter, math.nan) - count / self._steps_per_unit

    # ---- what comes -------------------------------------------------------------------------------------------------

    def _hear(self, line: str, now_s: float) -> None:
        match parse(line):
            case Started():
                self._restarted_by_itself(now_s)
            case Done(text=text):
                if isinstance(told := parse(text), Position):  # some firmwares answer M114 on the line of its `ok`
                    self._positioned(told, now_s)
                self._acknowledged(now_s)
            case Busy():
                self._answer_due_s = now_s + _ANSWER_S
                if self.errand is not None and not self.errand.is_over:
                    self.errand.give_up_s = max(self.errand.give_up_s, now_s + 5.0)
            case Resend(number=number):
                self._send_again(number, now_s)
            case Trouble(text=text, is_halt=is_halt):
                self._in_trouble(text, is_halt, now_s)
            case Position() as position:
                self._positioned(position, now_s)
            case Steps(per_unit=per_unit):
                if not self._given_steps > 0:
                    self._steps_per_unit = abs(per_unit.get(self._letter, 0.0))
            case Firmware(name=name):
                self.identity = name
            case Remark():
                self.strays += 1

    def _restarted_by_itself(self, now_s: float) -> None:
        self._lose_position("the controller started anew", now_s)
        if self.phase is Phase.UP:
            self._fail(StageAlarm("the controller was reset in the middle; home before the next motion"))
        self.phase = Phase.GREETING
        self.outbox.clear()
        self._opened_s = now_s
        self._greet(now_s)

    def _in_trouble(self, text: str, is_halt: bool, now_s: float) -> None:
        if is_halt:
            self._lose_position(f"the controller has halted: {text}", now_s)
            self._fail(StageAlarm(f"the controller has halted: {text}; switch it off and on, then home"))
        else:  # whether it asks for the line again, or has refused it, the next answer tells
            self._complaint = text

    def _send_again(self, number: int, now_s: float) -> None:
        lines = self._sent.again(number)
        self._swallow_ok = True
        self._complaint = ""
        if lines is None:  # of another numbering: begin anew
            if self.phase is Phase.GREETING:
                self._draining = True
            else:
                self._begin_numbers(now_s)
        elif lines:
            for line in lines:
                self.outbox.put(line)
            self._answer_due_s = now_s + _ANSWER_S
        else:  # the line had arrived, only its `ok` was lost
            self._carried_out(now_s)

    def _acknowledged(self, now_s: float) -> None:
        complaint, self._complaint = self._complaint, ""
        if complaint:
            self._fail(StageRefused(f"the controller reports: {complaint}"))
        if self._swallow_ok:
            self._swallow_ok = False
        elif self._under_way is None:
            self.strays += 1
        else:
            self._carried_out(now_s)

    def _carried_out(self, now_s: float) -> None:
        command, self._under_way = self._under_way, None
        errand = self.errand
        if errand is not None and not errand.is_over and command is not None:
            self._step(errand, command, now_s)
        if self._waiting:
            self._send_next(now_s)
        elif self.phase is Phase.GREETING and self._under_way is None and not self._draining and self.refusal is None:
            self._greeted(now_s)

    def _positioned(self, position: Position, now_s: float) -> None:
        before, self._position = self._position, position
        if before is not None and before.counts != position.counts:
            self._restless += 1
        else:
            self._restless = 0
        if self.phase is Phase.UP and self._letter in position.counts:
            at = self._zero + position.counts[self._letter] / self._steps_per_unit
            moving = abs(at - position.planned.get(self._letter, at)) > self._tolerance
            self._read(Reading(at, self._asked_s, now_s, moving))

    # ---- errands ----------------------------------------------------------------------------------------------------

    def _step(self, errand: Errand, command: str, now_s: float) -> None:
        """Go on with an errand after one of its commands was carried out."""
        word = command.split(" ", 1)[0]
        match errand.kind, errand.step, word:
            case (Kind.MOVE, "sent", "G1"):
                errand.go_to("moving", now_s)
                self._next_poll_s = now_s
            case (Kind.MOVE, "moving", "M114") if self._is_at(errand.target):
                errand.go_to("arrived", now_s)
                self._put("M400", now_s)
            case (Kind.MOVE, "moving", "M114") if not self._restless and now_s - errand.since_s > 1.0:
                planned = self._position.planned.get(self._letter, math.nan) if self._position is not None else math.nan
                self._fail(StageRefused(f"the stage rests at {planned:g} instead of {errand.target:g}"))
            case (Kind.MOVE, "arrived", "M400") | (Kind.HOME, "sent", "G28"):
                errand.go_to("resting", now_s)
                self._put("M114", now_s)
            case (Kind.MOVE | Kind.HOME, "resting", "M114"):
                self._align()
                if self._position is not None:
                    self._positioned(self._position, now_s)
                self._done()
            case (Kind.STOP, "sent", "M410"):
                errand.go_to("looking", now_s)
                self._put("M114", now_s)
            case (Kind.STOP, "looking", "M114") if self._restless == 0 and now_s - errand.since_s > POLL_S:
                self._align()
                self._done()
            case (Kind.UNLOCK, _, "M114"):
                self._done()

    def _move(self, errand: Errand, now_s: float) -> None:
        errand.go_to("sent", now_s)
        self._put("G90", now_s)
        self._put(f"G1 {self._letter}{errand.target:.4f} F{errand.speed_per_s * 60.0:.2f}", now_s)

    def _home(self, errand: Errand, now_s: float) -> None:
        self._lose_position("homing is under way", now_s)
        errand.go_to("sent", now_s)
        self._put(f"G28 {self._letter}", now_s)

    def _unlock(self, errand: Errand, now_s: float) -> None:
        self._put("M114", now_s)

    def _stop(self, errand: Errand, now_s: float) -> None:
        """M410 goes out without a number, so that it needs no place in a row; then the numbers begin anew."""
        self._lose_position("it was stopped at once (M410), which may lose steps", now_s)
        self._waiting.clear()
        self.outbox.overtake(b"M410\n")
        self._under_way = "M410"
        self._waiting.append("M110")
        self._swallow_ok = False
        self._answer_due_s = now_s + _ANSWER_S
        errand.go_to("sent", now_s)

    # ---- sending ----------------------------------------------------------------------------------------------------

    def _put(self, command: str, now_s: float) -> None:
        self._waiting.append(command)
        if self._under_way is None:
            self._send_next(now_s)

    def _send_next(self, now_s: float) -> None:
        command = self._waiting.popleft()
        if command == "M110":
            self._begin_numbers(now_s)
            return
        self._under_way = command
        self._answer_due_s = now_s + _ANSWER_S
        if command == "M114":
            self._asked_s = now_s
        self.outbox.put(self._sent.add(command))

    def _tick(self, now_s: float) -> None:
        if self.phase is Phase.GREETING:
            self._tick_greeting(now_s)
            return
        if self._under_way is not None:
            if now_s > self._answer_due_s:
                self._repeat(now_s)
            return
        if now_s >= self._next_poll_s:
            self._next_poll_s = now_s + (POLL_S if self.is_busy else _REST_POLL_S)
            self._put("M114", now_s)

    def _repeat(self, now_s: float) -> None:
        """Say the last line again: if it had arrived, the controller asks for the one behind it."""
        self._answer_due_s = now_s + _ANSWER_S
        self._complaint = ""  # no answer came behind it: the line is said again
        if self._under_way == "M410":
            self.outbox.put(b"M410\n")
        elif self._under_way == "M110":
            self._begin_numbers(now_s)
        else:
            for line in self._sent.again(self._sent.number) or []:
                self.outbox.put(line)
