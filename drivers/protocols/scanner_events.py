"""What happens to a scanner besides its lines, as values; knows no device in particular."""

from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class Disconnected:
    """The device is gone; `reason` is one sentence. The driver goes on trying to reach it."""

    reason: str
    at_s: float


@dataclass(frozen=True, slots=True)
class Reconnected:
    """The same device is back after `gap_s`; `streaming` tells whether its pass went on meanwhile."""

    gap_s: float
    streaming: bool


@dataclass(frozen=True, slots=True)
class OtherDevice:
    """On the path of the lost device another one answers; it is left alone, the driver goes on trying."""

    expected_id: str
    found_id: str


@dataclass(frozen=True, slots=True)
class Rebooted:
    """The device has started anew: its counters begin again, its laser is off."""

    old_boot_id: int
    new_boot_id: int


@dataclass(frozen=True, slots=True)
class PassEnded:
    """A pass of the device is over: `reached_end`, `stopped`, `dead_man`, `fault`, `rebooted` or `disconnected`."""

    pass_index: int
    reason: str


@dataclass(frozen=True, slots=True)
class PassResumed:
    """An interrupted pass goes on at `from_mm`, as a new pass of the device."""

    pass_index: int
    from_mm: float


@dataclass(frozen=True, slots=True)
class PassNotResumed:
    """An interrupted pass stays interrupted; `reason` is one sentence."""

    reason: str


@dataclass(frozen=True, slots=True)
class ClockJumped:
    """The device's clock was set back or ahead; its time goes on by the host's clock, `count` times so far."""

    count: int


@dataclass(frozen=True, slots=True)
class Advice:
    """Something the user should know of how this scanner is being read; `text` is one sentence."""

    text: str


ScannerEvent: TypeAlias = (
    Disconnected
    | Reconnected
    | OtherDevice
    | Rebooted
    | PassEnded
    | PassResumed
    | PassNotResumed
    | ClockJumped
    | Advice
)
