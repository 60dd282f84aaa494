"""A rig over real pseudo-terminals: a simulated lidar looks at a wedge that a simulated stage carries past it.

The height of the wedge under the lidar tells where the stage truly was at each scan, so that every line can be held
against the place it was given.
"""

import contextlib
import threading
import time

import numpy as np

from drivers.rig_file import parse_rig
from drivers.rig_limits import PassOrder
from drivers.running_rig import RigPassEnded, RunningRig
from drivers.scanline import Scanline
from simulators.devices.motion import Axes
from simulators.devices.scip import ScipDevice
from simulators.pty_port import PtyPort
from tests.end_to_end.stages import BAUD, MICROSTEP_MM, new_device, signed

GAIN = 20.0  # mm of height for each mm of travel: the lidar rounds to whole millimetres
FLOOR_MM = 200.0
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
latency_uncertainty_ms = 25
"""
LINEAR = "travel_mm = [-100, 100]\nspeed_mm_per_s = [0, 20]"
TURNTABLE = 'axis = "turntable"\nradius_mm = 57.29577951308232\nturn_deg = [-100, 100]\nspeed_deg_per_s = [0, 20]'


def wedge(angles, position_mm):
    """Ranges over a wedge that rises along the travel."""
    return np.where(np.abs(angles) < 1.0, (FLOOR_MM + GAIN * abs(position_mm)) / np.cos(angles), np.nan)


class LockedAxes(Axes):
    """Axes that the stage's thread moves and the lidar's thread looks at."""

    def __init__(self, count, acceleration):
        super().__init__(count, acceleration)
        lock = threading.RLock()
        for name in ("position", "speed", "is_moving", "blocks", "planned", "go", "brake", "resume", "halt", "put"):
            setattr(self, name, self._locked(getattr(self, name), lock))

    @staticmethod
    def _locked(method, lock):
        def call(*args, **kwargs):
            with lock:
                return method(*args, **kwargs)

        return call


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
        self.kind = kind
        self.see = scene or wedge
        self.device = new_device(kind)
        self.device.axes = LockedAxes(1 if kind == "zaber" else 3, 200_000.0 if kind == "zaber" else 500.0)
        self.lidar = ScipDevice(self.scene)
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
            by=by,
            mounting=mounting,
        )
        self.rig_text = text

    def scene(self, angles, elapsed_s):
        return self.see(angles, self.position_mm(self.lidar._measuring_since_s + elapsed_s))

    def position_mm(self, at_s):
        place = self.device.axes.position(at_s)[0]
        return place * MICROSTEP_MM if self.kind == "zaber" else place


class Bench(Devices):
    """The devices, and the rig that drives them."""

    def __init__(self, stack, **options):
        super().__init__(stack, **options)
        self.description = parse_rig(self.rig_text)
        self.rig = stack.enter_context(RunningRig(self.description))
        self.rig.stage.home()

    def scan(self, order):
        self.rig.start(order)
        return self.until_ended()

    def until_ended(self, on_event=lambda event: None):
        lines, told = [], []
        deadline_s = time.monotonic() + 90.0
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


def calibrated(stack, **options):
    """A bench whose latency is known: the lidar tells when it began to count, the host when the bytes were there."""
    with contextlib.ExitStack() as first:
        trial = Bench(first, **options)
        order = PassOrder(signed(trial.kind, 2.0), signed(trial.kind, 4.0), 1.0, 4.0)
        lines, _, _ = trial.scan(order)
        assert lines
        latency_ms = 1000.0 * max(0.0, latency_of(trial, lines))
    return Bench(stack, latency_ms=latency_ms, **options)


def latency_of(bench, lines):
    """Time by which positions run ahead of the truth in a pass of constant speed."""
    moving = [line for line in lines if abs(line.step_mm) > 0.05] or lines
    lags = [(abs(line.position_mm) - true_mm(line)) / 4.0 for line in moving]
    return float(np.median(lags))
