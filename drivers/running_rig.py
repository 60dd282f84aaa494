"""A rig at work: its scanner and its stage, driven through passes that come out as scanlines; knows no device.

A pass ends by itself, by `stop`, or by a failure; in each case the stage rests and the laser is off before it is told.
How the passes are driven is in `drivers/passes`.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Self, cast

from drivers.errors import DriverError, StageError, StageStopped
from drivers.pass_accounts import PassAccounts, PassReport
from drivers.passes.at_rest import run_at_rest
from drivers.passes.drive import PassDrive
from drivers.passes.in_motion import MotionPass
from drivers.passes.left_out import LeftOut, WirePass, without
from drivers.passes.lines import PassLines
from drivers.passes.stopping import Stopping
from drivers.passes.told import RigEvent, RigPassEnded, Told
from drivers.passes.with_device import run_with_device
from drivers.port_names import find_port
from drivers.rig import Rig
from drivers.rig_description import PairBy, RigDescription
from drivers.rig_limits import PassOrder, RigLimits
from drivers.scanline import DeviceInfo, Pose, Profile
from drivers.scanners.face import FreeRunningScanner, Scanner
from drivers.scanners.known import known_scanner, open_scanner
from drivers.scanners.native import NativeScanner
from drivers.stages.face import DrivenStage, Stage
from drivers.stages.known import known_stage, open_stage
from drivers.tally import PassTally, Tally

__all__ = ["RigEvent", "RigPassEnded", "RunningRig"]


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
        self._driven = cast(DrivenStage, self._stage) if known_stage(description.stage.kind).is_driven else None
        self._clock = clock
        self._told = Told()
        self._left_out = LeftOut()
        self._lines: PassLines | None = None
        self._stopping = Stopping()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        self.enter()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.exit()

    # ---- what a user does -------------------------------------------------------------------------------------------

    def enter(self) -> DeviceInfo:
        """Connect to scanner and stage; raises a DriverError, and then neither is left open.

        A stop of an earlier time is forgotten, one that comes meanwhile is not.
        """
        self._stopping = Stopping()
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
        return self._driven is not None

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
        StageStopped : after `stop`, until the rig is entered anew.
        """
        if self._thread is not None and self._thread.is_alive():
            raise DriverError("a pass is under way; stop it first")
        self._refuse(order)
        lines = PassLines(self._rig, order, self._description.pairing, self._told, self._left_out)
        thread = threading.Thread(
            target=self._drive, args=(order, lines), name=f"rig {self._description.name}", daemon=True
        )
        with self._stopping.before_it():
            thread.start()
            self._lines, self._thread = lines, thread

    def events(self, timeout_s: float) -> list[RigEvent]:
        """Return scanlines and events since the last call, in order; waits at most `timeout_s` for the first."""
        return self._told.take(timeout_s)

    def stop(self) -> None:
        """Stop the stage before anything else, then the scanner; returns when the pass is over.

        Nothing sets off afterwards, also where a `start` is about to come: see `enter`.
        """
        self._stopping.set()
        if self._driven is not None:
            with contextlib.suppress(StageError):  # told by the pass itself, as its end
                self._driven.stop()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def tally(self) -> Tally:
        """The scanner's exact accounts."""
        return self._scanner.tally()

    def pass_tallies(self) -> Mapping[WirePass, PassTally]:
        """The account of each pass of the scanner, where what the rig left out is lost, by reason, and not stored."""
        left_out = self._left_out.counts()  # before the scanner's: see `without`
        return without(self._scanner.tally().passes, left_out)

    def report(self) -> PassReport:
        """The accounts of the pass under way, or of the last one."""
        return PassAccounts(float("nan")).report(1.0) if self._lines is None else self._lines.report()

    def exit(self) -> None:
        """Stop everything and let go of both devices; never raises."""
        self.stop()
        self._stage.exit()
        self._scanner.exit()
        with contextlib.suppress(Exception):  # what ended the reading thread has been told by the pass
            self._leave_out_the_rest()

    # ---- a pass, in its thread --------------------------------------------------------------------------------------

    def _refuse(self, order: PassOrder) -> None:
        why = self.limits.why_not(order.start_mm, order.end_mm)
        if why is not None:
            raise DriverError(f"{why}; choose other ends, or correct the rig file")
        why = self.limits.why_not_spaced(order)
        if why is not None:
            raise DriverError(f"{why}; order another spacing or speed, or correct the rig file")
        highest = self.limits.speed_mm_per_s[1]
        if order.speed_mm_per_s > highest:
            raise DriverError(f"a speed of {order.speed_mm_per_s:g} mm/s is above the stage's {highest:g} mm/s")
        if order.speed_mm_per_s == 0 and not (self.is_driven and self._runs_free and self.limits.stops_for_lines):
            raise DriverError(
                "measuring line by line at rest needs a stage that the host drives and a scanner that runs free"
            )
        if self.is_driven and not self._stage.position_known:
            raise DriverError("the stage does not know where it is; home it, or state where it is, before the pass")
        if self._description.pairing.by is PairBy.DEVICE and self._runs_free:
            raise DriverError(
                'a scanner that runs free tells no stage position; pair by "time" or "count" in the rig file'
            )

    def _drive(self, order: PassOrder, lines: PassLines) -> None:
        """The thread of a pass."""
        drive = PassDrive(
            self._description, self._scanner, self._stage, self._driven, lines, self._told, self._clock, self._stopping
        )
        reason, failure = "reached_end", None
        try:
            if not self._runs_free:
                reason = run_with_device(drive, cast(NativeScanner, self._scanner))
            elif order.speed_mm_per_s == 0 and self._driven is not None:
                run_at_rest(drive, cast(FreeRunningScanner, self._scanner), self._driven)
            else:
                MotionPass(drive, cast(FreeRunningScanner, self._scanner)).run()
        except StageStopped as error:
            reason, failure = ("stopped", None) if self._stopping.is_set() else ("failed", str(error))
        except DriverError as error:
            reason, failure = "failed", str(error)
        except Exception as error:  # noqa: BLE001 - the thread's loop: everything stops, and whoever waits is told
            reason, failure = "failed", f"the pass ended by an internal fault: {error!r}"
        if self._stopping.is_set() and failure is None:
            reason = "stopped"
        self._rest(drive)
        self._told.event(RigPassEnded(reason, failure, lines.report()))

    def _rest(self, drive: PassDrive) -> None:
        """Whatever happened: the stage rests, the laser is off, and every profile has found its end."""
        if self._driven is not None:
            with contextlib.suppress(StageError):
                if self._driven.finish_move(0.0) is None:
                    self._driven.stop()
        with contextlib.suppress(DriverError):
            if self._runs_free:
                cast(FreeRunningScanner, self._scanner).stop_profiles()
            elif self._scanner.laser_on is not False:
                cast(NativeScanner, self._scanner).stop_pass()
        with contextlib.suppress(Exception):  # a reading thread that ended has ended the pass, which tells it
            for profile in drive.fetch(0.0):
                drive.lines.leave_out(profile, "outside_pass")
        drive.lines.settle(is_over=True)
        drive.stage_events()

    def _leave_out_the_rest(self) -> None:
        """Profiles that still wait when the devices are let go will never be lines."""
        for happening in self._scanner.events(0.0):
            if isinstance(happening, Profile):
                self._left_out.enter(happening, "outside_pass")
