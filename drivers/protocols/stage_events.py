"""What happens to a stage, as values in the controller's own unit; knows no controller in particular."""

from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True, slots=True)
class Reading:
    """Where the axis was at some moment from `asked_s` to `arrived_s` of the host's clock.

    `position` is in the controller's unit (mm of a linear axis, degrees of a turntable); `is_moving` is its word.
    """

    position: float
    asked_s: float
    arrived_s: float
    is_moving: bool


@dataclass(frozen=True, slots=True)
class StageDisconnected:
    """The controller is gone; `reason` is one sentence. The driver goes on trying to reach it."""

    reason: str
    at_s: float


@dataclass(frozen=True, slots=True)
class StageReconnected:
    """The controller is back after `gap_s`; without `position_kept` it started anew, and must home again."""

    gap_s: float
    position_kept: bool


@dataclass(frozen=True, slots=True)
class PositionLost:
    """From now on nobody knows where the axis is; `reason` is one sentence. Motions are refused until it has homed."""

    reason: str
    at_s: float


StageEvent: TypeAlias = StageDisconnected | StageReconnected | PositionLost
