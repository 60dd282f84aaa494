"""A pass of a scanner that runs free before a stage in motion, over interruptions of either; knows no device."""

import math

from drivers.errors import ScannerSilent, StageNotConnected
from drivers.passes.drive import LOOK_S, PassDrive
from drivers.protocols.scanner_events import Advice, Disconnected, PassNotResumed, PassResumed, Reconnected
from drivers.protocols.stage_events import StageReconnected
from drivers.rig_description import PairBy
from drivers.scanners.face import FreeRunningScanner
from drivers.stages.unmoved import ConstantSpeed

_BACK_S = 120.0
_ARRIVAL_S = 0.3
"""A stage is asked a few times a second whether it has arrived; a scanner that runs free goes on meanwhile."""
_COUNT_SLACK = 0.02
"""Share by which the spacing that clock and speed tell may differ from the one that was counted with."""


class MotionPass:
    """One pass, positions by time or by the count of lines."""

    def __init__(self, drive: PassDrive, scanner: FreeRunningScanner) -> None:
        self._drive = drive
        self._scanner = scanner
        self._by_count = drive.pairs_by is PairBy.COUNT
        self._speed = 0.0
        self._counted_mm = math.nan  # up to the last round before the stage arrived

    def run(self) -> None:
        """Move from end to end while the scanner measures; raises a DriverError when stage or scanner fail."""
        drive, order, lines = self._drive, self._drive.order, self._drive.lines
        if drive.driven is not None:
            drive.driven.move_to(order.start_mm, drive.approach_speed)
        drive.stage.readings()
        self._scanner.start_profiles()
        if not self._by_count:  # a scanner that is triggered by the stage measures nothing before it moves
            for profile in drive.first_profile():
                lines.by_time(profile)
        self._speed = drive.speed()
        self._set_off(order.start_mm)
        while not drive.stopping.is_set():
            arrived = False
            try:
                arrived = drive.driven is not None and drive.driven.finish_move(0.0) is not None
            except StageNotConnected:
                self._wait_for_stage()
            self._take(LOOK_S)
            if any(isinstance(event, Disconnected) for event in drive.seen):
                self._wait_for_scanner()
            drive.seen.clear()
            lines.read(drive.stage.readings())
            lines.settle()
            drive.stage_events()
            if arrived or self._is_beyond():
                break
            self._counted_mm = lines.counted_to_mm
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
            drive.driven.start_move(drive.order.end_mm, self._speed)
        elif isinstance(drive.stage, ConstantSpeed):
            drive.stage.begin(from_mm, drive.order.end_mm)
        drive.lines.count_from(from_mm, drive.clock())

    def _take(self, timeout_s: float) -> None:
        for profile in self._drive.fetch(timeout_s):
            if self._by_count:
                self._drive.lines.by_count(profile, self._speed)
            else:
                self._drive.lines.by_time(profile)

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
        latest = drive.lines.track.latest
        if drive.driven is None or latest is None:
            return
        slack_mm = 2.0 * order.line_spacing_mm + self._speed * _ARRIVAL_S
        if abs(latest.position_mm - self._counted_mm) > slack_mm:
            drive.told.event(
                Advice(
                    f"the last line was counted to {self._counted_mm:.4g} mm, but the stage stands at "
                    f"{latest.position_mm:.4g} mm: lines and places do not match; check the trigger, or pair by time"
                )
            )

    # ---- interruptions ----------------------------------------------------------------------------------------------

    def _wait_for_scanner(self) -> None:
        """The scanner is gone: the stage stops, and goes on behind the last line when the scanner is back."""
        drive = self._drive
        if drive.driven is not None:
            drive.driven.stop()
            drive.lines.stop_counting()
        back = False
        while not back:
            if drive.stopping.is_set():
                return
            drive.seen.clear()
            self._take(LOOK_S)
            refused = next((event for event in drive.seen if isinstance(event, PassNotResumed)), None)
            if refused is not None:
                raise ScannerSilent(refused.reason)
            back = any(isinstance(event, Reconnected | PassResumed) for event in drive.seen)
        self._go_on()

    def _wait_for_stage(self) -> None:
        """The stage is gone: when it is back and knows where it is, the pass goes on behind the last line."""
        drive = self._drive
        drive.lines.stop_counting()
        give_up_s = drive.clock() + _BACK_S
        while drive.clock() < give_up_s and not drive.stopping.is_set():
            for event in drive.stage_events():
                if isinstance(event, StageReconnected):
                    if not event.position_kept:
                        raise StageNotConnected("the stage came back without its position; home it, then scan the rest")
                    self._go_on()
                    return
            self._take(LOOK_S)
        if not drive.stopping.is_set():
            raise StageNotConnected(f"the stage did not come back within {_BACK_S:g} s")

    def _go_on(self) -> None:
        drive = self._drive
        if drive.driven is None:
            return
        drive.lines.read(drive.stage.readings())
        drive.lines.settle()
        last_mm = drive.lines.last_mm
        from_mm = drive.order.start_mm if math.isnan(last_mm) else last_mm
        drive.driven.move_to(from_mm, drive.approach_speed)
        self._set_off(from_mm)
