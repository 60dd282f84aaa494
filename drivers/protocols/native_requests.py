"""What a host has asked of a device and wants of it; sends nothing and decides nothing."""

from collections.abc import Callable
from dataclasses import dataclass

from drivers.protocols.native_messages import Ack, AckStatus, FromHost

COMMAND_S = 3.0
"""Time after which a command without an acknowledgement has failed."""


@dataclass(slots=True)
class Request:
    """A command under way: done when `ack` is there, or `failed`."""

    command: FromHost
    give_up_s: float
    next_try_s: float
    then: Callable[["Request", float], None] | None = None
    ack: Ack | None = None
    failed: bool = False

    @property
    def done(self) -> bool:
        """True when there is nothing more to wait for."""
        return self.failed or self.ack is not None

    @property
    def ok(self) -> bool:
        """True when the device did it."""
        return self.ack is not None and self.ack.result is AckStatus.OK


@dataclass(slots=True)
class PassPlan:
    """The pass the caller wants; `index` is the device's number for it, None until it has started."""

    line_spacing_mm: float
    start_mm: float
    end_mm: float
    line_rate_hz: float
    resume: bool
    index: int | None = None
    last_position_mm: float = float("nan")
    """Where its last line was read; NaN before the first, or without a position."""


def describe_failure(request: Request) -> str:
    """Return one sentence on a command that did not come off."""
    name = type(request.command).__name__.upper()
    if request.ack is None:
        return f"the scanner did not acknowledge {name} within {COMMAND_S:g} s"
    remedies = {
        AckStatus.OK: "no longer wanted",
        AckStatus.UNKNOWN_COMMAND: "its firmware does not know the command",
        AckStatus.BAD_VALUE: "a value is outside what it can do; check line spacing, travel and line rate",
        AckStatus.BUSY: "a pass is running; stop it first",
        AckStatus.LASER_OFF: "its laser is off",
        AckStatus.FAULT: "an interlock is open or the device has a fault",
    }
    return f"the scanner refused {name}: {remedies[request.ack.result]}"
