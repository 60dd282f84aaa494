"""Rigs over real pseudo-terminals: every line lies where the stage truly was, and every profile is accounted for."""

import contextlib
import math
import time

import numpy as np
import pytest

from drivers.errors import DriverError
from drivers.protocols.scanner_events import Advice, PassEnded
from drivers.protocols.stage_events import StageDisconnected, StageReconnected
from drivers.rig_limits import PassOrder
from tests.end_to_end.rig_bench import LATENCY_UNCERTAINTY_S, TURNTABLE, Bench, true_mm, wedge
from tests.end_to_end.running import wait_for
from tests.end_to_end.stages import signed


@pytest.fixture
def stack():
    with contextlib.ExitStack() as opened:
        yield opened


def assert_accounted(bench, lines, report):
    """What the scanner sent is lines, or left out or lost for a reason: in the report, and on each pass of the wire."""
    assert report.balances
    passes = bench.rig.pass_tallies()
    assert all(told.lines.balances and told.chunks.balances for told in passes.values())
    for key, told in passes.items():
        assert told.lines.stored == sum((line.boot_id, line.pass_index) == key for line in lines)
    assert sum(told.lines.sent for told in passes.values()) == bench.rig.tally().lines.sent
    left_out = {reason: sum(told.lines.lost.get(reason, 0) for told in passes.values()) for reason in report.left_out}
    assert left_out == report.left_out


ROUNDED_MM = 0.06
"""The lidar rounds to whole millimetres of the wedge's height, each of which is a twentieth of travel."""


@pytest.mark.parametrize("kind", ["grbl", pytest.param("zaber", marks=pytest.mark.long)])
def test_every_line_of_a_moving_lidar_lies_where_it_is_said_within_the_stated_uncertainty(stack, kind):
    bench = Bench(stack, kind=kind)
    order = PassOrder(signed(kind, 5.0), signed(kind, 14.0), 0.4, 4.0)
    lines, told, ended = bench.scan(order)
    assert (ended.reason, ended.failure) == ("reached_end", None)
    report = ended.report
    assert_accounted(bench, lines, report)
    assert report.lines == len(lines) > 0
    assert report.nominal_spacing_mm == 0.4
    assert all(line.line_spacing_mm == 0.4 for line in lines)
    # The rig file tells of no latency: scans were made earlier than it takes them to be.
    late_mm = order.speed_mm_per_s * bench.untold_late_s
    for line in lines:
        assert abs(abs(line.position_mm) - true_mm(line)) <= report.largest_uncertainty_mm + late_mm + ROUNDED_MM
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
    assert [true_mm(line) for line in lines] == pytest.approx([5.0, 5.5, 6.0], abs=ROUNDED_MM + before_rest_mm(bench))
    assert_accounted(bench, lines, ended.report)
    assert ended.report.left_out["between_stops"] > 0
    assert ended.report.median_step_mm == pytest.approx(-0.5, abs=1e-3)
    assert ended.report.reversed_steps == 0
    assert bench.rig.laser_on is False


def before_rest_mm(bench):
    """How far the stage may have had to go at the exposure of a line at rest: 0 unless all scans came very late."""
    waited_s = LATENCY_UNCERTAINTY_S + 3.0 * SCAN_S
    return bench.rig.limits.speed_mm_per_s[1] * max(0.0, bench.untold_late_s - waited_s)


SCAN_S = 0.1
PILLAR_RADIUS_MM, PILLAR_OFF_MM = 50.0, 40.0
SENSOR_AWAY_MM = 250.0


def pillar(angles, position_mm):
    """Ranges to an upright pillar that stands beside the axis of a turntable, on which a lidar looks from aside.

    One degree of the turn is one millimetre of arc here; the sensor goes around the part.
    """
    turn = np.radians(position_mm)
    eye = SENSOR_AWAY_MM * np.array([np.sin(turn), -np.cos(turn)])
    ahead = -eye / SENSOR_AWAY_MM
    to_middle = np.array([PILLAR_OFF_MM, 0.0]) - eye
    along = to_middle @ ahead
    aside2 = to_middle @ to_middle - along**2
    if aside2 >= PILLAR_RADIUS_MM**2:
        return np.full(len(angles), np.nan)
    level_mm = along - np.sqrt(PILLAR_RADIUS_MM**2 - aside2)
    return np.where(np.abs(angles) < 0.4, level_mm / np.cos(angles), np.nan)


def turntable_bench(stack):
    mounting = f"translation_mm = [0, -{SENSOR_AWAY_MM}, 30], rotation_deg = [90, 90, 0]"
    return Bench(stack, axis=TURNTABLE, mounting=mounting, scene=pillar)


def off_the_pillar_mm(line):
    """How far the points of a line lie from the surface of the pillar."""
    seen = line.points_mm[np.isfinite(line.points_mm).all(axis=1)]
    assert len(seen) > 50
    return np.hypot(seen[:, 0] - PILLAR_OFF_MM, seen[:, 1]) - PILLAR_RADIUS_MM


