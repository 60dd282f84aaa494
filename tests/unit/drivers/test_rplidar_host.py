"""An RPLIDAR and its driver's half in simulated time: models and rates, health, stale streams, losses, motor."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from drivers.errors import ScannerRefused, ScannerSilent, ScannerTimeout
from drivers.protocols.conversation import Phase
from drivers.protocols.rplidar_host import RplidarHost, RplidarOptions
from drivers.protocols.scanner_events import Advice, Disconnected, PassEnded, Reconnected
from simulators.devices.rplidar import A1, A1_OLD, A2, A3, S1, Model, RplidarDevice, ScanMode
from tests.unit.drivers.conversation_bench import ConversationBench, flat_scene


def bench(device: RplidarDevice | Model = A1, **options: object) -> ConversationBench:
    lidar = device if isinstance(device, RplidarDevice) else RplidarDevice(flat_scene(), device)
    return ConversationBench(partial(RplidarHost, options=RplidarOptions(**options)), lidar)


@pytest.mark.parametrize(
    ("model", "mode", "points"),
    [
        (A1, "Express", 394),
        (A1_OLD, "standard", 197),
        (A2, "express", 800),
        (S1, "DenseBoost", 920),
        (A3, "Sensitivity", 1600),
    ],
)
def test_each_model_is_found_at_its_rate_and_read_in_the_best_mode_it_has(model: Model, mode: str, points: int) -> None:
    lidar = bench(model).meet()
    assert lidar.host.baud_rate == model.baud_rate
    assert lidar.host.info.calibration_id.endswith(f"mode {mode}")
    assert lidar.host.info.points_per_line == points
    assert lidar.host.info.device_id == "101112131415161718191A1B1C1D1E1F"
    lidar.start()
    assert lidar.host.laser_on is True
    lidar.scan(20)
    lidar.stop()
    assert not lidar.device.laser_on
    assert lidar.device.motor_pwm == 0
    assert lidar.told == [PassEnded(1, "stopped")]
    tally = lidar.host.tally()
    assert tally.lines.sent == tally.lines.whole == len(lidar.lines)
    for line in lidar.lines:
        assert abs(len(line.x_mm) - points) <= 96
        ahead = np.abs(line.x_mm) < 150
        # the range is of its own instant, up to a turn after the first sample; angles are rounded to 1/64 degree
        np.testing.assert_allclose(line.z_mm[ahead], -200 - 0.1 * line.line_index, atol=1.5)
    np.testing.assert_allclose(np.diff([line.device_time_s for line in lidar.lines]), 0.1, atol=0.005)


def test_angles_turn_from_clockwise_to_the_convention_of_all_lidars() -> None:
    def wall_to_the_left(angles_rad: np.ndarray, _elapsed_s: float) -> np.ndarray:
        return np.where((angles_rad > 0.2) & (angles_rad < 0.5), 1000.0, np.nan)

    lidar = bench(RplidarDevice(wall_to_the_left), mode="standard").meet()
    lidar.start()
    lidar.scan(1)
    seen = ~np.isnan(lidar.lines[0].x_mm)
    angle = np.arctan2(lidar.lines[0].x_mm[seen], -lidar.lines[0].z_mm[seen])
    assert angle.min() > 0.19
    assert angle.max() < 0.51
    assert seen.sum() > 5


@pytest.mark.parametrize("mode", ["standard", "express"])
def test_a_field_of_view_is_all_that_is_handed_on(mode: str) -> None:
    lidar = bench(mode=mode, field_of_view_rad=(-0.5, 0.5)).meet()
    lidar.start()
    lidar.scan(3)
    for line in lidar.lines:
        assert not np.isnan(line.x_mm).any()
        assert np.abs(np.arctan2(line.x_mm, -line.z_mm)).max() <= 0.5 + 1e-9


def test_a_mode_that_is_not_there_is_refused_with_those_that_are() -> None:
    lidar = bench(mode="warp")
    lidar.plug()
    lidar.run(10.0, lambda: lidar.host.phase is Phase.UNMET)
    assert str(lidar.host.failure) == "this lidar has no mode 'warp'; its modes are Express, Standard"


def test_a_mode_whose_answers_nobody_can_read_is_refused_by_type_and_never_chosen() -> None:
    hq = replace(A1, modes=(*A1.modes, ScanMode("HQ", 0x83, 63.0, 25.0)), typical=2)
    lidar = bench(hq, mode="hq")
    lidar.plug()
    lidar.run(10.0, lambda: lidar.host.phase is Phase.UNMET)
    assert "'hq' of this lidar sends answers of type 83h, which this driver does not read" in str(lidar.host.failure)
    assert bench(hq).meet().host.info.calibration_id.endswith("mode Express")


@pytest.mark.parametrize("mode", ["standard", "express"])
def test_a_stale_stream_is_ended_before_anything_is_counted(mode: str) -> None:
    lidar = bench(mode=mode).meet()
    lidar.start()
    lidar.scan(3)
    heir = bench(lidar.device, mode=mode)
    heir.now_s = lidar.now_s
    heir.meet()
    assert not lidar.device.laser_on
    assert heir.host.tally().damage == {}
    heir.start()
    heir.scan(3)


def test_a_protection_stop_is_reset_once_over_the_greeting_and_told() -> None:
    lidar = bench(RplidarDevice(flat_scene(), health=(2, 0x8001))).meet()
    assert [event.text for event in lidar.told_of(Advice)] == [
        "the lidar was in its protection stop (code 8001h) and has been reset"
    ]
    lidar.start()
    lidar.scan(2)
    stuck = bench(RplidarDevice(flat_scene(), health=(2, 0x8001), is_stuck=True))
    stuck.plug()
    stuck.run(20.0, lambda: stuck.host.phase is Phase.UNMET)
    assert isinstance(stuck.host.failure, ScannerRefused)
    assert "motor blocked" in str(stuck.host.failure)
    assert "warns of its health (code 0007h)" in bench(RplidarDevice(flat_scene(), health=(1, 7))).meet().told[0].text


def test_the_motor_is_switched_both_ways_models_have() -> None:
    lidar = bench(A2).meet()
    assert lidar.host.dtr is True
    lidar.start()
    assert lidar.host.dtr is False
    assert lidar.device.motor_pwm == 660
    lidar.stop()
    assert lidar.host.dtr is True
    assert lidar.device.motor_pwm == 0


def test_firmware_is_asked_only_for_what_it_has() -> None:
    heard = bytearray()

    class Ear(RplidarDevice):
        def receive(self, data: bytes, now_s: float) -> None:
            heard.extend(data)
            super().receive(data, now_s)

    bench(Ear(flat_scene(), A1_OLD)).meet()
    assert b"\xa5\x59" not in heard
    assert b"\xa5\x84" not in heard
    heard.clear()
    bench(Ear(flat_scene(), A2)).meet()
    assert b"\xa5\x59" in heard
    assert b"\xa5\x84" not in heard


def test_nobody_answers_is_told_with_the_rates_tried() -> None:
    class Mute(RplidarDevice):
        def receive(self, data: bytes, now_s: float) -> None:
            pass

    lidar = bench(Mute(flat_scene()))
    lidar.plug()
    lidar.run(20.0, lambda: lidar.host.phase is Phase.UNMET)
    assert isinstance(lidar.host.failure, ScannerSilent)
    assert "115200, 256000, 460800, 1000000 baud" in str(lidar.host.failure)


@pytest.mark.parametrize("mode", ["standard", "express"])
def test_lost_bytes_cost_samples_that_are_told_missing(mode: str) -> None:
    rng = np.random.default_rng(5)
    lidar = bench(mode=mode).meet()
    lidar.start()
    lidar.corrupt = lambda data: bytes(byte for byte in data if rng.random() > 2e-4)
    lidar.scan(60)
    tally = lidar.host.tally()
    assert tally.lines.balances
    assert tally.lines.partial == sum(not line.is_whole for line in lidar.lines) > 5
    assert tally.bytes_skipped > 0
    for line in lidar.lines:
        np.testing.assert_array_equal(np.isnan(line.x_mm[line.missing]), True)
        if mode == "express":  # its check lets one damaged capsule in 256 through, and none of these
            ahead = np.abs(line.x_mm) < 150
            np.testing.assert_allclose(line.z_mm[ahead], -200 - (lidar.now_s - 100) / 2, atol=6)


def test_a_cut_cable_is_healed_and_the_gap_is_in_the_account() -> None:
    lidar = bench().meet()
    lidar.start()
    lidar.scan(5)
    lidar.unplug()
    lidar.run(4.0)
    lidar.plug()
    lidar.scan(5)
    assert [type(event) for event in lidar.told][:2] == [Disconnected, Reconnected]
    tally = lidar.host.tally()
    assert tally.lines.balances
    assert 30 <= tally.lines.lost["disconnected"] <= 60
    times = [line.device_time_s for line in lidar.lines]
    assert times == sorted(times)


def test_a_lidar_that_falls_silent_is_met_anew() -> None:
    lidar = bench().meet()
    lidar.start()
    lidar.scan(5)
    lidar.device.receive(b"\xa5\x40", lidar.now_s)  # resets itself, greeting and all
    lidar.scan(5)
    assert [type(event) for event in lidar.told][:2] == [Disconnected, Reconnected]


def test_a_stop_that_is_not_answered_is_a_timeout_and_the_laser_unknown() -> None:
    lidar = bench().meet()
    lidar.start()
    lidar.lose_to_device = lambda: True
    with pytest.raises(ScannerTimeout, match="laser may be on"):
        lidar.stop()
    assert lidar.host.laser_on is None
