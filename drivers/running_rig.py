"""A rig at work: its scanner and its stage, driven through passes that come out as scanlines; knows no device.

A pass ends by itself, by `stop`, or by a failure; in each case the stage rests and the laser is off before it is told.
"""

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from types import TracebackType
from typing import Self, TypeAlias, cast

from drivers.errors import DriverError, ScannerSilent, StageError, StageNotConnected, StageStopped
from drivers.pairing import PairedProfile, StagePosition, TimePairing
from drivers.pass_accounts import PassAccounts, PassReport
from drivers.port_names import find_port
from drivers.protocols.scanner_events import (
    Disconnected,
    PassEnded,
    PassNotResumed,
    PassResumed,
    Reconnected,
    ScannerEvent,
)
from drivers.protocols.stage_events import StageEvent, StageReconnected
from drivers.rig import Rig
from drivers.rig_description import PairBy, RigDescription
from drivers.rig_limits import PassOrder, RigLimits
from drivers.scanline import DeviceInfo, Pose, Profile, Scanline
from drivers.scanners.face import FreeRunningScanner, Scanner
from drivers.scanners.known import known_scanner, open_scanner
from drivers.scanners.native import NativeScanner
from drivers.stages.face import DrivenStage, Stage
from drivers.stages.known import known_stage, open_stage
from drivers.stages.unmoved import ConstantSpeed
from drivers.tally import Tally


@dataclass(frozen=True, slots=True)
class RigPassEnded:
    """A pass of the rig is over: `reached_end`, `stopped` or `failed`; `failure` is then one sentence."""

    reason: str
    failure: str | None
    report: PassReport


RigEvent: TypeAlias = Scanline | ScannerEvent | StageEvent | RigPassEnded

_LOOK_S = 0.05
_MAX_LINES = 4096
_MAX_EVENTS = 1_000
_BACK_S = 120.0
_FIRST_PROFILE_S = 10.0
_MEASURE_RATE_S = 0.6
_PERIODS_AT_REST = 3.0
"""A line at rest is taken so many line periods after the stage has stopped: a latency of up to that, which the rig file
does not tell, then does no harm."""
_EDGE_MM = 1e-3
"""Lines this far outside the ends of a pass still belong to it."""


