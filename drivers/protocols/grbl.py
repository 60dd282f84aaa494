"""What GRBL 1.1 says and is told: its lines as values, and the count of characters it has room for; no manners.

Facts from gnea/grbl, doc/markdown/interface.md, commands.md and jogging.md, and doc/csv.
"""

import math
import re
from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TypeAlias

RX_BUFFER_BYTES = 128
MAX_LINE_CHARACTERS = 80
STATUS, HOLD, RESUME, SOFT_RESET, JOG_CANCEL = b"?", b"!", b"~", b"\x18", b"\x85"
AXES = "XYZABC"
_POSITION_LOST = {1, 3, 6, 7, 8, 9, 10}


class State(StrEnum):
    """First field of a status report."""

    IDLE = "Idle"
    RUN = "Run"
    HOLD = "Hold"
    JOG = "Jog"
    ALARM = "Alarm"
    DOOR = "Door"
    CHECK = "Check"
    HOME = "Home"
    SLEEP = "Sleep"
    TOOL = "Tool"


@dataclass(frozen=True, slots=True)
class Banner:
    """The controller has started, or was reset: its buffers are empty. `firmware` is GRBL or a descendant."""

    firmware: str
    version: str


@dataclass(frozen=True, slots=True)
class Ok:
    """A line was taken: parsed and queued, not carried out."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """A line was refused; lines already sent still run."""

    code: int


@dataclass(frozen=True, slots=True)
class Alarm:
    """The controller has locked itself."""

    code: int

    @property
    def loses_position(self) -> bool:
        """True when only homing makes positions true again."""
        return self.code in _POSITION_LOST


@dataclass(frozen=True, slots=True)
class Report:
    """A status report. Positions are what the controller says, in its own report unit; () when not told.

    `substate` is the number behind Hold and Door, -1 without one; `feed` is NaN when not told.
    """

    state: State
    substate: int = -1
    machine: tuple[float, ...] = ()
    work: tuple[float, ...] = ()
    offset: tuple[float, ...] = ()
    feed: float = math.nan
    pins: str = ""
    rx_free: int = -1


@dataclass(frozen=True, slots=True)
class Setting:
    """`$n=value`, an answer to `$$`."""

    number: int
    value: float


@dataclass(frozen=True, slots=True)
class Feedback:
    """`[...]`: a message, the version, the parser's state."""

    text: str


@dataclass(frozen=True, slots=True)
class Other:
    """A line that says nothing known: a startup line, an echo, noise that looks like text."""

    text: str


Said: TypeAlias = Banner | Ok | Refusal | Alarm | Report | Setting | Feedback | Other

_BANNER = re.compile(r"(Grbl(?:HAL)?) ([0-9][\w.]*) \[", re.IGNORECASE)
_NUMBERED = re.compile(r"(error|ALARM):(\d{1,4})")
_SETTING = re.compile(r"\$(\d{1,4})=(-?\d{1,10}(?:\.\d{0,10})?)")
_NUMBER = re.compile(r"-?\d{1,9}(?:\.\d{1,9})?")
_STATE = re.compile(r"([A-Z][a-z]+)(?::(\d))?")


def parse(line: str) -> Said:
    """Return what one line of the controller says; a line that is damaged, or from another program, is `Other`."""
    if line == "ok":
        return Ok()
    if numbered := _NUMBERED.fullmatch(line):
        code = int(numbered[2])
        return Refusal(code) if numbered[1] == "error" else Alarm(code)
    if line.startswith("<"):
        return _report(line) or Other(line)
    if setting := _SETTING.fullmatch(line):
        return Setting(int(setting[1]), float(setting[2]))
    if banner := _BANNER.match(line):
        return Banner(banner[1], banner[2])
    if line.startswith("[") and line.endswith("]"):
        return Feedback(line[1:-1])
    return Other(line)


