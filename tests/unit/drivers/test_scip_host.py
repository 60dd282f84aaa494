"""A lidar of SCIP 2.0 and its driver's half in simulated time: meeting, rates, quirks, losses, the clock's wrap."""

from functools import partial

import numpy as np
import pytest

from drivers.errors import ScannerNotConnected, ScannerRefused, ScannerSilent, ScannerTimeout
from drivers.protocols.conversation import Phase
from drivers.protocols.scanner_events import Advice, ClockJumped, Disconnected, OtherDevice, PassEnded, Reconnected
from drivers.protocols.scip_host import ScipHost
from drivers.protocols.scip_plan import ScipOptions, scan_bytes
from simulators.devices.scip import Quirks, ScipDevice
from simulators.devices.scip_scans import URG_04LX, UTM_30LX
from tests.unit.drivers.conversation_bench import ConversationBench, flat_scene

AHEAD = (-0.8, 0.8)


def bench(device: ScipDevice | None = None, **options: object) -> ConversationBench:
    chosen = ScipOptions(**({"field_of_view_rad": AHEAD, "command": "MS"} | options))
    return ConversationBench(partial(ScipHost, options=chosen), device or ScipDevice(flat_scene()))


def test_a_lidar_is_found_at_its_own_rate_and_taken_to_the_rate_to_work_at() -> None:
    lidar = bench().meet()
    assert lidar.host.info.device_id == "H0000001"
    assert lidar.host.baud_rate == lidar.device.baud_rate == 115_200
    assert lidar.told == []
    assert lidar.host.laser_on is False


@pytest.mark.parametrize("rate", [38_400, 57_600, 250_000, 750_000])
def test_any_rate_is_found_by_trying(rate: int) -> None:
    lidar = bench(ScipDevice(flat_scene(), baud_rate=rate), work_rate=None).meet()
    assert lidar.host.baud_rate == rate


def test_scans_become_profiles_in_the_sensor_frame_with_the_devices_own_time() -> None:
    lidar = bench(work_rate=750_000).meet()
    lidar.start()
    assert lidar.host.laser_on is True
    lidar.scan(30)
    lidar.stop()
    assert not lidar.device.laser_on
    assert lidar.told == [PassEnded(1, "stopped")]
    tally = lidar.host.tally()
    assert tally.lines.sent == tally.lines.whole == len(lidar.lines) == lidar.device.scans_made
    for k, line in enumerate(lidar.lines):
        assert line.line_index == k
        np.testing.assert_allclose(
            np.hypot(line.x_mm, line.z_mm),
            -(200 + k * 0.1) * np.hypot(1, line.x_mm / line.z_mm) * np.sign(line.z_mm),
            atol=0.6,
        )
        np.testing.assert_allclose(line.z_mm, -(200 + 0.1 * k), atol=0.6)  # ahead is -z, rounded to 1 mm
        assert (np.diff(line.x_mm) > 0).all()
        assert np.isnan(line.position_mm)
    np.testing.assert_allclose(np.diff([line.device_time_s for line in lidar.lines]), 0.1, atol=1.1e-3)


def test_device_time_goes_on_over_the_wrap_of_the_clock() -> None:
    lidar = bench(ScipDevice(flat_scene(), clock_ms=(1 << 24) - 5000)).meet()
    lidar.start()
    lidar.scan(80)
    times = np.array([line.device_time_s for line in lidar.lines])
    assert times[0] < (1 << 24) / 1000 < times[-1]
    np.testing.assert_allclose(np.diff(times), 0.1, atol=1.1e-3)
    assert lidar.told_of(ClockJumped) == []
    assert lidar.host.tally().lines.lost == {}


def test_codes_are_reasons_and_never_distances() -> None:
    lidar = bench(field_of_view_rad=None, command="MD").meet()
    lidar.start()
    lidar.scan(2)
    line = lidar.lines[0]
    angle = np.arctan2(line.x_mm, -line.z_mm)
    assert np.isnan(line.x_mm).sum() == np.isnan(line.z_mm).sum() > 100
    assert np.nanmax(np.abs(angle)) < 1.4
    assert not line.missing.any()
    assert lidar.host.tally().no_return == {"code 0": sum(int(np.isnan(line.x_mm).sum()) for line in lidar.lines)}


def test_a_cluster_reports_the_nearest_of_its_steps() -> None:
    single, merged = bench(cluster=1).meet(), bench(cluster=5).meet()
    for lidar in (single, merged):
        lidar.start()
        lidar.scan(1)
    ranges = np.rint(np.hypot(single.lines[0].x_mm, single.lines[0].z_mm))
    nearest = [ranges[at : at + 5].min() for at in range(0, len(ranges), 5)]
    np.testing.assert_allclose(np.hypot(merged.lines[0].x_mm, merged.lines[0].z_mm), nearest, atol=1e-9)


