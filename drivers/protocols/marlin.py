"""What Marlin says and is told: its lines as values, numbered and checked; no manners.

Facts from MarlinFirmware/MarlinDocumentation, _gcode/M110, M114, M115, M400, M410, M92, M113, G28.
"""

import re
from dataclasses import dataclass, field
from typing import TypeAlias

AXES = "XYZEABCUVW"


@dataclass(frozen=True, slots=True)
class Started:
    """The controller has started, or was reset."""


@dataclass(frozen=True, slots=True)
class Done:
    """`ok`: the line was taken; `text` is what stands behind it."""

    text: str = ""


@dataclass(frozen=True, slots=True)
class Busy:
    """It works, or waits for somebody, and is alive."""

    reason: str


@dataclass(frozen=True, slots=True)
class Resend:
    """It wants the lines from this number on again."""

    number: int


@dataclass(frozen=True, slots=True)
class Trouble:
    """`Error:` with its text; `is_halt` when it has stopped for good and must be reset."""

    text: str
    is_halt: bool


@dataclass(frozen=True, slots=True)
class Position:
    """M114: `planned` is where the axes go, by letter; `counts` where they are, in steps, {} when not told."""

    planned: dict[str, float]
    counts: dict[str, int]


@dataclass(frozen=True, slots=True)
class Steps:
    """M92: steps per unit by letter."""

    per_unit: dict[str, float]


@dataclass(frozen=True, slots=True)
class Firmware:
    """M115: its name."""

    name: str


@dataclass(frozen=True, slots=True)
class Capability:
    """M115: `Cap:NAME:1`."""

    name: str
    is_there: bool


@dataclass(frozen=True, slots=True)
class Remark:
    """Anything else: an echo, a comment, a temperature, noise that looks like text."""

    text: str


Said: TypeAlias = Started | Done | Busy | Resend | Trouble | Position | Steps | Firmware | Capability | Remark

_RESEND = re.compile(r"(?:Resend|rs)[: ] ?N?(\d{1,9})", re.IGNORECASE)
_CAPABILITY = re.compile(r"Cap:([A-Z0-9_]+):([01])")
_FIRMWARE = re.compile(r"FIRMWARE_NAME:(.+?)(?: SOURCE_CODE_URL:| PROTOCOL_VERSION:|$)")
_AXIS = re.compile(r"([XYZEABCUVW]): ?(-?\d{1,10}(?:\.\d{1,6})?)(?= |$)")
_STEPS = re.compile(r"(?:echo:)? *M92((?: [XYZEABCUVW]-?\d{1,7}(?:\.\d{1,6})?)+)")
_LETTER_VALUE = re.compile(r"([A-Z])(-?\d+(?:\.\d+)?)")
_HALTS = ("halted", "kill", "heating failed", "thermal runaway")


def parse(line: str) -> Said:
    """Return what one line of the controller says."""
    text = line.strip()
    if text == "start":
        return Started()
    if text == "ok" or text.startswith("ok "):
        return Done(text[3:])
    if text.startswith("echo:busy:"):
        return Busy(text[10:].strip())
    if resend := _RESEND.fullmatch(text):
        return Resend(int(resend[1]))
    if text.startswith("Error:"):
        return Trouble(text[6:].strip(), any(word in text.lower() for word in _HALTS))
    if capability := _CAPABILITY.fullmatch(text):
        return Capability(capability[1], capability[2] == "1")
    if firmware := _FIRMWARE.match(text):
        return Firmware(firmware[1].strip())
    if steps := _STEPS.fullmatch(text):
        return Steps({letter: float(value) for letter, value in _LETTER_VALUE.findall(steps[1])})
    return _position(text) or Remark(text)


def _position(text: str) -> Position | None:
    """Read an answer to M114; None unless all of it is whole."""
    planned_text, word, counts_text = text.partition(" Count ")
    planned, counts = _AXIS.findall(planned_text), _AXIS.findall(counts_text)
    if len(planned) < 3 or _AXIS.sub("", planned_text).strip() or _AXIS.sub("", counts_text).strip():
        return None
    if any("." in value for _, value in counts) or (word and not counts):
        return None
    return Position(
        {letter: float(value) for letter, value in planned}, {letter: int(value) for letter, value in counts}
    )


def checksum(text: str) -> int:
    """Return the exclusive or of all characters before the star."""
    total = 0
    for byte in text.encode("ascii"):
        total ^= byte
    return total


def numbered(number: int, command: str) -> bytes:
    """Return a command as a numbered, checked line."""
    text = f"N{number} {command}"
    return f"{text}*{checksum(text)}\n".encode("ascii")


@dataclass(slots=True)
class SentLines:
    """The lines that may be asked for again: numbers grow by one, the last `depth` are kept."""

    depth: int = 64
    number: int = 0
    _kept: dict[int, bytes] = field(default_factory=dict)

    def reset(self) -> bytes:
        """Return the line that sets the controller's counter, so that the next line is number 1."""
        self.number = 0
        self._kept.clear()
        return numbered(0, "M110 N0")

    def add(self, command: str) -> bytes:
        """Return a command as the next line."""
        self.number += 1
        line = numbered(self.number, command)
        self._kept[self.number] = line
        self._kept.pop(self.number - self.depth, None)
        return line

    def again(self, number: int) -> list[bytes] | None:
        """Return the lines from `number` on; None when they are not kept, or were never sent."""
        if not (number in self._kept or number == self.number + 1):
            return None
        return [self._kept[n] for n in range(number, self.number + 1)]
