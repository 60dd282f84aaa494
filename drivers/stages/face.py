"""What a rig may ask of any stage, whatever its controller; knows no controller.

Positions are millimetres of travel; on a turntable of arc at its radius. A stage never moves while nobody knows where
it is, never beyond its soft limits, and a stop goes out before everything that waits to be sent.
"""

from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from drivers.protocols.stage_events import StageEvent


@dataclass(frozen=True, slots=True)
class StageInfo:
    """Who answered."""

    identity: str


@dataclass(frozen=True, slots=True)
class StageReading:
    """Where the stage was at some moment from `asked_s` to `arrived_s` of the host's clock (the driver's `clock`).

    `uncertainty_mm` is how far off the position itself may be, besides the moment: a resolution, an uncertain speed.
    """

    position_mm: float
    asked_s: float
    arrived_s: float
    is_moving: bool
    uncertainty_mm: float = 0.0


class Stage(Protocol):
    """One axis that the host reads. Its methods may be called from any thread; `stop` also while another one waits."""

    def enter(self) -> StageInfo:
        """Connect, end what an earlier program left running, and ask who is there; raises a DriverError."""

    @property
    def position_known(self) -> bool:
        """True while positions mean something: after `home`, or the user's word, until something moved unseen."""

    def readings(self) -> list[StageReading]:
        """Readings since the last call, in order; the latest 10,000 are kept."""

    def stage_events(self) -> list[StageEvent]:
        """What happened since the last call, in order; the latest 1,000 are kept."""

    def exit(self) -> None:
        """Stop, and let go of the port; never raises, idempotent."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class DrivenStage(Stage, Protocol):
    """A stage that the host moves."""

    def home(self) -> StageReading:
        """Find the reference, and return where the stage is then; raises a StageError when that fails."""

    def set_position(self, position_mm: float) -> None:
        """State where the stage is, where it has no reference of its own; raises a StageError."""

    def start_move(self, position_mm: float, speed_mm_per_s: float) -> None:
        """Set off and return at once.

        Raises
        ------
        StageLimit : target or speed is outside the limits; nothing was sent.
        StagePositionUnknown : nobody knows where the stage is; nothing was sent.
        StageRefused : another motion is under way; nothing was sent.
        StageNotConnected : no controller is there.
        """

    def finish_move(self, timeout_s: float) -> StageReading | None:
        """Wait for the motion under way; return where the stage came to rest, None when it still moves.

        Raises a StageError when it ended otherwise: refused, stopped, alarm, disconnected, or elsewhere than asked.
        """

    def move_to(self, position_mm: float, speed_mm_per_s: float) -> StageReading:
        """Move and wait; raises what `start_move` and `finish_move` do."""

    def stop(self) -> None:
        """Stop before anything that waits to be sent; returns when the stage rests. Raises a StageError."""
