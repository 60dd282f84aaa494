"""Stages that the host does not move: a conveyor of constant speed, and an encoder that the scanner itself reads."""

import threading
from types import MappingProxyType, TracebackType
from typing import Self

from drivers.errors import DriverError
from drivers.protocols.stage_events import StageEvent
from drivers.stages.face import StageInfo, StageReading
from drivers.stages.setup import OptionSpec, StageSetup

CONSTANT_SPEED_OPTIONS = MappingProxyType(
    {"speed_tolerance": OptionSpec(0.01, "share by which the true speed may differ; it widens the stated uncertainty")}
)


class ConstantSpeed:
    """A conveyor: it is at `begin`'s position then, and travels at its speed from then on, whatever happens."""

    def __init__(self, setup: StageSetup) -> None:
        self._speed_mm_per_s = setup.speed_mm_per_s[1]
        self._tolerance = setup.number("speed_tolerance")
        self._clock = setup.clock
        self._lock = threading.Lock()
        self._begun: tuple[float, float, float] | None = None  # position, speed with its sign, time
        if not 0.0 < self._speed_mm_per_s < float("inf"):
            raise DriverError("a stage of constant speed needs speed_mm_per_s = [v, v] with v greater than 0")
        if not 0.0 <= self._tolerance < 1.0:
            raise DriverError(f"speed_tolerance is a share from 0 to below 1, not {self._tolerance}")

    def __enter__(self) -> Self:
        self.enter()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.exit()

    def enter(self) -> StageInfo:
        """There is nobody to ask."""
        return StageInfo(f"constant speed, {self._speed_mm_per_s:g} mm/s")

    def begin(self, position_mm: float, towards_mm: float) -> None:
        """State that the conveyor is at `position_mm` now and moves towards `towards_mm`."""
        speed = self._speed_mm_per_s if towards_mm >= position_mm else -self._speed_mm_per_s
        with self._lock:
            self._begun = (position_mm, speed, self._clock())

    @property
    def speed_mm_per_s(self) -> float:
        """Its speed."""
        return self._speed_mm_per_s

    @property
    def position_known(self) -> bool:
        """True once `begin` said where it is."""
        with self._lock:
            return self._begun is not None

    def readings(self) -> list[StageReading]:
        """Return where it is now, by its speed; nothing before `begin`."""
        with self._lock:
            if self._begun is None:
                return []
            at_mm, speed, since_s = self._begun
            now_s = self._clock()
            gone_mm = speed * (now_s - since_s)
            return [StageReading(at_mm + gone_mm, now_s, now_s, True, self._tolerance * abs(gone_mm))]

    def stage_events(self) -> list[StageEvent]:
        """Nothing happens to it that it could tell."""
        return []

    def exit(self) -> None:
        """It goes on without us."""
        with self._lock:
            self._begun = None


class EncoderOnScanner:
    """An encoder wired to the scanner: positions come latched in its profiles, and there is nothing to ask here."""

    def __enter__(self) -> Self:
        self.enter()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.exit()

    def enter(self) -> StageInfo:
        """There is nobody to ask."""
        return StageInfo("encoder read by the scanner")

    @property
    def position_known(self) -> bool:
        """True: each profile brings its own."""
        return True

    def readings(self) -> list[StageReading]:
        """None: each profile brings its own."""
        return []

    def stage_events(self) -> list[StageEvent]:
        """What happens to it, the scanner tells."""
        return []

    def exit(self) -> None:
        """There is nothing to let go of."""
