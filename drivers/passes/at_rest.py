"""A pass measured line by line: move to each place, wait until the stage rests, take one profile; knows no device."""

from drivers.errors import ScannerSilent
from drivers.pairing import StagePosition
from drivers.passes.drive import FIRST_PROFILE_S, LOOK_S, PassDrive
from drivers.scanline import Profile
from drivers.scanners.face import FreeRunningScanner
from drivers.stages.face import DrivenStage

_PERIODS_AT_REST = 3.0
"""A line at rest is taken so many line periods after the stage has stopped: a latency of up to that, which the rig file
does not tell, then does no harm."""


def run_at_rest(drive: PassDrive, scanner: FreeRunningScanner, stage: DrivenStage) -> None:
    """Run the pass; raises a DriverError when stage or scanner fail, StageStopped when it is to end."""
    order, lines = drive.order, drive.lines
    drive.move_to(stage, order.start_mm)
    drive.stopping.refuse()
    scanner.start_profiles()
    for profile in drive.first_profile():
        lines.only_clock(profile)
        lines.leave_out(profile, "between_stops")
    for number in range(order.line_count):
        reading = drive.move_to(stage, order.position_mm(number))
        rests_since_s = drive.clock() + drive.description.pairing.latency_uncertainty_s
        profile = _profile_after(drive, rests_since_s)
        lines.at_position(profile, StagePosition(reading.position_mm, reading.uncertainty_mm))
        drive.stage_events()


def _profile_after(drive: PassDrive, time_s: float) -> Profile:
    """Return the first profile exposed well after `time_s`; those before are left out."""
    give_up_s = drive.clock() + FIRST_PROFILE_S
    lines = drive.lines
    found: Profile | None = None
    while found is None:
        for profile in drive.fetch(LOOK_S):
            lines.only_clock(profile)
            settled_s = time_s + _PERIODS_AT_REST * lines.clock.period_s
            if found is None and lines.exposure_s(profile) > settled_s:
                found = profile
            else:
                lines.leave_out(profile, "between_stops")
        if found is None:
            drive.stopping.refuse()
        if found is None and drive.clock() > give_up_s and drive.scanner.is_connected:
            raise ScannerSilent(f"the scanner has sent no profile for {FIRST_PROFILE_S:g} s")
    return found
