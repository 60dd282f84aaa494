"""A pass of a scanner that has a stage of its own, or reads an encoder: its lines bring their places; knows no wire."""

import contextlib
import math

from drivers.errors import ScannerSilent, StageStopped
from drivers.pairing import StagePosition
from drivers.passes.drive import LOOK_S, PassDrive
from drivers.passes.speeds import line_rate
from drivers.protocols.scanner_events import Advice, PassEnded, PassNotResumed
from drivers.rig_description import PairBy
from drivers.scanners.native import NativeScanner
from drivers.stages.face import DrivenStage
from drivers.stages.unmoved import ConstantSpeed

_SILENCE_S = 30.0
"""After so long at rest without a line a scanner that reads an encoder will not see the places that it waits for."""
_WIRE_SHARE = 0.95
"""Share of the wire's time that lines may fill where the rig chooses their rate: answers need the rest."""


def run_with_device(drive: PassDrive, scanner: NativeScanner) -> str:
    """Run the pass; a driven stage goes along. Return how it ended: `reached_end`, `stopped`, `fault` ...

    Raises
    ------
    DriverError : it cannot be started, or an interrupted one does not go on.
    """
    order, lines = drive.order, drive.lines
    rate_hz = _rate_that_fits(drive, scanner.most_lines_per_s)
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
    silent_since_s = drive.clock()
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
        elif not is_over and drive.driven is not None:
            if not _rests(drive, drive.driven) or profiles or not scanner.is_connected:
                silent_since_s = drive.clock()
            if drive.clock() - silent_since_s > _SILENCE_S:
                drive.told.event(
                    Advice("the stage rests, and the scanner still waits for places: check encoder, start and end")
                )
                scanner.stop_pass()
        lines.settle(is_over=is_over)
        drive.seen.clear()
        drive.stage_events()
        if isinstance(ended, PassNotResumed):
            raise ScannerSilent(ended.reason)
        if is_over and ended is not None:
            return ended.reason


def _rests(drive: PassDrive, stage: DrivenStage) -> bool:
    """True when the stage is where it was sent; raises a StageError where it will not get there."""
    try:
        return stage.finish_move(0.0) is not None
    except StageStopped:
        if drive.stopping.is_set():  # the scanner is stopped in the next round
            return False
        raise


def _rate_that_fits(drive: PassDrive, most_hz: float) -> float:
    """Return the line rate: as ordered, else the fastest that limits and wire allow; what the wire loses is told.

    Whether a USB port carries more than its baud rate says, nobody can tell: what was ordered is done.
    """
    order = drive.order
    rate_hz = line_rate(drive.description.limits, order)
    if rate_hz <= most_hz:
        return rate_hz
    full = f"at its baud rate the port has time for {most_hz:.3g} lines a second"
    fits_mm_per_s = _WIRE_SHARE * most_hz * order.line_spacing_mm
    if math.isnan(order.speed_mm_per_s) and not isinstance(drive.stage, ConstantSpeed):
        drive.told.event(
            Advice(
                f"{full}: the pass goes at {fits_mm_per_s:.3g} mm/s; raise the baud rate, or order a higher speed "
                "where the port is USB and its rate only a name"
            )
        )
        return _WIRE_SHARE * most_hz
    drive.told.event(
        Advice(
            f"{full}, and {rate_hz:.3g} are ordered: lines will be lost, and counted; go at {fits_mm_per_s:.3g} mm/s "
            "or less, space the lines wider, or raise the baud rate"
        )
    )
    return rate_hz
