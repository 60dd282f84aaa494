"""A pass of a scanner that has a stage of its own, or reads an encoder: its lines bring their places; knows no wire."""

import contextlib
import math

from drivers.errors import ScannerSilent, StageStopped
from drivers.pairing import StagePosition
from drivers.passes.drive import LOOK_S, PassDrive
from drivers.passes.speeds import line_rate
from drivers.protocols.scanner_events import PassEnded, PassNotResumed
from drivers.rig_description import PairBy
from drivers.scanners.native import NativeScanner
from drivers.stages.unmoved import ConstantSpeed


def run_with_device(drive: PassDrive, scanner: NativeScanner) -> str:
    """Run the pass; a driven stage goes along. Return how it ended: `reached_end`, `stopped`, `fault` ...

    Raises
    ------
    DriverError : it cannot be started, or an interrupted one does not go on.
    """
    order, lines = drive.order, drive.lines
    rate_hz = line_rate(drive.description.limits, order)
    by_time = drive.pairs_by is PairBy.TIME
    if drive.driven is not None:
        drive.move_to(drive.driven, order.start_mm)
    drive.stopping.refuse()
    scanner.start_pass(order.line_spacing_mm, order.start_mm, order.end_mm, rate_hz)
    if drive.driven is not None:
        with contextlib.suppress(StageStopped):  # a stop that came first ends the scanner's pass below
            drive.start_move(drive.driven, order.end_mm, rate_hz * order.line_spacing_mm)
    elif isinstance(drive.stage, ConstantSpeed):
        drive.stage.begin(order.start_mm, order.end_mm)
    while True:
        profiles = drive.fetch(LOOK_S)
        lines.read(drive.stage.readings())
        for profile in profiles:
            if math.isfinite(profile.position_mm) and not by_time:
                lines.at_position(profile, StagePosition(profile.position_mm, 0.0))
            else:
                lines.by_time(profile)
        ended = next((event for event in drive.seen if isinstance(event, PassEnded | PassNotResumed)), None)
        is_over = isinstance(ended, PassNotResumed) or (ended is not None and ended.reason != "rebooted")
        if drive.stopping.is_set() and not is_over:
            scanner.stop_pass()
        lines.settle(is_over=is_over)
        drive.seen.clear()
        drive.stage_events()
        if isinstance(ended, PassNotResumed):
            raise ScannerSilent(ended.reason)
        if is_over and ended is not None:
            return ended.reason