def test_what_the_line_has_no_time_for_is_refused_or_left_out_on_purpose_and_said() -> None:
    steps = 682
    assert scan_bytes("MD", steps) / 11_520 > 0.1 > scan_bytes("MS", 500) / 11_520
    with pytest.raises(ScannerRefused, match=r"takes 0\.18\d s on the line and comes every 0\.1 s; use a higher rate"):
        bench(field_of_view_rad=None, command="MD", interval=0).meet().start()
    lidar = bench(field_of_view_rad=None, command="MD").meet()
    lidar.start()
    lidar.scan(20)
    assert len(lidar.told_of(Advice)) == 1
    assert "1 of 2 scans are left out" in lidar.told[0].text
    assert lidar.host.tally().lines.lost == {}


def test_a_stale_stream_is_ended_before_anything_is_counted() -> None:
    lidar = bench().meet()
    lidar.start()
    lidar.scan(5)
    heir = bench(lidar.device)  # an earlier program that died without stopping
    heir.now_s = lidar.now_s
    heir.meet()
    assert not lidar.device.laser_on
    assert heir.host.tally().lines.sent == 0
    heir.start()
    heir.scan(3)
    assert heir.host.tally().damage == {}


def test_a_sensor_left_in_time_mode_or_in_scip_1_is_fetched_out_of_it() -> None:
    device = ScipDevice(flat_scene())
    device.receive(b"TM0\n", 0.0)
    assert bench(device).meet().host.phase is Phase.UP
    assert bench(ScipDevice(flat_scene(), quirks=Quirks(starts_in_scip1=True))).meet().host.phase is Phase.UP


def test_a_wrong_sum_in_the_version_is_told_and_forgiven() -> None:
    lidar = bench(ScipDevice(flat_scene(), quirks=Quirks(bad_version_sum=True))).meet()
    assert lidar.host.info.device_id == "H0000001"
    assert "wrong sum" in lidar.told_of(Advice)[0].text


def test_a_sensor_that_will_not_change_its_rate_is_read_at_the_old_one() -> None:
    lidar = bench(ScipDevice(flat_scene(), quirks=Quirks(refuses_rates=True)), interval=9, cluster=3).meet()
    assert lidar.host.baud_rate == 19_200
    assert "stays at 19200 baud" in lidar.told_of(Advice)[0].text
    lidar.start()
    lidar.scan(2)


def test_nobody_and_somebody_else_are_told_apart() -> None:
    class Mute(ScipDevice):
        def receive(self, data: bytes, now_s: float) -> None:
            pass

    mute = bench(Mute(flat_scene()))
    mute.plug()
    mute.run(30.0, lambda: mute.host.phase is Phase.UNMET)
    assert isinstance(mute.host.failure, ScannerSilent)
    assert "no Hokuyo lidar answers" in str(mute.host.failure)

    class Chatty(Mute):
        def transmit(self, now_s: float, room_bytes: int) -> bytes:
            return b"$GPGGA,1,2,3\r\n"[:room_bytes]

    chatty = bench(Chatty(flat_scene()))
    chatty.plug()
    chatty.run(60.0, lambda: chatty.host.phase is Phase.UNMET)
    assert "is not SCIP 2.0" in str(chatty.host.failure)


def test_a_cut_cable_is_healed_and_the_gap_is_in_the_account() -> None:
    lidar = bench().meet()
    lidar.start()
    lidar.scan(10)
    lidar.unplug()
    assert lidar.host.laser_on is None
    lidar.run(3.0)
    lidar.plug()
    lidar.scan(10)
    assert [type(event) for event in lidar.told] == [Disconnected, Reconnected]
    assert lidar.told[1].streaming
    tally = lidar.host.tally()
    assert tally.lines.balances
    assert 25 <= tally.lines.lost["disconnected"] <= 45
    assert [line.line_index for line in lidar.lines][-1] == tally.lines.sent - 1


def test_a_pass_that_is_not_to_go_on_by_itself_stays_off() -> None:
    lidar = bench().meet()
    lidar.start(resume=False)
    lidar.scan(3)
    lidar.unplug()
    lidar.plug()
    lidar.run(3.0)
    assert not lidar.device.laser_on
    assert PassEnded(1, "disconnected") in lidar.told
    assert lidar.told_of(Reconnected) == [Reconnected(lidar.told_of(Reconnected)[0].gap_s, streaming=False)]


