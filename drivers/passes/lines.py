"""The profiles of one pass: each becomes a scanline that is handed on, or is left out for a reason; knows no device."""

import math
import threading
from collections import deque
from dataclasses import replace

from drivers.pairing import ClockOffset, PairedProfile, StagePosition, StageTrack, TimePairing
from drivers.pass_accounts import PassAccounts, PassReport
from drivers.passes.left_out import LeftOut
from drivers.passes.speeds import line_rate_of
from drivers.passes.told import Told
from drivers.rig import Rig
from drivers.rig_description import Pairing
from drivers.rig_limits import PassOrder
from drivers.scanline import Profile
from drivers.stages.face import StageReading

_EDGE_MM = 1e-3
"""Lines this far outside the ends of a pass still belong to it."""


class PassLines:
    """What becomes of the profiles of one pass.

    At any moment profiles = lines + left out + those that wait for a reading of the stage. One thread enters profiles;
    `report` may be asked by any.
    """

    def __init__(self, rig: Rig, order: PassOrder, pairing: Pairing, told: Told, left_out: LeftOut) -> None:
        self._rig = rig
        self.order = order
        self._told = told
        self._left_out = left_out
        self._pairing = TimePairing(pairing, self._leave_out_counted)
        self._lock = threading.Lock()
        self._accounts = PassAccounts(order.line_spacing_mm)
        self._latency_s = pairing.latency_uncertainty_s
        self._counted_from_mm = math.nan
        self._counted_since_s = math.inf
        self._first_counted: int | None = None
        self._uncounted: Profile | None = None  # the latest one that was exposed before the stage set off
        self._counted: deque[tuple[Profile, float]] = deque(maxlen=400)  # and the places they came to

    # ---- profiles come in -------------------------------------------------------------------------------------------

    def at_position(self, profile: Profile, at: StagePosition) -> None:
        """A profile whose place is known."""
        self._count()
        self._place(PairedProfile(profile, at))

    def by_time(self, profile: Profile) -> None:
        """A profile whose place the readings around it will tell."""
        self._count()
        self._pairing.enter(profile)

    def by_count(self, profile: Profile, speed_mm_per_s: float) -> None:
        """The k-th profile since `count_from` at the k-th place; what was exposed earlier is left out.

        Profiles that are missing count: they were made, and have numbers.
        Its place is uncertain by one line spacing, since the stage may set off at any moment of a line's period, and
        by speed times the uncertainty of the latency.
        """
        self.only_clock(profile)
        if self._first_counted is None and self.exposure_s(profile) < self._counted_since_s:
            self._uncounted = profile
            self.leave_out(profile, "before_start")
            return
        if self._first_counted is None:
            self._first_counted = self._first_since(profile)
        spacing_mm = self.order.line_spacing_mm
        at_mm = self._counted_from_mm + self.order.sign * (profile.line_index - self._first_counted) * spacing_mm
        self._counted.append((profile, at_mm))
        if (at_mm - self.order.end_mm) * self.order.sign > 0.5 * spacing_mm:
            self.leave_out(profile, "outside_pass")
            return
        self.at_position(profile, StagePosition(at_mm, spacing_mm + speed_mm_per_s * self._latency_s))

    def count_from(self, position_mm: float, since_s: float) -> None:
        """The stage sets off at `position_mm`: the first profile exposed after `since_s` is the first there."""
        self._counted_from_mm, self._counted_since_s, self._first_counted = position_mm, since_s, None

    def stop_counting(self) -> None:
        """The stage does not go on: profiles belong to no place until it sets off again."""
        self.count_from(math.nan, math.inf)

    def leave_out(self, profile: Profile, reason: str) -> None:
        """A profile that is not to become a line."""
        self._count()
        self._leave_out_counted(profile, reason)

    def only_clock(self, profile: Profile) -> None:
        """Follow the scanner's clock by a profile that somebody else takes care of."""
        self._pairing.clock.enter(profile.device_time_s, profile.arrival_s)

    def read(self, readings: list[StageReading]) -> None:
        """Take in where the stage was."""
        self._pairing.track.add(readings)

    def settle(self, *, is_over: bool = False) -> None:
        """Make lines of the profiles whose places are known by now; when the pass is over none waits any longer."""
        for paired in self._pairing.due(no_more_readings=is_over):
            self._place(paired)
        with self._lock:
            self._accounts.clock_jumps = self._pairing.clock.jumps

    # ---- what is known ----------------------------------------------------------------------------------------------

    @property
    def clock(self) -> ClockOffset:
        """How the scanner's clock stands to the host's."""
        return self._pairing.clock

    @property
    def track(self) -> StageTrack:
        """Where the stage was."""
        return self._pairing.track

    def exposure_s(self, profile: Profile) -> float:
        """Return when a profile was measured, by the host's clock."""
        return self._pairing.exposure_s(profile)

    @property
    def last_mm(self) -> float:
        """Where the latest line was placed; NaN before the first."""
        with self._lock:
            return self._accounts.last_mm

    @property
    def line_count(self) -> int:
        """Lines so far."""
        with self._lock:
            return self._accounts.lines

    @property
    def counted_period_s(self) -> float:
        """The middle time from one profile that was counted to the next, by the scanner's clock; NaN of a few."""
        rate_hz = line_rate_of([profile for profile, _ in self._counted])
        return math.nan if rate_hz is None else 1.0 / rate_hz

    def counted_and_read(self) -> tuple[float, StagePosition] | None:
        """Return where the latest profile was counted to of those that saw the stage in motion, and where that was.

        None when there is none. When somebody looks does not matter: both places are those of one exposure.
        """
        latest = self.track.latest
        for profile, at_mm in reversed(self._counted):
            read = self.track.at(self.exposure_s(profile), self._latency_s)
            if latest is None or read is None:
                continue
            if abs(read.position_mm - latest.position_mm) > read.uncertainty_mm + _EDGE_MM:
                return at_mm, read
        return None

    def report(self) -> PassReport:
        """The accounts as they stand."""
        with self._lock:
            return self._accounts.report(self.order.sign)

    # ---- inside -----------------------------------------------------------------------------------------------------

    def _count(self) -> None:
        with self._lock:
            self._accounts.profiles += 1

    def _first_since(self, profile: Profile) -> int:
        """Return the number of the first profile after the stage set off; `profile` is the first of them that arrived.

        Those that are missing before it were made at even times after the last early one.
        """
        early = self._uncounted
        if early is None or early.boot_id != profile.boot_id or profile.line_index <= early.line_index + 1:
            return profile.line_index
        early_s = self.exposure_s(early)
        period_s = (self.exposure_s(profile) - early_s) / (profile.line_index - early.line_index)
        if period_s <= 0.0:
            return profile.line_index
        number = early.line_index + math.ceil((self._counted_since_s - early_s) / period_s)
        return min(max(number, early.line_index + 1), profile.line_index)

    def _leave_out_counted(self, profile: Profile, reason: str) -> None:
        self._left_out.enter(profile, reason)
        with self._lock:
            self._accounts.left_out[reason] += 1

    def _place(self, paired: PairedProfile) -> None:
        """Hand on a line; what lies outside the pass, or that nobody fetches, is left out."""
        low, high = sorted((self.order.start_mm, self.order.end_mm))
        at_mm = paired.at.position_mm
        slack_mm = _EDGE_MM + paired.at.uncertainty_mm
        if not low - slack_mm <= at_mm <= high + slack_mm:
            self._leave_out_counted(paired.profile, "outside_pass")
            return
        if not self._told.has_room:
            self._leave_out_counted(paired.profile, "overflow")
            return
        with self._lock:
            step_mm = self._accounts.place(at_mm, paired.at.uncertainty_mm)
        spacing_mm = self.order.line_spacing_mm
        profile = replace(paired.profile, position_mm=at_mm, line_spacing_mm=spacing_mm, step_mm=step_mm)
        self._told.line(self._rig.place(profile))
