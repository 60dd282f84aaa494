"""A rig over real pseudo-terminals: a simulated lidar looks at a wedge that a simulated stage carries past it.

The height of the wedge under the lidar tells where the stage truly was at each scan, so that every line can be held
against the place it was given. How late scans arrived is measured, so that a busy machine makes no place wrong.
"""

import math
import threading
import time
from bisect import bisect_right

import numpy as np

from drivers.rig_file import parse_rig
from drivers.running_rig import RigPassEnded, RunningRig
from drivers.scanline import Profile, Scanline
from drivers.scanners.known import open_scanner
from simulators.devices.motion import Axes
from simulators.devices.scip import ScipDevice
from simulators.pty_port import PtyPort
from tests.end_to_end.stages import BAUD, MICROSTEP_MM, new_device

GAIN = 20.0  # mm of height for each mm of travel: the lidar rounds to whole millimetres
FLOOR_MM = 200.0
LATENCY_UNCERTAINTY_S = 0.025
RIG = """
name = "wedge"
[scanner]
kind = "scip"
port = "{scanner}"
field_of_view_mm = [-50, 50]
[stage]
kind = "{kind}"
port = "{stage}"
{axis}
{options}
[mounting]
stage_from_sensor = {{ {mounting} }}
[pairing]
by = "{by}"
latency_ms = {latency_ms}
latency_uncertainty_ms = {latency_uncertainty_ms}
"""
LINEAR = "travel_mm = [-100, 100]\nspeed_mm_per_s = [0, 20]"
TURNTABLE = 'axis = "turntable"\nradius_mm = 57.29577951308232\nturn_deg = [-100, 100]\nspeed_deg_per_s = [0, 20]'


def wedge(angles, position_mm):
    """Ranges over a wedge that rises along the travel."""
    return np.where(np.abs(angles) < 1.0, (FLOOR_MM + GAIN * abs(position_mm)) / np.cos(angles), np.nan)


class LockedAxes(Axes):
    """Axes that the stage's thread moves and the lidar's thread looks at, also at where they were a while ago."""

    def __init__(self, count, acceleration):
        super().__init__(count, acceleration)
        self._lock = threading.RLock()
        self._motions = []  # (since_s, start, end, profile or None at rest), one after another
        for name in ("speed", "is_moving", "blocks", "planned", "resume", "halt", "put"):
            setattr(self, name, self._locked(getattr(super(), name)))

    def _locked(self, method):
        def call(*args, **kwargs):
            with self._lock:
                return method(*args, **kwargs)

        return call

    def go(self, target, speed, now_s):
        """Set off now: a thread that was held up since `now_s` must not rewrite what the lidar saw meanwhile."""
        with self._lock:
            super().go(target, speed, max(now_s, time.monotonic()))

    def brake(self, now_s, *, keep=False):
        with self._lock:
            at_s = max(now_s, time.monotonic())
            super().brake(at_s, keep=keep)
            self._motions.append((at_s, self._start, self._end, self._profile))

    def position(self, now_s):
        with self._lock:
            return super().position(now_s)

    def _next(self):
        super()._next()
        if self._profile is not None:
            self._motions.append((self._since_s, self._start, self._end, self._profile))

    def first_at(self, at_s):
        """Where the first axis was at a time up to now."""
        with self._lock:
            self._advance(at_s)
            latest = bisect_right(self._motions, at_s, key=lambda motion: motion[0]) - 1
            if latest < 0:
                return self._motions[0][1][0] if self._motions else self._start[0]
            since_s, start, end, profile = self._motions[latest]
            length = math.dist(start, end)
            if profile is None or length == 0.0:
                return start[0]
            return start[0] + (end[0] - start[0]) * min(profile.distance(at_s - since_s) / length, 1.0)