def test_a_sensor_that_lost_its_power_is_found_again_at_its_first_rate() -> None:
    lidar = bench(ScipDevice(flat_scene(), clock_ms=1_000_000)).meet()
    lidar.start()
    lidar.scan(5)
    lidar.device.power_cycle()
    lidar.scan(5)
    assert lidar.host.baud_rate == 115_200
    assert [type(event) for event in lidar.told] == [Disconnected, Reconnected, ClockJumped]
    times = [line.device_time_s for line in lidar.lines]
    assert times == sorted(times)
    assert lidar.host.tally().lines.balances


def test_another_lidar_on_the_same_path_is_left_alone() -> None:
    lidar = bench().meet()
    lidar.unplug()
    lidar.device = ScipDevice(flat_scene(), serial="OTHER")
    lidar.plug()
    lidar.run(2.0, lambda: bool(lidar.told_of(OtherDevice)))
    assert lidar.told_of(OtherDevice) == [OtherDevice("H0000001", "OTHER")]
    with pytest.raises(ScannerNotConnected):
        lidar.start()


def test_a_hardware_fault_ends_the_pass_and_a_passing_one_does_not() -> None:
    for malfunction, ends in ((3, False), (4, False), (5, True)):
        lidar = bench().meet()
        lidar.device.receive(b"DB%02d\n" % malfunction, lidar.now_s)
        lidar.start()
        lidar.scan(20)
        lidar.run(1.0)
        assert (PassEnded(1, "fault") in lidar.told) == ends
        assert lidar.device.laser_on != ends
        assert lidar.host.tally().lines.balances
        if malfunction == 4:
            assert lidar.host.tally().damage == {"bad_sum": 1}
            assert lidar.host.tally().lines.lost == {"damaged": 1}


def test_noise_costs_blocks_and_scans_that_are_all_in_the_account() -> None:
    rng = np.random.default_rng(3)
    lidar = bench(work_rate=750_000).meet()
    lidar.start()

    def flip(data: bytes) -> bytes:
        bits = np.unpackbits(np.frombuffer(data, dtype=np.uint8))
        return np.packbits(bits ^ (rng.random(len(bits)) < 2e-5).astype(np.uint8)).tobytes()

    lidar.corrupt = flip
    lidar.scan(300)
    lidar.corrupt = lambda data: data
    lidar.scan(1)
    tally = lidar.host.tally()
    assert tally.lines.balances
    assert tally.chunks.balances
    assert tally.lines.sent == lidar.device.scans_made
    assert tally.lines.partial == sum(not line.is_whole for line in lidar.lines) > 0
    for line in lidar.lines:
        np.testing.assert_allclose(line.z_mm[~line.missing], -200 - 0.1 * line.line_index, atol=0.6)


def test_a_full_queue_loses_profiles_and_says_so() -> None:
    lidar = bench().meet()
    lidar.start()
    lidar.scan(3)
    lidar.keeps = False
    lidar.run(2.0)
    tally = lidar.host.tally()
    assert tally.lines.lost["host_overflow"] == tally.lines.sent - 3 >= 19
    assert tally.lines.balances


def test_a_lost_stop_is_said_again_and_one_that_never_arrives_is_a_timeout() -> None:
    lidar = bench().meet()
    lidar.start()
    chances = iter([True, True, False])
    lidar.lose_to_device = lambda: next(chances, False)
    lidar.stop()
    assert not lidar.device.laser_on
    lidar.start()
    lidar.lose_to_device = lambda: True
    with pytest.raises(ScannerTimeout, match="laser may be on"):
        lidar.stop()


def test_another_model_with_other_steps_is_read_as_it_says() -> None:
    lidar = bench(ScipDevice(flat_scene(), UTM_30LX, baud_rate=115_200), work_rate=750_000).meet()
    lidar.start()
    lidar.scan(10)
    line = lidar.lines[0]
    assert len(line.x_mm) == lidar.host.info.points_per_line
    np.testing.assert_allclose(np.arctan2(line.x_mm, -line.z_mm)[[0, -1]], AHEAD, atol=2 * np.pi / 1440)
    assert URG_04LX.steps_per_turn != UTM_30LX.steps_per_turn


@pytest.mark.parametrize(
    "options", [{"command": "GD"}, {"cluster": 0}, {"interval": 10}, {"field_of_view_rad": (1, 1)}, {"work_rate": 5}]
)
def test_options_that_cannot_be_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"must be|asked with|has the rates"):
        ScipOptions(**options)
