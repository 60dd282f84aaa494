"""A pass of a scanner that runs free before a stage in motion, over interruptions of either; knows no device."""

import math

from drivers.errors import DriverError, ScannerSilent, StageNotConnected
from drivers.passes.drive import LOOK_S, PassDrive
from drivers.passes.speeds import line_rate_of
from drivers.protocols.scanner_events import Advice, Disconnected, PassNotResumed, PassResumed, Reconnected
from drivers.protocols.stage_events import StageDisconnected, StageReconnected
from drivers.rig_description import PairBy
from drivers.scanline import Profile
from drivers.scanners.face import FreeRunningScanner
from drivers.stages.unmoved import ConstantSpeed

_BACK_S = 120.0
_JUDGED_FROM, _JUDGED_AFTER = 6, 100
"""Lines after which their spacing is judged: a pause of the program among fewer looks like their rate. And those after
which it is given up, where the scanner's clock does not go on."""
_TOLD_FACTOR, _REFUSED_FACTOR = 2.0, 10.0
"""How many times as far as ordered, or as near, lines on a conveyor may come before it is told, and before the order is
nonsense."""
_COUNT_SLACK = 0.02
"""Share by which the spacing that clock and speed tell may differ from the one that was counted with."""


class MotionPass:
    """One pass, positions by time or by the count of lines."""

    def __init__(self, drive: PassDrive, scanner: FreeRunningScanner) -> None:
        self._drive = drive
        self._scanner = scanner
        self._by_count = drive.pairs_by is PairBy.COUNT
        self._speed = 0.0
        self._stage_is_back = False  # it was gone and came back since it set off
        self._spacing_is_judged = False
        self._seen: list[Profile] = []  # the first ones, until the spacing is judged

    def run(self) -> None:
        """Move from end to end while the scanner measures; raises a DriverError when stage or scanner fail."""
        drive, order, lines = self._drive, self._drive.order, self._drive.lines
        if drive.driven is not None:
            drive.move_to(drive.driven, order.start_mm)
        drive.stage.readings()
        drive.stopping.refuse()
        self._scanner.start_profiles()
        if not self._by_count:  # a scanner that is triggered by the stage measures nothing before it moves
            for profile in drive.first_profile():
                lines.by_time(profile)
        self._speed = drive.speed()
        self._set_off(order.start_mm)
        self._spacing_is_judged = drive.driven is not None
        while not drive.stopping.is_set():
            arrived = was_lost = stage_is_gone = False
            try:
                arrived = drive.driven is not None and drive.driven.finish_move(0.0) is not None
            except StageNotConnected:
                was_lost, stage_is_gone = True, not self._stage_is_back
            self._take(LOOK_S)
            if self._scanner_went() or was_lost:
                self._wait_until_back(stage_is_gone=stage_is_gone)  # what it sees at its end is for the next round
                arrived = False  # wherever it was, the stage has set off again
            else:
                drive.seen.clear()
            lines.read(drive.stage.readings())
            lines.settle()
            self._stage_is_gone(False)
            if arrived or self._is_beyond():
                break
        if drive.driven is not None and not drive.stopping.is_set() and not self._by_count:
            drive.await_reading(profiles_too=True)
        lines.settle(is_over=True)
        if self._by_count and not drive.stopping.is_set():
            self._judge_count()

    def _set_off(self, from_mm: float) -> None:
        """Start the motion; places are counted from here."""
        drive = self._drive
        if drive.driven is not None:
            drive.await_reading()
            self._stage_is_back = False
            drive.start_move(drive.driven, drive.order.end_mm, self._speed)
        elif isinstance(drive.stage, ConstantSpeed):
            drive.stage.begin(from_mm, drive.order.end_mm)
        drive.lines.count_from(from_mm, drive.clock())

    def _take(self, timeout_s: float) -> None:
        profiles = self._drive.fetch(timeout_s)
        for profile in profiles:
            if self._by_count:
                self._drive.lines.by_count(profile, self._speed)
            else:
                self._drive.lines.by_time(profile)
        if not self._spacing_is_judged:
            self._judge_spacing(profiles)

    def _judge_spacing(self, profiles: list[Profile]) -> None:
        """A conveyor goes at its own speed: refuse a spacing that is far finer than the one in which lines come."""
        self._seen += profiles
        if len(self._seen) < _JUDGED_FROM:
            return
        rate_hz = line_rate_of(self._seen)
        if rate_hz is None and len(self._seen) < _JUDGED_AFTER:
            return
        self._spacing_is_judged = True
        self._seen.clear()
        if rate_hz is None:  # its clock does not go on: nobody can tell
            return
        spacing_mm, ordered_mm = self._speed / rate_hz, self._drive.order.line_spacing_mm
        come = f"at {self._speed:g} mm/s and {rate_hz:.3g} lines a second they come {spacing_mm:.4g} mm apart"
        if ordered_mm < spacing_mm / _REFUSED_FACTOR:
            raise DriverError(
                f"lines {ordered_mm:g} mm apart cannot be had: {come}; order that spacing, or slow down the stage"
            )
        if not spacing_mm / _TOLD_FACTOR <= ordered_mm <= spacing_mm * _TOLD_FACTOR:
            self._drive.told.event(Advice(f"lines {ordered_mm:g} mm apart were ordered, but {come}"))

    def _is_beyond(self) -> bool:
        """True when a stage that the host does not drive has gone through the pass."""
        drive, order = self._drive, self._drive.order
        if drive.driven is not None:
            return False
        if self._by_count:
            last_mm = drive.lines.last_mm
            return (last_mm - order.end_mm) * order.sign > -0.5 * order.line_spacing_mm
        latest = drive.lines.track.latest
        return latest is not None and (latest.position_mm - order.end_mm) * order.sign > order.line_spacing_mm

    def _judge_count(self) -> None:
        """Say when the lines that were counted and the way that the stage went do not agree."""
        drive, order = self._drive, self._drive.order
        counted_mm = drive.lines.counted_period_s * self._speed
        if drive.driven is None and abs(counted_mm - order.line_spacing_mm) > _COUNT_SLACK * order.line_spacing_mm:
            drive.told.event(
                Advice(
                    f"by the scanner's clock lines came {counted_mm:.4g} mm apart, and were counted as "
                    f"{order.line_spacing_mm:g} mm; order that spacing, or pair by time"
                )
            )
        places = None if drive.driven is None else drive.lines.counted_and_read()
        if places is None:
            return
        counted_mm, read = places
        if abs(read.position_mm - counted_mm) > 2.0 * order.line_spacing_mm + read.uncertainty_mm:
            drive.told.event(
                Advice(
                    f"a line was counted to {counted_mm:.4g} mm, but the stage was at {read.position_mm:.4g} mm: lines "
                    "and places do not match; check the trigger, or pair by time"
                )
            )

    # ---- interruptions ----------------------------------------------------------------------------------------------

    def _scanner_went(self) -> bool:
        """True when the scanner was gone since the latest look, back or not; raises ScannerSilent."""
        self._scanner_is_gone(False)
        return any(isinstance(event, Disconnected) for event in self._drive.seen)

    def _scanner_is_gone(self, was_gone: bool) -> bool:
        """Return whether the scanner is away after what was seen of it; raises ScannerSilent when it stays silent."""
        gone = was_gone
        for event in self._drive.seen:
            match event:
                case Disconnected():
                    gone = True
                case Reconnected() | PassResumed():
                    gone = False
                case PassNotResumed(reason=reason):
                    raise ScannerSilent(reason)
        return gone

    def _wait_until_back(self, *, stage_is_gone: bool) -> None:
        """Stage, scanner or both were gone: the stage rests, and goes on behind the last line when both are there.

        They go and come back in any order, as they do on one USB hub; either may have come back already.
        """
        drive = self._drive
        scanner_is_gone = self._scanner_is_gone(False)
        if drive.driven is not None:
            drive.lines.stop_counting()
            try:
                if not stage_is_gone:
                    drive.driven.stop()
            except StageNotConnected:
                stage_is_gone = True
        give_up_s = drive.clock() + _BACK_S
        while stage_is_gone or scanner_is_gone:
            if drive.stopping.is_set():
                return
            if not stage_is_gone:
                give_up_s = drive.clock() + _BACK_S
            elif drive.clock() > give_up_s:
                raise StageNotConnected(f"the stage did not come back within {_BACK_S:g} s")
            drive.seen.clear()
            self._take(LOOK_S)
            scanner_is_gone = self._scanner_is_gone(scanner_is_gone)
            stage_is_gone = self._stage_is_gone(stage_is_gone)
        drive.seen.clear()
        self._go_on()

    def _stage_is_gone(self, was_gone: bool) -> bool:
        """Return whether the stage is away after what happened to it; raises StageNotConnected when it is lost."""
        gone = was_gone
        for event in self._drive.stage_events():
            match event:
                case StageDisconnected():
                    gone, self._stage_is_back = True, False
                case StageReconnected(position_kept=False):
                    raise StageNotConnected("the stage came back without its position; home it, then scan the rest")
                case StageReconnected():
                    gone, self._stage_is_back = False, True
        return gone

    def _go_on(self) -> None:
        drive = self._drive
        if drive.driven is None:
            return
        drive.lines.read(drive.stage.readings())
        drive.lines.settle()
        last_mm = drive.lines.last_mm
        from_mm = drive.order.start_mm if math.isnan(last_mm) else last_mm
        drive.move_to(drive.driven, from_mm)
        self._set_off(from_mm)