def test_a_lidar_before_a_turntable_finds_a_pillar_beside_the_axis_where_it_stands(stack):
    bench = turntable_bench(stack)
    lines, _, ended = bench.scan(PassOrder(-5.0, -45.0, 20.0, 0.0))
    assert ended.reason == "reached_end"
    # One degree of the controller is one millimetre of arc at this radius.
    assert [line.position_mm for line in lines] == pytest.approx([-5, -25, -45], abs=2e-3)
    for line in lines:
        # The lidar rounds to whole millimetres.
        assert np.abs(off_the_pillar_mm(line)).max() < 0.75 + before_rest_mm(bench)
    normals = np.array([line.plane_normal for line in lines])
    turns = np.degrees(np.arccos(np.clip((normals[1:] * normals[:-1]).sum(axis=1), -1, 1)))
    np.testing.assert_allclose(turns, 20.0, atol=0.01)
    assert_accounted(bench, lines, ended.report)


@pytest.mark.long
def test_a_turntable_in_motion_finds_the_pillar_within_the_stated_uncertainty(stack):
    bench = turntable_bench(stack)
    lines, _, ended = bench.scan(PassOrder(-60.0, 60.0, 1.0, 8.0))
    assert (ended.reason, ended.failure) == ("reached_end", None)
    assert lines
    late_mm = 8.0 * bench.untold_late_s + ended.report.largest_uncertainty_mm
    for line in lines:
        assert np.abs(off_the_pillar_mm(line)).max() < 0.75 + np.radians(late_mm) * PILLAR_OFF_MM
    assert_accounted(bench, lines, ended.report)


def test_lines_that_are_counted_lie_one_spacing_apart_also_where_the_lidar_had_no_time_for_some(stack):
    held_up = []

    def wedge_that_holds_up(angles, position_mm):
        """Once, with the stage in motion, the lidar has no time for some scans: it measures them and sends none."""
        if not held_up and position_mm < -5.5:
            held_up.append(position_mm)
            time.sleep(3.5 * SCAN_S)
        return wedge(angles, position_mm)

    bench = Bench(stack, by="count", latency_ms=150.0, scene=wedge_that_holds_up)
    order = PassOrder(-5.0, -9.0, 0.5)
    lines, _, ended = bench.scan(order)
    assert (ended.reason, ended.failure) == ("reached_end", None)
    assert_accounted(bench, lines, ended.report)
    first = round((order.start_mm - lines[0].position_mm) / 0.5)  # not 0 where the first line is missing
    numbers = np.array([first + line.line_index - lines[0].line_index for line in lines])
    np.testing.assert_allclose([line.position_mm for line in lines], [order.position_mm(k) for k in numbers], atol=1e-9)
    missed = numbers[-1] + 1 - len(lines)
    assert first >= 0
    (account,) = bench.rig.pass_tallies().values()
    by_rig = sum(ended.report.left_out.values())
    assert missed <= sum(account.lines.lost.values()) - by_rig == account.lines.lost.get("device_dropped", 0)
    assert account.lines.lost.get("device_dropped", 0) <= bench.lidar.scans_made - bench.lidar.scans_sent
    # Scans are made at even times and the stage goes at even speed: where one was in motion, all others follow.
    truly = np.array([true_mm(line) for line in lines])
    in_motion = (truly > 5.0 + 2.0 * ROUNDED_MM) & (truly < 9.0 - 2.0 * ROUNDED_MM)
    lag_mm = truly[in_motion] - 0.5 * numbers[in_motion]
    np.testing.assert_allclose(lag_mm, lag_mm[:1].repeat(len(lag_mm)), atol=2.0 * ROUNDED_MM)


@pytest.mark.long
def test_a_count_that_does_not_match_the_way_of_the_stage_is_told(stack):
    bench = Bench(stack, by="count")
    _, told, ended = bench.scan(PassOrder(-5.0, -9.0, 0.5, 1.0))  # ten lines a second come 0.1 mm apart, not 0.5
    assert ended.reason == "reached_end"
    assert [event for event in told if isinstance(event, Advice) and "lines and places do not match" in event.text]


def test_a_stop_ends_the_pass_with_the_stage_at_rest_and_the_laser_off(stack):
    bench = Bench(stack)
    bench.rig.start(PassOrder(-5.0, -95.0, 0.1, 0.5))
    wait_for(lambda: bench.device.axes.position(time.monotonic())[0] < -5.2, "the stage to move")
    bench.rig.stop()
    assert not bench.device.axes.is_moving(time.monotonic())
    assert bench.rig.laser_on is False
    lines, _, ended = bench.until_ended()
    assert (ended.reason, ended.failure) == ("stopped", None)
    assert_accounted(bench, lines, ended.report)
    assert bench.device.axes.position(time.monotonic())[0] > -95.0


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
    assert_accounted(bench, lines, ended.report)
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