class Watched:
    """A scanner, and how late its profiles arrived since the latest start: the first of them, and the fastest."""

    def __init__(self, scanner, lidar):
        self._scanner = scanner
        self._lidar = lidar
        self.first_s = self.fastest_s = math.nan

    def __getattr__(self, name):
        return getattr(self._scanner, name)

    def start_profiles(self, **options):
        self.first_s = self.fastest_s = math.nan
        return self._scanner.start_profiles(**options)

    def events(self, timeout_s):
        happened = self._scanner.events(timeout_s)
        for profile in happened:
            if isinstance(profile, Profile):
                late_s = profile.arrival_s - self._lidar.exposed_s(profile.device_time_s)
                self.first_s = late_s if math.isnan(self.first_s) else self.first_s
                self.fastest_s = late_s if math.isnan(self.fastest_s) else min(self.fastest_s, late_s)
        return happened


class Lidar(ScipDevice):
    """A lidar that can be asked when something was that its clock tells."""

    def exposed_s(self, device_time_s):
        return self._clock_from_s + device_time_s

    def measured_since_s(self):
        return self._measuring_since_s


class Devices:
    """A lidar and a stage, each on its pty; `rig_text` is the rig file that puts them together."""

    def __init__(
        self,
        stack,
        kind="grbl",
        axis=LINEAR,
        latency_ms=None,
        link=None,
        by="time",
        mounting="translation_mm = [0, 0, 0]",
        scene=None,
    ):
        self.told_late_s = (latency_ms or 0.0) / 1e3
        self.kind = kind
        self.see = scene or wedge
        self.device = new_device(kind)
        self.device.axes = LockedAxes(1 if kind == "zaber" else 3, 200_000.0 if kind == "zaber" else 500.0)
        self.lidar = Lidar(self.scene)
        lidar_port = stack.enter_context(
            PtyPort(self.lidar, self.lidar.baud_rate, rng=np.random.default_rng(1), heeds_client_rate=True)
        )
        self.lidar_port = lidar_port
        self.stage_port = stack.enter_context(PtyPort(self.device, BAUD, link_path=link))
        options = f"options = {{ microstep = {MICROSTEP_MM} }}" if kind == "zaber" else ""
        text = RIG.format(
            scanner=lidar_port.path,
            stage=self.stage_port.path,
            kind=kind,
            axis=axis,
            options=options,
            latency_ms=latency_ms or 0.0,
            latency_uncertainty_ms=1e3 * LATENCY_UNCERTAINTY_S,
            by=by,
            mounting=mounting,
        )
        self.rig_text = text

    def scene(self, angles, elapsed_s):
        return self.see(angles, self.position_mm(self.lidar.measured_since_s() + elapsed_s))

    def position_mm(self, at_s):
        place = self.device.axes.first_at(at_s)
        return place * MICROSTEP_MM if self.kind == "zaber" else place


class Bench(Devices):
    """The devices, and the rig that drives them."""

    def __init__(self, stack, **options):
        super().__init__(stack, **options)
        self.description = parse_rig(self.rig_text)
        choice = self.description.scanner
        scanner = open_scanner(choice.kind, choice.port, choice.baud_rate, choice.options)
        self.watched = Watched(scanner, self.lidar)
        self.rig = stack.enter_context(RunningRig(self.description, scanner=self.watched))
        self.rig.stage.home()

    @property
    def untold_late_s(self):
        """How wrong the rig may be about when scans were made: it knows but how late the fastest so far was."""
        told_s = self.told_late_s
        return max(abs(self.watched.first_s - told_s), abs(self.watched.fastest_s - told_s))

    def scan(self, order):
        self.rig.start(order)
        return self.until_ended()

    def until_ended(self, on_event=lambda event: None):
        lines, told = [], []
        deadline_s = time.monotonic() + 100.0
        while time.monotonic() < deadline_s:
            for event in self.rig.events(0.2):
                (lines if isinstance(event, Scanline) else told).append(event)
                on_event(event)
                if isinstance(event, RigPassEnded):
                    return lines, told, event
        raise AssertionError(f"the pass did not end: {told}, {self.rig.report()}")


def true_mm(line):
    """Where the stage was, from what the lidar saw under itself."""
    heights = line.points_mm[:, 2]
    middle = heights[np.isfinite(heights)]
    ahead = middle[len(middle) // 2]
    return (-ahead - FLOOR_MM) / GAIN
