"""An LMS2xx and its driver's half in simulated time: rates, modes, indices, left-out scans, noise, silence."""

from functools import partial

import numpy as np
import pytest

from drivers.errors import ScannerRefused, ScannerSilent, ScannerTimeout
from drivers.protocols.conversation import Phase
from drivers.protocols.lms_host import LmsHost, LmsOptions
from drivers.protocols.scanner_events import Advice, Disconnected, PassEnded, Reconnected
from simulators.devices.lms import LmsDevice
from tests.unit.drivers.conversation_bench import ConversationBench, flat_scene


def device(**options: object) -> LmsDevice:
    return LmsDevice(flat_scene(), rng=np.random.default_rng(6), **options)


def bench(scanner: LmsDevice | None = None, **options: object) -> ConversationBench:
    return ConversationBench(partial(LmsHost, options=LmsOptions(**options)), scanner or device())


def test_a_scanner_is_found_taken_to_its_rate_and_asked_what_it_is() -> None:
    scanner = bench().meet()
    info = scanner.host.info
    assert (info.model, info.firmware, info.points_per_line) == ("LMS200", "V00.01", 361)
    assert scanner.host.baud_rate == scanner.device.baud_rate == 38_400
    assert scanner.host.laser_on is True  # it measures for as long as it has power
    assert scanner.told == []


@pytest.mark.parametrize("rate", [38_400, 500_000])
def test_any_rate_that_was_left_set_is_found_by_trying(rate: int) -> None:
    left = device()
    left.baud_rate = rate
    assert bench(left).meet().host.baud_rate == rate


