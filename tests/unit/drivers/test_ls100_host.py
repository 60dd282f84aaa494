"""A Profiler 2 or LS-100 and its driver's half in simulated time: rates, echo, both readings, damage, errors."""

from functools import partial

import numpy as np
import pytest

from drivers.errors import ScannerRefused, ScannerSilent
from drivers.protocols.conversation import Phase
from drivers.protocols.ls100_host import Ls100Host, Ls100Options
from drivers.protocols.scanner_events import Advice, Disconnected, PassEnded, Reconnected
from simulators.devices.echoing import EchoingAdapter
from simulators.devices.ls100 import Ls100Device
from tests.unit.drivers.conversation_bench import ConversationBench

N_POINTS = 832


def scene(elapsed_s: float) -> tuple[np.ndarray, np.ndarray]:
    x_mm = np.linspace(-15, 15, N_POINTS)
    return x_mm, np.where(np.abs(x_mm) < 14, np.sin(x_mm) + elapsed_s, np.nan)


def bench(device: object = None, **options: object) -> ConversationBench:
    sensor = device or Ls100Device(scene, baud_rate=921_600)
    return ConversationBench(partial(Ls100Host, options=Ls100Options(**options)), sensor)


@pytest.mark.parametrize("rate", [9_600, 115_200, 921_600, 4_000_000])
def test_a_sensor_is_found_at_the_rate_that_was_set_at_it(rate: int) -> None:
    sensor = bench(Ls100Device(scene, baud_rate=rate)).meet()
    assert sensor.host.baud_rate == rate
    assert sensor.host.info.points_per_line == N_POINTS
    assert sensor.host.laser_on is True


@pytest.mark.parametrize("echo", [False, True])
@pytest.mark.parametrize("step", [1, 3])
def test_profiles_are_read_whole_and_exactly_with_an_echo_or_without(echo: bool, step: int) -> None:
    device = Ls100Device(scene, baud_rate=921_600)
    sensor = bench(EchoingAdapter(device) if echo else device, step=step).meet()
    sensor.start()
    sensor.scan(10)
    sensor.stop()
    texts = [event.text for event in sensor.told_of(Advice)]
    assert sum("echo is passed over" in text for text in texts) == echo
    assert sum("move the stage no faster" in text for text in texts) == 1
    assert sensor.told[-1] == PassEnded(1, "stopped")
    x_mm, shape_mm = scene(0.0)
    for line in sensor.lines:
        seen = ~np.isnan(line.x_mm)
        assert len(seen) == len(x_mm[::step])
        np.testing.assert_array_equal(seen, ~np.isnan(shape_mm[::step]))
        np.testing.assert_allclose(line.x_mm[seen], x_mm[::step][seen], atol=5.1e-4)
        rise_mm = line.z_mm[seen] - shape_mm[::step][seen]
        assert np.ptp(rise_mm) < 1.1e-3  # all of it is of one instant
    tally = sensor.host.tally()
    assert tally.lines.sent == tally.lines.whole == len(sensor.lines)
    assert tally.no_return == {"no_measurement": sum(int(np.isnan(line.x_mm).sum()) for line in sensor.lines)}


