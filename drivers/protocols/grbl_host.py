"""The host's half of a conversation with GRBL 1.1: greet, home, jog, stop; no port, no clock, no thread.

Every motion is a jog: it leaves the G-code state alone, is refused rather than clipped beyond the controller's own
travel, and ends by a real-time byte with the position kept.
"""

from collections import deque
from collections.abc import Callable

from drivers.errors import StageAlarm, StageError, StageRefused
from drivers.protocols.grbl import (
    AXES,
    HOLD,
    JOG_CANCEL,
    SOFT_RESET,
    STATUS,
    Alarm,
    Banner,
    CharacterCount,
    Feedback,
    Ok,
    Other,
    Refusal,
    Report,
    Setting,
    State,
    explain_alarm,
    explain_error,
    jog,
    parse,
)
from drivers.protocols.stage_events import Reading, StageEvent
from drivers.protocols.stage_host import Errand, Kind, Phase, StageHost

POLL_S = 0.2
_STOP_POLL_S = 0.1
_REST_POLL_S = 0.5
_STEP_S = 0.6
_BANNER_S = 2.5
_LOST_OK_S = 2.0
_REPORT_INCHES, _HOMING_ENABLED = 13, 22
_MOVING = (State.RUN, State.JOG, State.HOME)


class GrblHost(StageHost):
    """One axis of a GRBL controller, by its letter; positions are machine positions in mm (or degrees)."""

    def __init__(
        self,
        on_reading: Callable[[Reading], None],
        on_event: Callable[[StageEvent], None],
        letter: str = "X",
        tolerance: float = 0.01,
    ) -> None:
        super().__init__(on_reading, on_event, tolerance)
        self._letter = letter
        self._axis = AXES.index(letter)
        self._characters = CharacterCount()
        self._waiting: deque[bytes] = deque()
        self._settings: dict[int, float] = {}
        self._offset: tuple[float, ...] = ()
        self._state: State | None = None
        self._asked_s: float | None = None  # a status request is under way
        self._next_poll_s = 0.0
        self._greeting, self._greeting_s = "", 0.0

    # ---- greeting ---------------------------------------------------------------------------------------------------

    def _greet(self, now_s: float) -> None:
        self._characters.reset()
        self._waiting.clear()
        self._asked_s = None
        self._state = None
        self._step_greeting("look")
        self._ask(now_s)

    def _step_greeting(self, step: str) -> None:
        self._greeting, self._greeting_s = step, self._listening_s

    def _identify(self) -> None:
        self._step_greeting("identify")
        self._settings.clear()
        self._waiting.clear()
        self._characters.reset()
        self._send(b"$I\n")
        self._send(b"$$\n")

    def _tick_greeting(self, now_s: float) -> None:
        waited_s = self._listening_s - self._greeting_s
        match self._greeting:
            case "look" if waited_s > _BANNER_S:
                self.outbox.put(SOFT_RESET)
                self._step_greeting("reset")
            case "look" if self._asked_s is None or now_s - self._asked_s > _STEP_S:
                self._ask(now_s)
            case "halt" if now_s >= self._next_poll_s:
                self._ask(now_s)
            case "reset" | "identify" if waited_s > _BANNER_S:
                self._greet(now_s)

    def _greeted_by(self, report: Report) -> None:
        """A report in the greeting: end what an earlier program left running, then ask who is there."""
        match report.state:
            case State.JOG:
                self.outbox.overtake(JOG_CANCEL, inside_messages=True)
                self._step_greeting("halt")
            case State.RUN:
                self.outbox.overtake(HOLD, inside_messages=True)
                self._step_greeting("halt")
            case State.HOLD if report.substate == 1:
                self._step_greeting("halt")
            case State.HOLD | State.SLEEP:  # at rest: what it still holds is thrown away, its position is kept
                self.outbox.overtake(SOFT_RESET, inside_messages=True)
                self._step_greeting("reset")
            case State.HOME:
                self._step_greeting("halt")
            case _ if self._greeting in ("look", "halt"):
                self._identify()

    # ---- what comes -------------------------------------------------------------------------------------------------

    def _hear(self, line: str, now_s: float) -> None:
        match parse(line):
            case Banner(firmware=firmware, version=version):
                self._hear_banner(f"{firmware} {version}", now_s)
            case Ok():
                self._acknowledged(None, now_s)
            case Refusal() as refusal:
                self._acknowledged(refusal, now_s)
            case Alarm() as alarm:
                self._alarmed(alarm, now_s)
            case Report() as report:
                self._reported(report, now_s)
            case Setting(number=number, value=value):
                self._settings[number] = value
            case Feedback(text=text) if text.startswith("VER:"):
                self.identity = f"GRBL {text[4:].rstrip(':')}"
            case Other():
                self.strays += 1

    def _hear_banner(self, identity: str, now_s: float) -> None:
        self.identity = identity
        self._characters.reset()
        self._waiting.clear()
        self._asked_s = None
        self._offset = ()
        self._lose_position(f"the controller started anew ({identity})", now_s)
        if self.phase is Phase.UP:
            if self.errand is not None and self.errand.kind is Kind.STOP:
                self._done()
            self._fail(StageAlarm("the controller was reset in the middle; home before the next motion"))
            self.phase = Phase.GREETING
        self._identify()

    def _acknowledged(self, refusal: Refusal | None, now_s: float) -> None:
        if not self._characters.acknowledged():
            self.strays += 1
            return
        self._send_waiting()
        if self.phase is Phase.GREETING:
            if self._greeting == "identify" and not self._characters.lines and not self._waiting:
                self._up(now_s)
                self._ask(now_s)
            return
        errand = self.errand
        if errand is None or errand.is_over or errand.step != "sent":
            return
        if refusal is not None:
            self._fail(self._refused(errand, refusal))
        elif errand.kind is Kind.MOVE:
            errand.go_to("accepted", now_s)
        elif errand.kind in (Kind.HOME, Kind.UNLOCK):
            self._done()
            self._asked_s = None  # it is mute while homing
            self._ask(now_s)

    def _refused(self, errand: Errand, refusal: Refusal) -> StageError:
        if errand.kind is Kind.HOME and refusal.code == 5:
            return StageRefused(
                "the controller does not home ($22=0); fit limit switches and set $22=1, or state where the stage is"
            )
        return StageRefused(f"the controller refused the {errand.kind.value}: {explain_error(refusal.code)}")

    def _alarmed(self, alarm: Alarm, now_s: float) -> None:
        why = explain_alarm(alarm.code)
        if alarm.loses_position:
            self._lose_position(why, now_s)
        if self.errand is None or self.errand.kind is not Kind.STOP:  # at rest it is, which is all a stop wants
            self._fail(StageAlarm(f"the controller has locked itself: {why}; clear the cause, then home"))

    def _reported(self, report: Report, now_s: float) -> None:
        asked_s, self._asked_s = self._asked_s, None
        self._state = report.state
        self._offset = report.offset or self._offset
        if self.phase is Phase.GREETING:
            self._greeted_by(report)
            return
        at = self._machine_position(report)
        if at is not None and asked_s is not None:
            self._read(Reading(at, asked_s, now_s, report.state in _MOVING or report.substate == 1))
        if asked_s is not None:
            self._judge(report, asked_s, now_s)

    def _machine_position(self, report: Report) -> float | None:
        machine = report.machine
        if not machine and report.work and len(self._offset) == len(report.work):
            machine = tuple(work + offset for work, offset in zip(report.work, self._offset, strict=True))
        if len(machine) <= self._axis:
            return None
        return machine[self._axis] * (25.4 if self._settings.get(_REPORT_INCHES) == 1 else 1.0)

    def _judge(self, report: Report, asked_s: float, now_s: float) -> None:
        """See from a report whether the errand has come to its end."""
        errand = self.errand
        if errand is None or errand.is_over:
            return
        if report.state is State.ALARM and errand.kind is Kind.MOVE:
            self._fail(StageAlarm("the controller is locked by an alarm; home it first"))
        elif asked_s < errand.since_s:
            return
        elif errand.kind is Kind.MOVE:
            self._judge_move(errand, report, now_s)
        elif errand.kind is Kind.STOP:
            self._judge_stop(errand, report, now_s)

    def _judge_move(self, errand: Errand, report: Report, now_s: float) -> None:
        is_late = report.state is State.JOG or now_s - errand.since_s > _LOST_OK_S
        if errand.step == "sent" and is_late:  # an `ok` that got lost shows itself by what the axis does
            self._characters.reset()
            errand.go_to("accepted", errand.since_s)
        if errand.step == "accepted" and report.state is State.IDLE:
            self._arrived(errand)

    def _judge_stop(self, errand: Errand, report: Report, now_s: float) -> None:
        if report.state in _MOVING or (report.state is State.HOLD and report.substate == 1):
            self._overtake(JOG_CANCEL)
            errand.go_to("again", now_s)
        elif not self._characters.lines:
            self._done()
        elif now_s - errand.since_s > _LOST_OK_S:
            self._characters.reset()
            self._done()
        # else a line that was under way may still start a motion: look again

    def _arrived(self, errand: Errand) -> None:
        if self._is_at(errand.target):
            self._done()
            return
        where = f"{self.last.position:g}" if self.last is not None else "nowhere"
        self._fail(
            StageRefused(
                f"the stage came to rest at {where} instead of {errand.target:g}: the line to the controller was "
                "damaged, or the motion was ended by somebody else; check cable and shielding"
            )
        )

    # ---- errands ----------------------------------------------------------------------------------------------------

    def _move(self, errand: Errand, now_s: float) -> None:
        errand.go_to("sent", now_s)
        self._send(jog(self._letter, errand.target, errand.speed_per_s * 60.0))

    def _home(self, errand: Errand, now_s: float) -> None:
        if self._settings.get(_HOMING_ENABLED) == 0:
            self._fail(self._refused(errand, Refusal(5)))
            return
        self._lose_position("homing is under way", now_s)
        errand.go_to("sent", now_s)
        self._send(b"$H\n")

    def _unlock(self, errand: Errand, now_s: float) -> None:
        if self._state is not State.ALARM:
            self._done()
            return
        errand.go_to("sent", now_s)
        self._send(b"$X\n")

    def _stop(self, errand: Errand, now_s: float) -> None:
        self._waiting.clear()
        if self._interrupted is Kind.HOME:  # only a reset ends homing; the position was lost at its beginning
            self._overtake(SOFT_RESET)
        else:
            self._overtake(JOG_CANCEL)
        errand.go_to("sent", now_s)
        self._ask(now_s)

    def _overtake(self, byte: bytes) -> None:
        dropped = self.outbox.overtake(byte, inside_messages=True)
        self._characters.unsent(sum(message.endswith(b"\n") for message in dropped))
        self._asked_s = None

    # ---- sending ----------------------------------------------------------------------------------------------------

    def _send(self, line: bytes) -> None:
        self._waiting.append(line)
        self._send_waiting()

    def _send_waiting(self) -> None:
        while self._waiting and self._characters.has_room(self._waiting[0]):
            line = self._waiting.popleft()
            self._characters.sent(line)
            self.outbox.put(line)

    def _ask(self, now_s: float) -> None:
        self.outbox.put(STATUS)
        self._asked_s = now_s
        is_stopping = self.is_busy and self.errand is not None and self.errand.kind is Kind.STOP
        self._next_poll_s = now_s + (
            _STOP_POLL_S if is_stopping else POLL_S if self.is_busy or self.phase is Phase.GREETING else _REST_POLL_S
        )

    def _tick(self, now_s: float) -> None:
        if self.phase is Phase.GREETING:
            self._tick_greeting(now_s)
            return
        if self._asked_s is not None and now_s - self._asked_s > _STEP_S * 2:
            self._asked_s = None  # the request or its answer was lost
        if self._asked_s is None and now_s >= self._next_poll_s:
            self._ask(now_s)