@pytest.mark.parametrize(
    ("variant", "points"), [((180, 100), 181), ((180, 50), 361), ((100, 25), 401), ((100, 100), 101)]
)
def test_values_become_profiles_in_the_sensor_frame(variant: tuple[int, int], points: int) -> None:
    scanner = bench(work_rate=500_000, variant=variant).meet()
    scanner.start()
    scanner.scan(20)
    scanner.stop()
    assert scanner.told == [PassEnded(1, "stopped")]
    tally = scanner.host.tally()
    assert tally.lines.sent == tally.lines.whole == len(scanner.lines)
    assert tally.lines.lost == {}
    times = np.diff([line.device_time_s for line in scanner.lines])
    np.testing.assert_allclose(times, 0.01332 * {100: 1, 50: 2, 25: 4}[variant[1]], rtol=1e-6)
    for line in scanner.lines:
        assert len(line.x_mm) == points
        seen = ~np.isnan(line.z_mm)
        np.testing.assert_allclose(
            line.z_mm[seen], -200 - (line.device_time_s - scanner.lines[0].device_time_s), atol=0.6
        )
        assert (np.diff(line.x_mm[seen]) > 0).all()
        assert abs(line.x_mm[points // 2]) < 1e-9
    assert set(tally.no_return) == ({"nothing_came_back"} if variant[0] == 180 else set())


def test_scans_that_the_scanner_leaves_out_itself_are_counted_as_its_own() -> None:
    scanner = bench().meet()
    scanner.start()
    assert "leaves out 7 of 8; use RS-422" in scanner.told_of(Advice)[0].text
    scanner.scan(40)
    tally = scanner.host.tally()
    assert tally.lines.balances
    assert scanner.device.scans_made - 8 <= tally.lines.sent <= scanner.device.scans_made
    assert tally.lines.lost == {"device_dropped": tally.lines.sent - 40}
    assert tally.lines.sent > 250


def test_a_scanner_without_indices_is_read_by_arrival_and_its_losses_stay_unknown() -> None:
    scanner = bench(device(appends_indices=False)).meet()
    scanner.start()
    scanner.scan(5)
    assert all(line.device_time_s == line.arrival_s for line in scanner.lines)
    assert scanner.host.tally().lines.lost == {}


def test_a_field_of_view_is_all_that_is_handed_on() -> None:
    scanner = bench(field_of_view_rad=(-0.3, 0.3)).meet()
    scanner.start()
    scanner.scan(2)
    line = scanner.lines[0]
    assert not np.isnan(line.x_mm).any()
    assert np.abs(np.arctan2(line.x_mm, -line.z_mm)).max() <= 0.3 + 1e-9


def test_a_stale_stream_is_ended_before_anything_is_counted() -> None:
    scanner = bench().meet()
    scanner.start()
    scanner.scan(3)
    heir = bench(scanner.device)
    heir.now_s = scanner.now_s
    heir.meet()
    assert heir.host.tally().damage == {}
    heir.start()
    heir.scan(2)
    assert heir.host.tally().lines.stored == 2


def test_missed_requests_and_damaged_replies_are_asked_again() -> None:
    for seed in range(5):
        scanner = bench(LmsDevice(flat_scene(), rng=np.random.default_rng(seed), miss_rate=0.25))
        scanner.plug()
        scanner.run(60.0, lambda host=scanner.host: host.phase is not Phase.MEETING)
        if scanner.host.phase is Phase.UP:
            scanner.start()
            scanner.scan(1)
            break
    else:
        raise AssertionError("a quarter of the requests missed kept the scanner from being met in all tries")


def test_a_variant_that_the_model_refuses_is_told() -> None:
    scanner = bench(device(can_change_variant=False), variant=(100, 25))
    scanner.plug()
    scanner.run(20.0, lambda: scanner.host.phase is Phase.UNMET)
    assert isinstance(scanner.host.failure, ScannerRefused)
    assert "-S14" in str(scanner.host.failure)


def test_noise_costs_scans_that_are_all_in_the_account() -> None:
    rng = np.random.default_rng(3)
    scanner = bench(work_rate=500_000).meet()
    scanner.start()

    def flip(data: bytes) -> bytes:
        bits = np.unpackbits(np.frombuffer(data, dtype=np.uint8))
        return np.packbits(bits ^ (rng.random(len(bits)) < 2e-5).astype(np.uint8)).tobytes()

    scanner.corrupt = flip
    scanner.scan(200)
    scanner.corrupt = lambda data: data
    scanner.scan(1)
    tally = scanner.host.tally()
    assert tally.lines.balances
    assert tally.lines.sent == scanner.device.scans_sent
    assert set(tally.lines.lost) == {"damaged"}
    assert tally.damage["bad_crc"] > 5
    for line in scanner.lines:
        seen = ~np.isnan(line.z_mm)
        elapsed_s = line.device_time_s - scanner.lines[0].device_time_s
        np.testing.assert_allclose(line.z_mm[seen], -200 - elapsed_s, atol=0.6)


def test_a_cut_cable_is_healed_and_the_gap_is_in_the_account() -> None:
    scanner = bench().meet()
    scanner.start()
    scanner.scan(5)
    scanner.unplug()
    scanner.run(4.0)
    scanner.plug()
    scanner.scan(5)
    assert [type(event) for event in scanner.told if not isinstance(event, Advice)] == [Disconnected, Reconnected]
    tally = scanner.host.tally()
    assert tally.lines.balances
    assert 15 < tally.lines.lost["disconnected"] < 40
    assert tally.lines.lost["device_dropped"] > 100
    times = [line.device_time_s for line in scanner.lines]
    assert times == sorted(times)


def test_a_dirty_window_and_a_fault_are_told_once() -> None:
    scanner = bench().meet()
    scanner.start()
    scanner.scan(1)
    scanner.device.status = 0x10 | 0x80 | 3
    scanner.scan(3)
    texts = [event.text for event in scanner.told_of(Advice)]
    assert sum("window is dirty" in text for text in texts) == 1
    assert sum("severity 3 of 4" in text for text in texts) == 1


def test_nobody_answers_is_told_and_so_is_a_stop_that_gets_no_answer() -> None:
    class Mute(LmsDevice):
        def receive(self, data: bytes, now_s: float) -> None:
            pass

    mute = bench(Mute(flat_scene(), rng=np.random.default_rng(1)))
    mute.plug()
    mute.run(20.0, lambda: mute.host.phase is Phase.UNMET)
    assert isinstance(mute.host.failure, ScannerSilent)
    scanner = bench().meet()
    scanner.start()
    scanner.lose_to_device = lambda: True
    with pytest.raises(ScannerTimeout, match="may still be sending"):
        scanner.stop()


@pytest.mark.parametrize("options", [{"variant": (180, 25)}, {"work_rate": 115_200}, {"field_of_view_rad": (1, 0)}])
def test_options_that_cannot_be_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"cannot measure|has the rates|must be"):
        LmsOptions(**options)


@pytest.mark.parametrize(("variant", "turns"), [((180, 100), 1), ((180, 50), 2), ((100, 25), 4)])
def test_partial_scans_are_profiles_of_one_turn_that_together_see_what_a_whole_scan_sees(
    variant: tuple[int, int], turns: int
) -> None:
    scanner = bench(work_rate=500_000, variant=variant, partial_scans=True).meet()
    assert scanner.host.info.points_per_line == variant[0] + 1
    scanner.start()
    scanner.scan(5 * turns)
    scanner.stop()
    assert scanner.told == [PassEnded(1, "stopped")]
    tally = scanner.host.tally()
    assert tally.lines.sent == tally.lines.whole == len(scanner.lines)
    np.testing.assert_allclose(np.diff([line.device_time_s for line in scanner.lines]), 0.01332, rtol=1e-6)
    angles = []
    for line in scanner.lines[:turns]:
        seen = ~np.isnan(line.z_mm)
        np.testing.assert_allclose(line.z_mm[seen], -200 - 0.1, atol=0.8)
        angles.append(np.degrees(np.arctan2(line.x_mm[seen], -line.z_mm[seen])))
        np.testing.assert_allclose(np.diff(angles[-1]), 1.0, atol=1e-6)
    together = np.sort(np.concatenate(angles))
    np.testing.assert_allclose(np.diff(together), variant[1] / 100, atol=1e-6)


def test_partial_scans_that_the_line_has_no_time_for_are_the_scanners_own_loss() -> None:
    scanner = bench(work_rate=38_400, variant=(180, 50), partial_scans=True).meet()
    scanner.start()
    scanner.scan(20)
    lines = scanner.host.tally().lines
    assert set(lines.lost) == {"device_dropped"}
    assert lines.sent == lines.stored + lines.lost["device_dropped"]
