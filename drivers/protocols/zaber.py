"""What Zaber's ASCII protocol says and is told: messages as values, with their checksum; no manners.

Facts from https://www.zaber.com/articles/ascii-protocol and the protocol manual of firmware 6 and 7.
"""

import re
from dataclasses import dataclass
from typing import TypeAlias

SPEED_SCALE = 1.6384
"""A speed of 1 microstep/s is written as 1.6384."""
NO_REFERENCE = {"WR", "WH"}
"""Warnings under which positions mean nothing: no reference position, not homed."""
WARNINGS = {
    "WR": "it has no reference position", "WH": "it has not homed", "FS": "it stalled and was stopped",
    "FD": "its driver is disabled", "FE": "a limit was hit in error", "FQ": "its encoder is in error",
    "WL": "a limit was hit unexpectedly", "WV": "the supply voltage is wrong", "WT": "it is too hot",
    "WM": "it was displaced while at rest", "NC": "it was moved by its knob",
    "NI": "a motion was interrupted by a new command",
}  # fmt: skip


def loses_position(flag: str) -> bool:
    """True for warnings under which the axis may stand elsewhere than counted: every fault, and a limit hit."""
    return flag.startswith("F") or flag in NO_REFERENCE or flag == "WL"


@dataclass(frozen=True, slots=True)
class Reply:
    """`@`: an answer. `message_id` is -1 without one; `warning` is `--` for none."""

    device: int
    axis: int
    message_id: int
    is_ok: bool
    is_busy: bool
    warning: str
    data: str


@dataclass(frozen=True, slots=True)
class Alert:
    """`!`: told unasked, such as the end of a motion."""

    device: int
    axis: int
    is_busy: bool
    warning: str


@dataclass(frozen=True, slots=True)
class Info:
    """`#`: a remark."""

    device: int
    text: str


@dataclass(frozen=True, slots=True)
class Damaged:
    """A line that is no message, or whose checksum is wrong."""

    text: str


Said: TypeAlias = Reply | Alert | Info | Damaged

_REPLY = re.compile(r"@(\d\d) (\d)(?: (\d\d))? (OK|RJ) (BUSY|IDLE) ([A-Z-]{2}) (.+)")
_ALERT = re.compile(r"!(\d\d) (\d)(?: (\d\d))? (BUSY|IDLE) ([A-Z-]{2})(?: .*)?")
_INFO = re.compile(r"#(\d\d) (\d)(?: (\d\d))? ?(.*)")
_CHECKED = re.compile(r"(.+):([0-9A-F]{2})")


def lrc(text: str) -> int:
    """Return the two's complement of the sum of the characters between the first one and the colon."""
    return -sum(text.encode("ascii")) & 0xFF


def command(device: int, axis: int, words: str, message_id: int | None = None) -> bytes:
    """Return a command, checked, and numbered if `message_id` (0 to 99) is given."""
    if not (0 <= device <= 99 and 0 <= axis <= 9 and (message_id is None or 0 <= message_id <= 99)):
        raise ValueError(f"no message of Zaber's protocol has device {device}, axis {axis}, id {message_id}")
    number = "" if message_id is None else f" {message_id:02d}"
    text = f"{device} {axis}{number} {words}"
    return f"/{text}:{lrc(text):02X}\n".encode("ascii")


def parse(line: str, *, needs_checksum: bool = False) -> Said:
    """Return what one line says; with `needs_checksum` a line without one is damaged, for it was asked for."""
    checked = _CHECKED.fullmatch(line)
    if checked is not None:
        if lrc(checked[1][1:]) != int(checked[2], 16):
            return Damaged(line)
        line = checked[1]
    elif needs_checksum:
        return Damaged(line)
    if reply := _REPLY.fullmatch(line):
        device, axis, number, verdict, state, warning, data = reply.groups()
        return Reply(
            int(device),
            int(axis),
            -1 if number is None else int(number),
            verdict == "OK",
            state == "BUSY",
            warning,
            data,
        )
    if alert := _ALERT.fullmatch(line):
        return Alert(int(alert[1]), int(alert[2]), alert[4] == "BUSY", alert[5])
    if info := _INFO.fullmatch(line):
        return Info(int(info[1]), info[4])
    return Damaged(line)


def explain_warning(flag: str) -> str:
    """Return what a warning flag means, as a clause."""
    return f"{WARNINGS.get(flag, 'see the manual')} ({flag})"