def _report(line: str) -> Report | None:
    """Read a status report; None unless every known field of it is whole."""
    if not line.endswith(">"):
        return None
    head, *fields = line[1:-1].split("|")
    state = _STATE.fullmatch(head)
    if state is None or state[1] not in list(State):
        return None
    told: dict[str, str] = {}
    for item in fields:
        name, colon, value = item.partition(":")
        if not colon or name in told:
            return None
        told[name] = value
    numbers: dict[str, tuple[float, ...]] = {}
    for name in ("MPos", "WPos", "WCO", "FS", "F", "Bf"):
        if name in told:
            values = told[name].split(",")
            if not all(_NUMBER.fullmatch(value) for value in values):
                return None
            numbers[name] = tuple(map(float, values))
    for name in ("MPos", "WPos", "WCO"):
        if name in numbers and not 1 <= len(numbers[name]) <= len(AXES):
            return None
    feed = numbers.get("FS", numbers.get("F", (math.nan,)))[0]
    room = numbers.get("Bf", ())
    return Report(
        State(state[1]),
        int(state[2]) if state[2] else -1,
        numbers.get("MPos", ()),
        numbers.get("WPos", ()),
        numbers.get("WCO", ()),
        feed,
        told.get("Pn", ""),
        int(room[1]) if len(room) == 2 else -1,
    )


@dataclass(slots=True)
class CharacterCount:
    """How many characters the controller holds unacknowledged: never more than its buffer less one.

    Every line, its end included, counts from its sending to its `ok` or `error`; nothing else is acknowledged.
    """

    capacity: int = RX_BUFFER_BYTES - 1
    _lengths: deque[int] = field(default_factory=deque)

    @property
    def used(self) -> int:
        """Characters sent and not acknowledged."""
        return sum(self._lengths)

    @property
    def lines(self) -> int:
        """Lines sent and not acknowledged."""
        return len(self._lengths)

    def has_room(self, line: bytes) -> bool:
        """True when the line may be sent now."""
        return self.used + len(line) <= self.capacity

    def sent(self, line: bytes) -> None:
        """Note a line that goes out."""
        self._lengths.append(len(line))

    def acknowledged(self) -> bool:
        """Note an `ok` or `error`; False when nothing was outstanding: it belongs to somebody else's line."""
        if not self._lengths:
            return False
        self._lengths.popleft()
        return True

    def unsent(self, n_lines: int) -> None:
        """Take back the latest lines: they were noted, and never left."""
        for _ in range(n_lines):
            self._lengths.pop()

    def reset(self) -> None:
        """The controller has thrown its buffer away."""
        self._lengths.clear()


def jog(letter: str, target: float, feed_per_min: float) -> bytes:
    """Return a jog to an absolute machine position: it leaves the G-code state alone, and can be cancelled."""
    line = f"$J=G53G90G21{letter}{target:.4f}F{feed_per_min:.2f}\n".encode()
    if len(line) > MAX_LINE_CHARACTERS:
        raise ValueError(f"a jog to {target} does not fit a line of {MAX_LINE_CHARACTERS} characters")
    return line


ERRORS = {
    1: "a letter was missing", 2: "a number was damaged or missing", 3: "it does not know the $ command",
    4: "a value was negative", 5: "homing is not enabled ($22=1)", 6: "the step pulse is too short",
    7: "its stored settings could not be read", 8: "it must be idle", 9: "it is locked by an alarm or a jog",
    10: "soft limits need homing", 11: "the line was too long", 12: "the step rate is too high", 13: "the door is open",
    15: "the jog leads beyond the controller's own travel", 16: "the jog was invalid", 17: "laser mode needs PWM",
    20: "it does not know the word", 22: "the feed rate is missing",
}  # fmt: skip
ALARMS = {
    1: "a limit switch was hit", 2: "a target was beyond the controller's own travel", 3: "it was reset while moving",
    4: "the probe was not where it should be", 5: "the probe did not touch", 6: "homing was interrupted by a reset",
    7: "homing was interrupted by the door", 8: "homing could not leave the limit switch",
    9: "homing found no limit switch", 10: "homing found no second limit switch",
}  # fmt: skip


def explain_error(code: int) -> str:
    """Return why a line was refused, as a clause."""
    return f"{ERRORS.get(code, 'see the controller’s manual')} (error:{code})"


def explain_alarm(code: int) -> str:
    """Return why the controller locked itself, as a clause."""
    return f"{ALARMS.get(code, 'see the controller’s manual')} (ALARM:{code})"
