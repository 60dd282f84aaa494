"""Rigs over real pseudo-terminals: a simulated lidar looks at a wedge that a simulated stage carries past it.

The height of the wedge under the lidar tells where the stage truly was at each scan, so that every line can be held
against the place it was given.
"""

import contextlib
import math
import threading
import time

import numpy as np
import pytest

from drivers.errors import DriverError
from drivers.protocols.scanner_events import PassEnded
from drivers.protocols.stage_events import StageDisconnected, StageReconnected
from drivers.rig_file import parse_rig
from drivers.rig_limits import PassOrder
from drivers.running_rig import RigPassEnded, RunningRig
from drivers.scanline import Scanline
from simulators.devices.motion import Axes
from simulators.devices.scip import ScipDevice
from simulators.pty_port import PtyPort
from tests.end_to_end.running import wait_for
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
stage_from_sensor = {{ translation_mm = [0, 0, 0] }}
[pairing]
by = "time"
latency_ms = {latency_ms}
latency_uncertainty_ms = 25
"""
LINEAR = "travel_mm = [-100, 100]\nspeed_mm_per_s = [0, 20]"
TURNTABLE = 'axis = "turntable"\nradius_mm = 57.29577951308232\nturn_deg = [-100, 100]\nspeed_deg_per_s = [0, 20]'


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


class Bench:
    """A lidar and a stage, each on its pty, and the rig that drives them."""

    def __init__(self, stack, kind="grbl", axis=LINEAR, latency_ms=None, link=None):
        self.kind = kind
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
        )
        self.description = parse_rig(text)
        self.rig = stack.enter_context(RunningRig(self.description))
        self.rig.stage.home()

    def scene(self, angles, elapsed_s):
        at_s = self.lidar._measuring_since_s + elapsed_s
        depth = FLOOR_MM + GAIN * abs(self.position_mm(at_s))
        return np.where(np.abs(angles) < 1.0, depth / np.cos(angles), np.nan)

    def position_mm(self, at_s):
        place = self.device.axes.position(at_s)[0]
        return place * MICROSTEP_MM if self.kind == "zaber" else place

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


@pytest.fixture
def stack():
    with contextlib.ExitStack() as opened:
        yield opened


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


@pytest.mark.parametrize("kind", ["grbl", pytest.param("zaber", marks=pytest.mark.long)])
def test_every_line_of_a_moving_lidar_lies_where_it_is_said_within_the_stated_uncertainty(stack, kind):
    bench = calibrated(stack, kind=kind)
    order = PassOrder(signed(kind, 5.0), signed(kind, 14.0), 0.4, 4.0)
    lines, told, ended = bench.scan(order)
    assert (ended.reason, ended.failure) == ("reached_end", None)
    report = ended.report
    assert report.balances
    assert report.lines == len(lines) >= 10
    assert report.nominal_spacing_mm == 0.4
    assert all(line.line_spacing_mm == 0.4 for line in lines)
    for line in lines:
        assert abs(abs(line.position_mm) - true_mm(line)) <= report.largest_uncertainty_mm + 0.08
    assert report.largest_uncertainty_mm < 2.0
    steps = [line.step_mm for line in lines[1:]]
    np.testing.assert_allclose(steps, np.diff([line.position_mm for line in lines]), atol=1e-9)
    assert any(isinstance(event, PassEnded) for event in told)
    assert bench.rig.laser_on is False
    assert not bench.device.axes.is_moving(time.monotonic())


def test_measuring_at_rest_puts_each_line_where_the_stage_stood(stack):
    bench = Bench(stack)
    lines, _, ended = bench.scan(PassOrder(-5.0, -6.0, 0.5, 0.0))
    assert ended.reason == "reached_end"
    assert [line.position_mm for line in lines] == pytest.approx([-5.0, -5.5, -6.0], abs=1e-3)
    assert [true_mm(line) for line in lines] == pytest.approx([5.0, 5.5, 6.0], abs=0.06)
    assert ended.report.balances
    assert ended.report.left_out["between_stops"] > 0
    assert ended.report.median_step_mm == pytest.approx(-0.5, abs=1e-3)
    assert ended.report.reversed_steps == 0
    assert bench.rig.laser_on is False


@pytest.mark.long
def test_a_lidar_before_a_turntable_gives_scanlines_all_around(stack):
    bench = Bench(stack, axis=TURNTABLE)
    lines, _, ended = bench.scan(PassOrder(-5.0, -15.0, 5.0, 0.0))
    assert ended.reason == "reached_end"
    # One degree of the controller is one millimetre of arc at this radius.
    assert [line.position_mm for line in lines] == pytest.approx([-5, -10, -15], abs=2e-3)
    normals = np.array([line.plane_normal for line in lines])
    turns = np.degrees(np.arccos(np.clip((normals[1:] * normals[:-1]).sum(axis=1), -1, 1)))
    np.testing.assert_allclose(turns, 5.0, atol=0.01)


def test_a_stop_ends_the_pass_with_the_stage_at_rest_and_the_laser_off(stack):
    bench = Bench(stack)
    bench.rig.start(PassOrder(-5.0, -95.0, 0.5, 5.0))
    wait_for(lambda: bench.device.axes.position(time.monotonic())[0] < -7.0, "the stage to move")
    bench.rig.stop()
    assert not bench.device.axes.is_moving(time.monotonic())
    assert bench.rig.laser_on is False
    _, _, ended = bench.until_ended()
    assert (ended.reason, ended.failure) == ("stopped", None)
    assert ended.report.balances
    assert bench.device.axes.position(time.monotonic())[0] > -60.0


@pytest.mark.long
def test_a_pulled_cable_of_the_stage_pauses_the_pass_and_it_goes_on_behind_the_last_line(stack, tmp_path):
    bench = Bench(stack, link=tmp_path / "stage")
    bench.rig.start(PassOrder(-5.0, -15.0, 0.5, 5.0))
    wait_for(lambda: bench.device.axes.position(time.monotonic())[0] < -7.0, "the stage to move")
    bench.stage_port.unplug()
    time.sleep(0.3)
    bench.stage_port.replug()
    lines, told, ended = bench.until_ended()
    assert (ended.reason, ended.failure) == ("reached_end", None)
    assert {StageDisconnected, StageReconnected} <= {type(event) for event in told}
    assert ended.report.balances
    positions = np.sort([abs(line.position_mm) for line in lines])
    assert positions[0] < 6.5
    assert positions[-1] > 14.0


def test_what_cannot_be_driven_is_refused_before_anything_moves(stack):
    bench = Bench(stack)
    for order, said in (
        (PassOrder(-5.0, -150.0, 0.5), "end at -150 mm is outside the stage's travel of -100 to 100 mm"),
        (PassOrder(-5.0, -15.0, 0.5, 21.0), "above the stage's 20 mm/s"),
    ):
        with pytest.raises(DriverError, match=said):
            bench.rig.start(order)
    bench.device.reboot(time.monotonic())
    wait_for(lambda: not bench.rig.stage.position_known, "the reset to be seen")
    with pytest.raises(DriverError, match="home it, or state where it is"):
        bench.rig.start(PassOrder(-5.0, -10.0, 0.5))
    assert bench.rig.laser_on is False
    assert not math.isnan(bench.rig.limits.travel_mm[0])