class RunningRig:
    """A scanner and a stage that belong together.

    Parameters
    ----------
    description : what the rig is made of.
    scanner, stage : drivers not yet entered; None opens those that the description names.
    clock : the one clock of both drivers; seconds that never run backwards.
    """

    def __init__(
        self,
        description: RigDescription,
        *,
        scanner: Scanner | None = None,
        stage: Stage | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._description = description
        self._rig: Rig = description.rig()
        choice = description.scanner
        self._scanner = scanner or open_scanner(
            choice.kind, find_port(choice.port or ""), choice.baud_rate, choice.options
        )
        self._runs_free = known_scanner(choice.kind).runs_free
        self._stage = stage or open_stage(description)
        self._is_driven = known_stage(description.stage.kind).is_driven
        self._clock = clock
        self._changed = threading.Condition()
        self._out: deque[RigEvent] = deque()
        self._lines_waiting = 0
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._accounts = PassAccounts(math.nan)
        self._line_rate_hz = math.nan
        self._seen: deque[ScannerEvent] = deque(maxlen=_MAX_EVENTS)

    def __enter__(self) -> Self:
        self.enter()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.exit()

    # ---- what a user does -------------------------------------------------------------------------------------------

    def enter(self) -> DeviceInfo:
        """Connect to scanner and stage; raises a DriverError, and then neither is left open."""
        info = self._scanner.enter()
        try:
            self._stage.enter()
        except BaseException:
            self._scanner.exit()
            raise
        return info

    @property
    def limits(self) -> RigLimits:
        """Within what passes can be driven."""
        return self._description.limits

    @property
    def stage(self) -> Stage:
        """The stage: to home it, or to state where it is."""
        return self._stage

    @property
    def is_driven(self) -> bool:
        """True when the host moves the stage; it is then a `DrivenStage`."""
        return self._is_driven

    def pose_at(self, position_mm: float) -> Pose:
        """Return `part_from_sensor` at a stage position."""
        return self._rig.part_from_sensor(position_mm)

    @property
    def laser_on(self) -> bool | None:
        """The scanner's last word on its laser; None is unknown, and to be shown as on."""
        return self._scanner.laser_on

    def start(self, order: PassOrder) -> None:
        """Start a pass; its lines, events and its end come out of `events`.

        Raises
        ------
        DriverError : when it cannot be driven here; nothing has moved, and the laser is off.
        """
        if self._thread is not None and self._thread.is_alive():
            raise DriverError("a pass is under way; stop it first")
        self._refuse(order)
        self._stopping.clear()
        self._accounts = PassAccounts(order.line_spacing_mm)
        self._thread = threading.Thread(
            target=self._drive, args=(order,), name=f"rig {self._description.name}", daemon=True
        )
        self._thread.start()

    def events(self, timeout_s: float) -> list[RigEvent]:
        """Return scanlines and events since the last call, in order; waits at most `timeout_s` for the first."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._out), timeout_s)
            taken = list(self._out)
            self._out.clear()
            self._lines_waiting = 0
        return taken

    def stop(self) -> None:
        """Stop the stage before anything else, then the scanner; returns when the pass is over."""
        self._stopping.set()
        if self._is_driven:
            with contextlib.suppress(StageError):  # told by the pass itself, as its end
                cast(DrivenStage, self._stage).stop()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def tally(self) -> Tally:
        """The scanner's exact accounts."""
        return self._scanner.tally()

    def report(self) -> PassReport:
        """The accounts of the pass under way, or of the last one."""
        with self._changed:
            return self._accounts.report(1.0)

    def exit(self) -> None:
        """Stop everything and let go of both devices; never raises."""
        self.stop()
        self._stage.exit()
        self._scanner.exit()

    # ---- a pass, in its thread --------------------------------------------------------------------------------------

    def _refuse(self, order: PassOrder) -> None:
        why = self.limits.why_not(order.start_mm, order.end_mm)
        if why is not None:
            raise DriverError(f"{why}; choose other ends, or correct the rig file")
        highest = self.limits.speed_mm_per_s[1]
        if order.speed_mm_per_s > highest:
            raise DriverError(f"a speed of {order.speed_mm_per_s:g} mm/s is above the stage's {highest:g} mm/s")
        if order.speed_mm_per_s == 0 and not (self._is_driven and self._runs_free and self.limits.stops_for_lines):
            raise DriverError(
                "measuring line by line at rest needs a stage that the host drives and a scanner that runs free"
            )
        if self._is_driven and not self._stage.position_known:
            raise DriverError("the stage does not know where it is; home it, or state where it is, before the pass")
        if self._description.pairing.by is PairBy.DEVICE and self._runs_free:
            raise DriverError(
                'a scanner that runs free tells no stage position; pair by "time" or "count" in the rig file'
            )

    def _drive(self, order: PassOrder) -> None:
        """The thread of a pass."""
        reason, failure = "reached_end", None
        try:
            if not self._runs_free:
                reason = self._device_pass(order)
            elif order.speed_mm_per_s == 0:
                self._measure_at_rest(order)
            else:
                self._measure_in_motion(order)
        except StageStopped as error:
            reason, failure = ("stopped", None) if self._stopping.is_set() else ("failed", str(error))
        except DriverError as error:
            reason, failure = "failed", str(error)
        except Exception as error:  # noqa: BLE001 - the thread's loop: everything stops, and whoever waits is told
            reason, failure = "failed", f"the pass ended by an internal fault: {error!r}"
        if self._stopping.is_set() and failure is None:
            reason = "stopped"
        self._rest()
        self._put(RigPassEnded(reason, failure, self._accounts.report(_sign(order))))

    def _rest(self) -> None:
        """Whatever happened: the stage rests, the laser is off."""
        if self._is_driven:
            stage = cast(DrivenStage, self._stage)
            with contextlib.suppress(StageError):
                if stage.finish_move(0.0) is None:
                    stage.stop()
        with contextlib.suppress(DriverError):
            if self._runs_free:
                cast(FreeRunningScanner, self._scanner).stop_profiles()
            elif self._scanner.laser_on is not False:
                cast(NativeScanner, self._scanner).stop_pass()
        for event in self._fetch(0.0):
            self._accounts.profiles += 1
            self._accounts.left_out["outside_pass"] += 1
            del event
        for told in self._stage.stage_events():
            self._put(told)

    def _fetch(self, timeout_s: float) -> list[Profile]:
        """Return the profiles that came; events are handed on."""
        profiles: list[Profile] = []
        for happening in self._scanner.events(timeout_s):
            if isinstance(happening, Profile):
                profiles.append(happening)
            else:
                self._seen.append(happening)
                self._put(happening)
        return profiles

    # ---- a scanner that brings its positions ------------------------------------------------------------------------

    def _device_pass(self, order: PassOrder) -> str:
        """Run a pass of a scanner with a stage of its own, or with an encoder; a driven stage goes along."""
        scanner = cast(NativeScanner, self._scanner)
        rate_hz = self._rate_for(order)
        self._seen.clear()
        by_time = self._description.pairing.by is PairBy.TIME
        pairing = TimePairing(self._description.pairing)
        if self._is_driven:
            cast(DrivenStage, self._stage).move_to(order.start_mm, self._approach_speed())
        scanner.start_pass(order.line_spacing_mm, order.start_mm, order.end_mm, rate_hz)
        if self._is_driven:
            cast(DrivenStage, self._stage).start_move(order.end_mm, rate_hz * order.line_spacing_mm)
        elif isinstance(self._stage, ConstantSpeed):
            self._stage.begin(order.start_mm, order.end_mm)
        while True:
            profiles = self._fetch(_LOOK_S)
            readings = self._stage.readings()
            pairing.track.add(readings)
            for profile in profiles:
                self._accounts.profiles += 1
                if math.isfinite(profile.position_mm) and not by_time:
                    self._place(PairedProfile(profile, StagePosition(profile.position_mm, 0.0)), order)
                else:
                    pairing.enter(profile)
            ended = next((event for event in self._seen if isinstance(event, PassEnded | PassNotResumed)), None)
            is_over = isinstance(ended, PassNotResumed) or (ended is not None and ended.reason != "rebooted")
            if self._stopping.is_set() and not is_over:
                scanner.stop_pass()
            self._take(pairing, order, is_over)
            self._seen.clear()
            for event in self._stage.stage_events():
                self._put(event)
            if isinstance(ended, PassNotResumed):
                raise ScannerSilent(ended.reason)
            if is_over and ended is not None:
                return "reached_end" if ended.reason == "reached_end" else ended.reason

    # ---- a scanner that runs free -----------------------------------------------------------------------------------

    def _measure_in_motion(self, order: PassOrder) -> None:
        """Move from end to end while the scanner measures; positions by time, or by the count of lines."""
        scanner = cast(FreeRunningScanner, self._scanner)
        stage = cast(DrivenStage, self._stage) if self._is_driven else None
        pairing = TimePairing(self._description.pairing)
        if stage is not None:
            stage.move_to(order.start_mm, self._approach_speed())
        self._stage.readings()
        scanner.start_profiles()
        first = self._first_profile(pairing)
        speed = self._speed_for(order, pairing)
        if stage is not None:
            self._await_reading(pairing)
            stage.start_move(order.end_mm, speed)
        elif isinstance(self._stage, ConstantSpeed):
            self._stage.begin(order.start_mm, order.end_mm)
        first_line: int | None = None
        while not self._stopping.is_set():
            arrived = False
            try:
                arrived = stage is not None and stage.finish_move(0.0) is not None
            except StageNotConnected:
                self._wait_for_stage(order, speed, pairing)
            profiles = [*first, *self._fetch(_LOOK_S)]
            first = []
            if any(isinstance(event, Disconnected) for event in self._seen):
                self._wait_for_scanner(order, speed, pairing)
            self._seen.clear()
            pairing.track.add(self._stage.readings())
            for profile in profiles:
                self._accounts.profiles += 1
                if self._description.pairing.by is PairBy.COUNT:
                    first_line = profile.line_index if first_line is None else first_line
                    self._place_by_count(profile, profile.line_index - first_line, speed, order)
                else:
                    pairing.enter(profile)
            self._take(pairing, order, False)
            for event in self._stage.stage_events():
                self._put(event)
            if arrived or self._is_beyond(order, pairing):
                break
        if stage is not None and not self._stopping.is_set():
            self._await_reading(pairing, profiles_too=True)
        self._take(pairing, order, True)

    def _measure_at_rest(self, order: PassOrder) -> None:
        """Move to each line, and measure it there."""
        scanner, stage = cast(FreeRunningScanner, self._scanner), cast(DrivenStage, self._stage)
        pairing = TimePairing(self._description.pairing)
        speed = self._approach_speed()
        stage.move_to(order.start_mm, speed)
        scanner.start_profiles()
        for profile in self._first_profile(pairing):
            pairing.clock.enter(profile.device_time_s, profile.arrival_s)
            self._leave_out("between_stops")
        for number in range(order.line_count):
            if self._stopping.is_set():
                return
            target_mm = order.start_mm + _sign(order) * number * order.line_spacing_mm
            reading = stage.move_to(target_mm, speed)
            rests_since_s = self._clock() + self._description.pairing.latency_uncertainty_s
            profile = self._profile_after(rests_since_s, pairing)
            at = StagePosition(reading.position_mm, reading.uncertainty_mm)
            self._place(PairedProfile(profile, at), order)
            for event in self._stage.stage_events():
                self._put(event)

    def _profile_after(self, time_s: float, pairing: TimePairing) -> Profile:
        """Return the first profile exposed well after `time_s`; those before are left out."""
        give_up_s = self._clock() + _FIRST_PROFILE_S
        found: Profile | None = None
        while found is None:
            for profile in self._fetch(_LOOK_S):
                pairing.clock.enter(profile.device_time_s, profile.arrival_s)
                settled_s = time_s + _PERIODS_AT_REST * pairing.clock.period_s
                if found is None and pairing.exposure_s(profile) > settled_s:
                    self._accounts.profiles += 1
                    found = profile
                else:
                    self._leave_out("between_stops")
            if self._stopping.is_set() and found is None:
                raise StageStopped("the pass was stopped")
            if found is None and self._clock() > give_up_s and self._scanner.is_connected:
                raise ScannerSilent(f"the scanner has sent no profile for {_FIRST_PROFILE_S:g} s")
        return found

    def _first_profile(self, pairing: TimePairing) -> list[Profile]:
        """Wait until the scanner measures: a stage that sets off earlier leaves the beginning unseen."""
        give_up_s = self._clock() + _FIRST_PROFILE_S
        while not (profiles := self._fetch(_LOOK_S)):
            pairing.track.add(self._stage.readings())
            if self._stopping.is_set():
                break
            if self._clock() > give_up_s:
                raise ScannerSilent(f"the scanner has sent no profile within {_FIRST_PROFILE_S:g} s of its start")
        return profiles

    def _await_reading(self, pairing: TimePairing, *, profiles_too: bool = False) -> None:
        """Wait until the stage has said where it rests: twice, so that readings lie around the last profile."""
        since_s, give_up_s = self._clock(), self._clock() + 5.0
        wanted = 2 if profiles_too else 1
        while wanted and self._clock() < give_up_s:
            for profile in self._fetch(_LOOK_S):
                self._accounts.profiles += 1
                pairing.enter(profile)
            readings = self._stage.readings()
            pairing.track.add(readings)
            wanted -= min(wanted, sum(reading.asked_s >= since_s for reading in readings))

    # ---- interruptions ----------------------------------------------------------------------------------------------

    def _wait_for_scanner(self, order: PassOrder, speed: float, pairing: TimePairing) -> None:
        """The scanner is gone: the stage stops, and goes on behind the last line when the scanner is back."""
        stage = cast(DrivenStage, self._stage) if self._is_driven else None
        if stage is not None:
            stage.stop()
        back = False
        while not back:
            if self._stopping.is_set():
                return
            self._seen.clear()
            for profile in self._fetch(_LOOK_S):
                self._accounts.profiles += 1
                pairing.enter(profile)
            refused = next((event for event in self._seen if isinstance(event, PassNotResumed)), None)
            if refused is not None:
                raise ScannerSilent(refused.reason)
            back = any(isinstance(event, Reconnected | PassResumed) for event in self._seen)
        if stage is not None:
            self._go_on(stage, order, speed, pairing)

    def _wait_for_stage(self, order: PassOrder, speed: float, pairing: TimePairing) -> None:
        """The stage is gone: when it is back and knows where it is, the pass goes on behind the last line."""
        give_up_s = self._clock() + _BACK_S
        while self._clock() < give_up_s and not self._stopping.is_set():
            for event in self._stage.stage_events():
                self._put(event)
                if isinstance(event, StageReconnected):
                    if not event.position_kept:
                        raise StageNotConnected("the stage came back without its position; home it, then scan the rest")
                    self._go_on(cast(DrivenStage, self._stage), order, speed, pairing)
                    return
            for profile in self._fetch(_LOOK_S):
                self._accounts.profiles += 1
                pairing.enter(profile)
        if not self._stopping.is_set():
            raise StageNotConnected(f"the stage did not come back within {_BACK_S:g} s")

    def _go_on(self, stage: DrivenStage, order: PassOrder, speed: float, pairing: TimePairing) -> None:
        pairing.track.add(stage.readings())
        self._take(pairing, order, False)
        last_mm = self._accounts.last_mm
        stage.move_to(order.start_mm if math.isnan(last_mm) else last_mm, self._approach_speed())
        self._await_reading(pairing)
        stage.start_move(order.end_mm, speed)

    # ---- speeds -----------------------------------------------------------------------------------------------------

    def _approach_speed(self) -> float:
        highest = self.limits.speed_mm_per_s[1]
        return highest if math.isfinite(highest) else 20.0

    def _rate_for(self, order: PassOrder) -> float:
        """Line rate of a scanner that is told one: by the speed, else the fastest that the limits allow."""
        fastest = self.limits.line_rate_hz[1]
        if order.speed_mm_per_s > 0:
            return order.speed_mm_per_s / order.line_spacing_mm
        by_stage = self.limits.speed_mm_per_s[1] / order.line_spacing_mm
        rate_hz = min(fastest, by_stage)
        if not math.isfinite(rate_hz):
            raise DriverError("give the pass a speed, or line_rate_hz and speed_mm_per_s in the rig file")
        return rate_hz

    def _speed_for(self, order: PassOrder, pairing: TimePairing) -> float:
        """Speed of the stage: as ordered, else the fastest that keeps the line spacing at the scanner's rate."""
        if isinstance(self._stage, ConstantSpeed):
            return self._stage.speed_mm_per_s
        if order.speed_mm_per_s > 0:
            return order.speed_mm_per_s
        rate_hz = self.limits.line_rate_hz[1]
        if not math.isfinite(rate_hz):
            rate_hz = self._measured_rate(pairing)
        return min(rate_hz * order.line_spacing_mm, self.limits.speed_mm_per_s[1])

    def _measured_rate(self, pairing: TimePairing) -> float:
        """Line rate by the scanner's own clock, over 0.6 s at rest."""
        times: list[float] = []
        end_s = self._clock() + _MEASURE_RATE_S
        while (self._clock() < end_s or len(times) < 3) and not self._stopping.is_set():
            for profile in self._fetch(_LOOK_S):
                self._accounts.profiles += 1
                pairing.enter(profile)
                times.append(profile.device_time_s)
            if self._clock() > end_s + _FIRST_PROFILE_S:
                raise ScannerSilent("the scanner sends no profiles; its line rate cannot be measured")
        gaps = sorted(later - earlier for earlier, later in pairwise(times))
        return 1.0 / gaps[len(gaps) // 2] if gaps and gaps[len(gaps) // 2] > 0 else 1.0

    # ---- placing ----------------------------------------------------------------------------------------------------

    def _take(self, pairing: TimePairing, order: PassOrder, is_over: bool) -> None:
        before = dict(pairing.left_out)
        for paired in pairing.due(no_more_readings=is_over):
            self._place(paired, order)
        with self._changed:
            for reason, count in pairing.left_out.items():
                self._accounts.left_out[reason] += count - before.get(reason, 0)
            self._accounts.clock_jumps = pairing.clock.jumps

    def _place_by_count(self, profile: Profile, number: int, speed: float, order: PassOrder) -> None:
        position_mm = order.start_mm + _sign(order) * number * order.line_spacing_mm
        uncertainty_mm = speed * self._description.pairing.latency_uncertainty_s
        self._place(PairedProfile(profile, StagePosition(position_mm, uncertainty_mm)), order)

    def _place(self, paired: PairedProfile, order: PassOrder) -> None:
        """Hand on a line; what lies outside the pass, or that nobody fetches, is counted."""
        low, high = sorted((order.start_mm, order.end_mm))
        at_mm = paired.at.position_mm
        slack_mm = _EDGE_MM + paired.at.uncertainty_mm
        if not low - slack_mm <= at_mm <= high + slack_mm:
            self._count("outside_pass")
            return
        with self._changed:
            if self._lines_waiting >= _MAX_LINES:
                self._accounts.left_out["overflow"] += 1
                return
            step_mm = self._accounts.place(at_mm, paired.at.uncertainty_mm)
        profile = replace(paired.profile, position_mm=at_mm, line_spacing_mm=order.line_spacing_mm, step_mm=step_mm)
        line = self._rig.place(profile)
        with self._changed:
            self._out.append(line)
            self._lines_waiting += 1
            self._changed.notify_all()

    def _is_beyond(self, order: PassOrder, pairing: TimePairing) -> bool:
        """True when a stage that the host does not drive has gone through the pass."""
        if self._is_driven:
            return False
        if self._description.pairing.by is PairBy.COUNT:
            return self._accounts.lines >= order.line_count
        latest = pairing.track.latest
        return latest is not None and (latest.position_mm - order.end_mm) * _sign(order) > order.line_spacing_mm

    def _count(self, reason: str) -> None:
        with self._changed:
            self._accounts.left_out[reason] += 1

    def _leave_out(self, reason: str) -> None:
        with self._changed:
            self._accounts.profiles += 1
            self._accounts.left_out[reason] += 1

    def _put(self, event: RigEvent) -> None:
        with self._changed:
            if len(self._out) - self._lines_waiting < _MAX_EVENTS or isinstance(event, RigPassEnded):
                self._out.append(event)
            self._changed.notify_all()


def _sign(order: PassOrder) -> float:
    return 1.0 if order.end_mm > order.start_mm else -1.0
