"""Stages over real pseudo-terminals: homing, limits, stops, pulled cables, and what is refused."""

import threading
import time

import pytest

from drivers.errors import (
    DriverError,
    PortAbsent,
    PortBusy,
    StageLimit,
    StageNotConnected,
    StagePositionUnknown,
    StageRefused,
    StageSilent,
    StageStopped,
)
from drivers.protocols.stage_events import PositionLost, StageDisconnected, StageReconnected
from simulators.devices.grbl import GrblDevice
from simulators.pty_port import PtyPort
from tests.end_to_end.running import wait_for
from tests.end_to_end.stages import BAUD, KINDS, open_stage, signed, stage_on_pty, where_mm

every_kind = pytest.mark.parametrize("kind", KINDS)
# The conversations are held to these laws in simulated time; the thread and the port, which are one, are held here.
one_kind_or_all = pytest.mark.parametrize(
    "kind", ["grbl", *[pytest.param(kind, marks=pytest.mark.long) for kind in KINDS if kind != "grbl"]]
)


@every_kind
def test_a_stage_homes_goes_where_it_is_sent_and_tells_where_it_was(kind):
    with stage_on_pty(kind) as (stage, device, _):
        assert not stage.position_known
        stage.home()
        assert stage.position_known
        stage.readings()
        there = stage.move_to(signed(kind, 12.5), 40.0)
        assert there.position_mm == pytest.approx(signed(kind, 12.5), abs=0.02)
        assert where_mm(kind, device, time.monotonic()) == pytest.approx(signed(kind, 12.5), abs=0.01)
        readings = stage.readings()
        assert [r.asked_s for r in readings] == sorted(r.asked_s for r in readings)
        assert all(r.asked_s <= r.arrived_s for r in readings)
        assert stage.position_mm == pytest.approx(signed(kind, 12.5), abs=0.02)


@one_kind_or_all
def test_nothing_is_sent_beyond_the_limits_or_while_the_position_is_unknown(kind):
    with stage_on_pty(kind, travel_mm=(-50.0, 50.0)) as (stage, device, _):
        with pytest.raises(StagePositionUnknown, match="home it, or state where it is"):
            stage.start_move(signed(kind, 10.0), 10.0)
        stage.home()
        for target in (51.0, -51.0, float("nan"), float("inf")):
            with pytest.raises(StageLimit, match="soft limits of the stage, -50 to 50 mm"):
                stage.start_move(target, 10.0)
        for speed in (0.0, -1.0, 61.0, float("nan"), float("inf")):
            with pytest.raises(StageLimit, match="60 mm/s"):
                stage.start_move(signed(kind, 10.0), speed)
        assert not device.axes.is_moving(time.monotonic())
        stage.start_move(signed(kind, 40.0), 10.0)
        with pytest.raises(StageRefused, match="under way"):
            stage.start_move(signed(kind, 20.0), 10.0)
        assert stage.finish_move(0.0) is None
        stage.stop()


@one_kind_or_all
def test_a_stop_from_another_thread_ends_a_motion_that_is_waited_for(kind):
    with stage_on_pty(kind) as (stage, device, _):
        stage.home()
        ended = []

        def move():
            try:
                stage.move_to(signed(kind, 200.0), 5.0)
            except StageStopped as error:
                ended.append(error)

        thread = threading.Thread(target=move)
        thread.start()
        wait_for(lambda: device.axes.is_moving(time.monotonic()), "the stage to move")
        stage.stop()
        assert not device.axes.is_moving(time.monotonic())
        thread.join(60)
        assert len(ended) == 1
        assert abs(where_mm(kind, device, time.monotonic())) < 199.0


@one_kind_or_all
def test_leaving_stops_the_motion_and_frees_the_port(kind):
    with stage_on_pty(kind) as (stage, device, port):
        stage.home()
        stage.start_move(signed(kind, 200.0), 5.0)
        wait_for(lambda: device.axes.is_moving(time.monotonic()), "the stage to move")
        with pytest.raises(PortBusy):
            open_stage(kind, str(port.path)).enter()
        stage.exit()
        assert not device.axes.is_moving(time.monotonic())
        stage.exit()
        stage.stop()  # there is nothing left to stop
        with pytest.raises(StageNotConnected):
            stage.home()
        stage.enter()
        assert stage.is_connected


@one_kind_or_all
def test_a_pulled_cable_is_told_and_the_position_is_kept(kind, tmp_path):
    with stage_on_pty(kind, tmp_path / "stage") as (stage, _, port):
        stage.home()
        stage.move_to(signed(kind, 10.0), 40.0)
        stage.stage_events()
        port.unplug()
        wait_for(lambda: not stage.is_connected, "the loss to be seen")
        with pytest.raises(StageNotConnected):
            stage.start_move(0.0, 10.0)
        port.replug()
        wait_for(lambda: stage.is_connected, "the stage to be back")
        told = [type(event) for event in stage.stage_events()]
        assert told == [StageDisconnected, StageReconnected]
        assert stage.move_to(signed(kind, 12.0), 40.0).position_mm == pytest.approx(signed(kind, 12.0), abs=0.02)


def test_a_stage_that_was_moved_while_out_of_sight_has_lost_its_position(tmp_path):
    with stage_on_pty("grbl", tmp_path / "stage") as (stage, device, port):
        stage.home()
        port.unplug()
        wait_for(lambda: not stage.is_connected, "the loss to be seen")
        device.axes.put((-77.0, 0.0, 0.0))
        port.replug()
        wait_for(lambda: stage.is_connected and not stage.position_known, "the loss of the position")
        assert any(isinstance(event, PositionLost) for event in stage.stage_events())
        with pytest.raises(StagePositionUnknown, match="cannot have gone by itself"):
            stage.start_move(0.0, 10.0)


def test_the_user_may_state_where_a_stage_without_switches_is():
    device = GrblDevice({22: 0})
    with PtyPort(device, BAUD) as port, open_stage("grbl", str(port.path), (0.0, 100.0)) as stage:
        with pytest.raises(StageRefused, match="22=1"):
            stage.home()
        with pytest.raises(StageLimit):
            stage.set_position(500.0)
        stage.set_position(40.0)
        assert stage.move_to(52.5, 40.0).position_mm == pytest.approx(52.5, abs=0.01)
        assert device.axes.position(time.monotonic())[0] == pytest.approx(12.5, abs=0.01)


def test_who_does_not_answer_or_is_not_there_is_told_apart(tmp_path):
    with pytest.raises(PortAbsent):
        open_stage("grbl", str(tmp_path / "none")).enter()
    with pytest.raises(PortAbsent, match="scanner devices"):
        open_stage("grbl", "usb:dead:beef").enter()
    device = GrblDevice()
    device.is_mute = True
    with PtyPort(device, BAUD) as port:
        device.transmit(0.0, 9999)
        stage = open_stage("zaber", str(port.path))
        stage._patience_s = 1.0
        with pytest.raises(StageSilent, match="115200 baud"):
            stage.enter()


def test_options_are_checked_by_name_and_type():
    for options, said in (
        ({"letr": "X"}, "did you mean letter"),
        ({"letter": "Q"}, "one of X, Y"),
        ({"tolerance": "small"}, "must be a number"),
    ):
        with pytest.raises(DriverError, match=said):
            open_stage("grbl", "/dev/null", **options)
    with pytest.raises(DriverError, match="microstep"):
        open_stage("zaber", "/dev/null", microstep=0.0)
    with pytest.raises(DriverError, match="1 to 99"):
        open_stage("zaber", "/dev/null", device=100)
