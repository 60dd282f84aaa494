"""What every way of driving a pass shares: fetching, and waiting for profiles and readings; knows no device."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.errors import ScannerSilent
from drivers.passes.lines import PassLines
from drivers.passes.speeds import approach_speed, line_rate_of, stage_speed
from drivers.passes.stopping import Stopping
from drivers.passes.told import Told
from drivers.protocols.scanner_events import ScannerEvent
from drivers.protocols.stage_events import StageEvent
from drivers.rig_description import PairBy, RigDescription
from drivers.rig_limits import PassOrder
from drivers.scanline import Profile
from drivers.scanners.face import Scanner
from drivers.stages.face import DrivenStage, Stage, StageReading
from drivers.stages.unmoved import ConstantSpeed

LOOK_S = 0.05
_ARRIVAL_LOOK_S = 1.0
FIRST_PROFILE_S = 10.0
_MEASURE_RATE_S = 0.6
_READING_S = 5.0
_MAX_EVENTS = 1_000


@dataclass(slots=True)
class PassDrive:
    """One pass under way: its scanner, its stage (`driven` where the host moves it), its lines and its listeners.

    `stopping` is set by whoever wants the pass to end; `seen` holds the scanner's events of the latest round.
    """

    description: RigDescription
    scanner: Scanner
    stage: Stage
    driven: DrivenStage | None
    lines: PassLines
    told: Told
    clock: Callable[[], float]
    stopping: Stopping
    seen: "deque[ScannerEvent]" = field(default_factory=lambda: deque(maxlen=_MAX_EVENTS))

    @property
    def order(self) -> PassOrder:
        """What was ordered."""
        return self.lines.order

    @property
    def pairs_by(self) -> PairBy:
        """How profiles get their places."""
        return self.description.pairing.by

    @property
    def approach_speed(self) -> float:
        """How fast the stage goes to where lines begin, mm/s."""
        return approach_speed(self.description.limits)

    def move_to(self, stage: DrivenStage, position_mm: float) -> StageReading:
        """Go where lines begin and wait; raises a StageError, StageStopped once the pass is to end."""
        self.start_move(stage, position_mm, self.approach_speed)
        while (reading := stage.finish_move(_ARRIVAL_LOOK_S)) is None:
            self.stopping.refuse()
        self.stopping.refuse()  # the stage may rest where the stop left it
        return reading

    def start_move(self, stage: DrivenStage, position_mm: float, speed_mm_per_s: float) -> None:
        """Set off; raises a StageError, StageStopped when the pass is to end, and then nothing was sent."""
        with self.stopping.before_it():
            stage.start_move(position_mm, speed_mm_per_s)

    def fetch(self, timeout_s: float) -> list[Profile]:
        """Return the profiles that came; events are noted in `seen` and handed on."""
        profiles: list[Profile] = []
        for happening in self.scanner.events(timeout_s):
            if isinstance(happening, Profile):
                profiles.append(happening)
            else:
                self.seen.append(happening)
                self.told.event(happening)
        return profiles

    def stage_events(self) -> list[StageEvent]:
        """Hand on what happened to the stage, and return it."""
        events = self.stage.stage_events()
        for event in events:
            self.told.event(event)
        return events

    def enter_early(self, profile: Profile) -> None:
        """Take a profile that came before the stage set off, or while it is waited for."""
        if self.pairs_by is PairBy.COUNT:
            self.lines.by_count(profile, 0.0)
        else:
            self.lines.by_time(profile)

    def first_profile(self) -> list[Profile]:
        """Wait until the scanner measures: a stage that sets off earlier leaves the beginning unseen.

        Raises ScannerSilent, or StageStopped when the pass is to end meanwhile.
        """
        give_up_s = self.clock() + FIRST_PROFILE_S
        while not (profiles := self.fetch(LOOK_S)):
            self.lines.read(self.stage.readings())
            self.stopping.refuse()
            if self.clock() > give_up_s:
                raise ScannerSilent(f"the scanner has sent no profile within {FIRST_PROFILE_S:g} s of its start")
        return profiles

    def await_reading(self, *, profiles_too: bool = False) -> None:
        """Wait until the stage has said where it rests: twice, so that readings lie around the last profile."""
        since_s, give_up_s = self.clock(), self.clock() + _READING_S
        wanted = 2 if profiles_too else 1
        while wanted and self.clock() < give_up_s and not self.stopping.is_set():
            for profile in self.fetch(LOOK_S):
                self.enter_early(profile)
            readings = self.stage.readings()
            self.lines.read(readings)
            wanted -= min(wanted, sum(reading.asked_s >= since_s for reading in readings))

    def speed(self) -> float:
        """Speed of the stage: as ordered, else the fastest that keeps the line spacing at the scanner's rate."""
        if isinstance(self.stage, ConstantSpeed):
            return self.stage.speed_mm_per_s
        if self.order.speed_mm_per_s > 0:
            return self.order.speed_mm_per_s
        limits = self.description.limits
        rate_hz = limits.line_rate_hz[1]
        return stage_speed(limits, self.order, rate_hz if math.isfinite(rate_hz) else self._measured_rate())

    def _measured_rate(self) -> float:
        """Line rate by the scanner's own clock and count of lines, over 0.6 s at rest."""
        seen: list[Profile] = []
        end_s = self.clock() + _MEASURE_RATE_S
        while (self.clock() < end_s or len(seen) < 3) and not self.stopping.is_set():
            for profile in self.fetch(LOOK_S):
                self.enter_early(profile)
                seen.append(profile)
            if self.clock() > end_s + FIRST_PROFILE_S:
                raise ScannerSilent(
                    "the scanner sends no profiles while the stage rests, so that its line rate cannot be measured; "
                    "give the pass a speed, or line_rate_hz in the rig file"
                )
        return line_rate_of(seen) or 1.0