def test_the_sensors_own_time_is_unwrapped_where_it_tells_one() -> None:
    sensor = bench(Ls100Device(scene, baud_rate=921_600, sends_time=True), has_time=True).meet()
    sensor.start()
    sensor.scan(200)  # more than the 6.6 s after which sixteen bits of tenths of a millisecond begin anew
    times = np.array([line.device_time_s for line in sensor.lines])
    assert times[-1] - times[0] > 6.6
    # the profile rises by 1 mm a second, so its own height says when it was made
    heights = np.array([line.z_mm[N_POINTS // 2] for line in sensor.lines])
    np.testing.assert_allclose(np.diff(times), np.diff(heights), atol=2.1e-3)


@pytest.mark.parametrize(("sends", "expects"), [(True, False), (False, True)])
def test_the_other_reading_is_refused_with_what_to_try(sends: bool, expects: bool) -> None:
    sensor = bench(Ls100Device(scene, baud_rate=921_600, sends_time=sends), has_time=expects)
    sensor.plug()
    sensor.run(20.0, lambda: sensor.host.phase is Phase.UNMET)
    assert isinstance(sensor.host.failure, ScannerRefused)
    assert "try the other has_time" in str(sensor.host.failure)


def test_noise_is_asked_again_and_what_stays_damaged_is_missing() -> None:
    rng = np.random.default_rng(8)
    sensor = bench().meet()
    sensor.start()

    def flip(data: bytes) -> bytes:
        bits = np.unpackbits(np.frombuffer(data, dtype=np.uint8))
        return np.packbits(bits ^ (rng.random(len(bits)) < 3e-4).astype(np.uint8)).tobytes()

    sensor.corrupt = flip
    sensor.scan(30)
    sensor.corrupt = lambda data: data
    sensor.scan(1)
    tally = sensor.host.tally()
    assert tally.lines.balances
    assert tally.bytes_skipped > 1000
    assert tally.lines.partial == sum(not line.is_whole for line in sensor.lines) > 0
    assert sum(line.missing.sum() for line in sensor.lines) < 0.5 * N_POINTS * len(sensor.lines)


def test_a_cut_cable_is_healed_and_a_sensor_without_power_is_waited_for() -> None:
    sensor = bench().meet()
    sensor.start()
    sensor.scan(3)
    sensor.unplug()
    sensor.run(1.0)
    sensor.plug()
    sensor.scan(3)
    assert [type(event) for event in sensor.told if not isinstance(event, Advice)] == [Disconnected, Reconnected]
    answer = sensor.device.transmit
    sensor.device.transmit = lambda now_s, room_bytes: b""
    sensor.run(12.0)
    assert sum(isinstance(event, Disconnected) for event in sensor.told) == 2
    sensor.device._out.clear()
    sensor.device.transmit = answer
    sensor.scan(3)
    tally = sensor.host.tally()
    assert tally.lines.balances
    assert sum(tally.lines.lost.values()) >= 1


@pytest.mark.parametrize(("lost", "back_s"), [(2, 1.0), (4, 1.0), (6, 4.0)])
def test_a_sensor_that_misses_the_first_requests_after_a_replug_is_soon_back(lost: int, back_s: float) -> None:
    sensor = bench().meet()
    sensor.start()
    sensor.scan(3)
    sensor.unplug()
    sensor.run(0.2)
    said = []
    sensor.lose_to_device = lambda: said.append(sensor.host.baud_rate) or len(said) <= lost
    sensor.plug()
    replugged_s = sensor.now_s
    sensor.scan(1)
    assert sensor.now_s - replugged_s < back_s  # all the other rates once would take seven seconds


def test_nobody_an_echo_and_a_sensor_that_refuses_are_told_apart() -> None:
    class Mute(Ls100Device):
        def _obey(self, command: int, data: bytes, now_s: float) -> None:
            pass

    class Strange(Ls100Device):
        def _obey(self, command: int, data: bytes, now_s: float) -> None:
            self._reply(0xE001, b"", now_s)

    expected = {
        Mute(scene): (ScannerSilent, "swap A with B"),
        EchoingAdapter(Mute(scene)): (ScannerSilent, "nobody answers"),
        Strange(scene): (ScannerRefused, "it does not know the command"),
    }
    for device, (kind, text) in expected.items():
        sensor = bench(device)
        sensor.plug()
        sensor.run(60.0, lambda host=sensor.host: host.phase is Phase.UNMET)
        assert isinstance(sensor.host.failure, kind)
        assert text in str(sensor.host.failure)


def test_options_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="step must be 1 to 15"):
        Ls100Options(step=16)


@pytest.mark.parametrize("late_s", [0.15, 0.25, 0.35])
@pytest.mark.parametrize("has_echo", [False, True])
def test_a_reply_that_comes_after_it_was_asked_again_is_taken_for_no_other(late_s: float, has_echo: bool) -> None:
    device = Ls100Device(scene, baud_rate=921_600)
    sensor = bench(EchoingAdapter(device) if has_echo else device).meet()
    sensor.start()
    sensor.scan(2)
    held, until_s = bytearray(), sensor.now_s

    def arrives(data: bytes) -> bytes:
        held.extend(data)
        if sensor.now_s < until_s:
            return b""
        arrived = bytes(held)
        held.clear()
        return arrived

    sensor.corrupt = arrives
    for _ in range(4):
        sensor.run(0.03)
        until_s = sensor.now_s + late_s
        sensor.scan(2)
    sensor.stop()
    tally = sensor.host.tally()
    assert tally.lines.lost == {}
    assert tally.lines.whole == len(sensor.lines) == tally.lines.sent
    for line in sensor.lines:
        assert len(line.x_mm) == N_POINTS
        assert (np.diff(line.x_mm[np.isfinite(line.x_mm)]) > 0).all()
