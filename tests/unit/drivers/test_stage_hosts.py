"""Conversations with stage controllers in simulated time: trust, arrival, stops that overtake, lost words, restarts."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.errors import StageAlarm, StageError, StageNotConnected, StageRefused, StageStopped
from drivers.protocols.grbl_host import GrblHost
from drivers.protocols.marlin_host import MarlinHost
from drivers.protocols.stage_events import PositionLost, StageReconnected
from drivers.protocols.stage_host import Phase
from simulators.devices.grbl import GrblDevice
from simulators.devices.marlin import MarlinDevice
from simulators.devices.zaber import ZaberDevice
from tests.unit.drivers.stage_bench import KINDS, StageBench

every_kind = pytest.mark.parametrize("kind", KINDS)


@every_kind
def test_a_stage_is_greeted_homes_and_goes_where_it_is_sent(kind: str) -> None:
    bench = StageBench(kind).greet()
    assert not bench.host.position_known
    assert bench.host.identity
    bench.homed()
    for mm in (20.0, 5.0, 5.0, 80.125):
        errand = bench.ask(bench.host.move(bench.target(mm), 25.0, bench.now_s))
        assert errand.is_done, errand.failure
        assert bench.where == pytest.approx(bench.target(mm), abs=0.01)
        assert bench.host.last is not None
        assert bench.host.last.position == pytest.approx(bench.where, abs=0.013)


@every_kind
def test_readings_hold_the_truth_at_a_moment_between_asking_and_hearing(kind: str) -> None:
    bench = StageBench(kind).homed()
    bench.readings.clear()
    places: list[tuple[float, float]] = []
    errand = bench.host.move(bench.target(30.0), 10.0, bench.now_s)
    while not errand.is_over:
        bench.run(0.01)
        places.append((bench.now_s, bench.where))
    times, truth = np.array(places).T
    moving = [reading for reading in bench.readings if reading.is_moving]
    assert len(moving) > 5
    for reading in moving:
        span = truth[(times >= reading.asked_s - 0.011) & (times <= reading.arrived_s + 0.011)]
        assert span.min() - 0.013 <= reading.position <= span.max() + 0.013


@every_kind
def test_a_stop_goes_out_before_everything_that_waits_and_the_stage_rests(kind: str) -> None:
    bench = StageBench(kind).homed()
    moving = bench.host.move(bench.target(100.0), 20.0, bench.now_s)
    bench.until(bench.is_moving)
    bench.run(1.0)
    for number in range(20):
        bench.queue(f"queued {number}")
    bench.sent.clear()
    stop = bench.host.stop(bench.now_s)
    assert isinstance(moving.failure, StageStopped)
    bench.run(0.02)
    assert b"queued" not in bench.sent
    assert bytes(bench.sent).startswith({"grbl": b"\x85", "marlin": b"M410\n", "zaber": b"/1 1"}[kind])
    bench.ask(stop)
    assert stop.is_done
    assert not bench.is_moving()
    assert 10.0 < abs(bench.where) < 35.0
    # GRBL and Zaber brake with the position kept; Marlin stops at once, and may lose steps.
    assert bench.host.position_known is (kind != "marlin")


@every_kind
def test_a_stop_overtakes_the_motion_that_was_ordered_just_before(kind: str) -> None:
    bench = StageBench(kind).homed()
    bench.host.move(bench.target(100.0), 20.0, bench.now_s)
    stop = bench.ask(bench.host.stop(bench.now_s))
    assert stop.is_done
    assert bench.sent.count(b"100") == 0
    bench.run(2.0)
    assert not bench.is_moving()
    assert abs(bench.where) < 1.5


def test_a_jog_whose_beginning_has_left_is_stopped_when_it_starts() -> None:
    bench = StageBench("grbl").homed()
    bench.host.move(-100.0, 20.0, bench.now_s)
    half = bench.host.outbox.peek()[:10]
    bench.host.outbox.wrote(10)
    bench.device.receive(half, bench.now_s)
    stop = bench.ask(bench.host.stop(bench.now_s))
    assert stop.is_done
    bench.run(1.0)
    assert not bench.is_moving()
    assert abs(bench.where) < 5.0


@every_kind
def test_a_lost_link_fails_what_was_under_way_and_a_link_that_is_back_keeps_the_position(kind: str) -> None:
    bench = StageBench(kind).homed()
    errand = bench.host.move(bench.target(10.0), 20.0, bench.now_s)
    bench.run(0.3)
    bench.unplug()
    assert isinstance(errand.failure, StageNotConnected)
    assert isinstance(bench.host.move(0.0, 1.0, bench.now_s).failure, StageNotConnected)
    bench.run(3.0)
    bench.plug()
    bench.until(lambda: bench.host.phase is Phase.UP, 10.0)
    assert bench.told[-1] == StageReconnected(pytest.approx(3.0, abs=1.5), True)  # type: ignore[arg-type]
    assert bench.ask(bench.host.move(bench.target(12.0), 20.0, bench.now_s)).is_done
    assert bench.where == pytest.approx(bench.target(12.0), abs=0.01)


@every_kind
def test_a_controller_that_started_anew_must_home_again(kind: str) -> None:
    bench = StageBench(kind).homed()
    errand = bench.host.move(bench.target(50.0), 20.0, bench.now_s)
    bench.run(0.5)
    bench.device.reboot(bench.now_s)
    bench.until(lambda: errand.is_over)
    assert isinstance(errand.failure, StageError)
    bench.until(lambda: not bench.host.position_known)
    assert any(isinstance(event, PositionLost) for event in bench.told)
    bench.until(lambda: bench.host.phase is Phase.UP and not bench.host.is_busy, 20.0)
    assert bench.ask(bench.host.home(bench.now_s)).is_done
    assert bench.host.position_known


@every_kind
def test_a_motion_left_running_by_an_earlier_program_is_ended_before_anything_else(kind: str) -> None:
    device = {
        "grbl": GrblDevice(homed=True),
        "marlin": MarlinDevice(),
        "zaber": ZaberDevice(has_reference=True),
    }[kind]
    far = (-200.0, 0.0, 0.0) if kind == "grbl" else (200.0, 0.0, 0.0) if kind == "marlin" else (200_000.0,)
    device.axes.go(far, 10.0 if kind != "zaber" else 10_000.0, 0.0)
    bench = StageBench(kind, device)
    bench.now_s = 1.0
    bench.greet()
    assert not bench.is_moving()
    assert abs(bench.where) < 50.0
    # A Zaber axis keeps its reference by itself; nobody else can know what was done before.
    assert bench.host.position_known is (kind == "zaber")


@every_kind
def test_a_controller_that_falls_silent_is_noticed_though_not_while_it_homes(kind: str) -> None:
    bench = StageBench(kind).homed()
    bench.run(2.0)
    assert not bench.host.is_silent()
    bench.to_host = lambda data: b""
    bench.run(3.5)
    assert bench.host.is_silent()


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(KINDS))
def test_on_a_noisy_line_a_motion_ends_where_it_was_sent_or_is_told_to_have_failed(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    bench = StageBench(kind).homed()

    def noisy(data: bytes) -> bytes:
        kept = bytearray(byte for byte in data if rng.random() > 0.003)
        for at in range(len(kept)):
            if rng.random() < 0.003:
                kept[at] ^= 1 << int(rng.integers(8))
        return bytes(kept)

    bench.to_host = bench.to_device = noisy
    for mm in (10.0, 30.0, 3.0):
        if bench.host.phase is not Phase.UP or not bench.host.position_known or bench.host.is_busy:
            break
        errand = bench.host.move(bench.target(mm), 20.0, bench.now_s)
        bench.until(lambda: errand.is_over, 300.0)  # noqa: B023
        if errand.is_done:
            assert bench.where == pytest.approx(bench.target(mm), abs=0.011)
        bench.until(lambda: not bench.host.is_busy, 60.0)
    bench.to_host = bench.to_device = lambda data: data
    bench.run(15.0)
    if bench.host.phase is Phase.UP:
        assert bench.ask(bench.host.stop(bench.now_s)).is_done
        assert not bench.is_moving()


def test_grbl_refusals_and_alarms_are_told_with_what_to_do() -> None:
    bench = StageBench("grbl", GrblDevice({20: 1})).homed()
    beyond = bench.ask(bench.host.move(-400.0, 20.0, bench.now_s))
    assert isinstance(beyond.failure, StageRefused)
    assert "error:15" in str(beyond.failure)
    assert bench.host.position_known
    errand = bench.host.move(-100.0, 20.0, bench.now_s)
    bench.run(0.5)
    bench.device.hit_limit(bench.now_s)
    bench.ask(errand)
    assert isinstance(errand.failure, StageAlarm)
    assert "limit switch" in str(errand.failure)
    assert not bench.host.position_known
    assert bench.ask(bench.host.home(bench.now_s)).is_done
    without = StageBench("grbl", GrblDevice({22: 0})).greet()
    refused = without.ask(without.host.home(without.now_s))
    assert "$22=1" in str(refused.failure)
    assert without.ask(without.host.unlock(without.now_s)).is_done


def test_grbl_positions_are_understood_in_inches_and_as_work_positions() -> None:
    bench = StageBench("grbl", GrblDevice({13: 1, 10: 0})).homed()
    assert bench.ask(bench.host.move(-25.4, 20.0, bench.now_s)).is_done
    assert bench.where == pytest.approx(-25.4, abs=1e-6)


def test_grbl_that_stands_elsewhere_than_it_was_sent_is_told() -> None:
    device = GrblDevice()
    bench = StageBench("grbl", device).homed()
    bench.to_device = lambda data: data.replace(b"X-25.0", b"X-5.0")  # a digit got lost, and the line is still a line
    errand = bench.ask(bench.host.move(-25.0, 20.0, bench.now_s))
    assert isinstance(errand.failure, StageRefused)
    assert "instead of -25" in str(errand.failure)


def test_homing_can_be_stopped_and_leaves_the_position_unknown() -> None:
    bench = StageBench("grbl").greet()
    homing = bench.host.home(bench.now_s)
    bench.run(0.2)
    stop = bench.ask(bench.host.stop(bench.now_s))
    assert stop.is_done
    assert isinstance(homing.failure, StageStopped)
    assert bench.device.state == "Alarm"
    assert not bench.is_moving()
    assert not bench.host.position_known


def test_marlin_without_steps_is_refused_and_with_given_steps_is_not() -> None:
    bench = StageBench("marlin", MarlinDevice(answers_m92=False))
    bench.host.link_opened(0.0)
    bench.run(5.0)
    assert bench.host.refusal is not None
    assert "steps_per_unit" in str(bench.host.refusal)
    given = StageBench("marlin", MarlinDevice(answers_m92=False))
    given.host = MarlinHost(given.readings.append, given.told.append, steps_per_unit=80.0)
    given.homed()


def test_marlin_without_an_emergency_parser_is_stopped_in_its_motion_too() -> None:
    bench = StageBench("marlin", MarlinDevice(emergency_parser=False)).homed()
    bench.host.move(100.0, 20.0, bench.now_s)
    bench.run(1.0)
    assert bench.is_moving()
    assert bench.ask(bench.host.stop(bench.now_s)).is_done
    assert bench.where < 40.0


def test_marlin_that_halted_says_so() -> None:
    bench = StageBench("marlin").homed()
    errand = bench.host.move(100.0, 20.0, bench.now_s)
    bench.run(0.5)
    bench.device.kill(bench.now_s)
    bench.ask(errand)
    assert isinstance(errand.failure, StageAlarm)
    assert not bench.host.position_known


@pytest.mark.parametrize("lost", [1, 2, 3])
@pytest.mark.parametrize("complaint", ["expected line 7 got 9", "Line Number is not Last Line Number+1, Last Line: 6"])
def test_marlin_that_asks_for_a_line_again_in_any_words_is_sent_it_and_one_that_refuses_is_told(
    complaint: str, lost: int
) -> None:
    bench = StageBench("marlin").homed()
    errand = bench.host.move(15.0, 20.0, bench.now_s)
    number = bench.host._sent.number
    bench.host.receive(f"Error:{complaint}\nResend: {number}\nok\n".encode() * lost, bench.now_s)
    assert bench.ask(errand).is_done
    refused = bench.host.move(20.0, 20.0, bench.now_s)
    bench.host.receive(b"Error:cold extrusion prevented\nok\n", bench.now_s)
    assert isinstance(refused.failure, StageRefused)


def test_marlin_that_answers_m114_on_the_line_of_its_ok_is_understood() -> None:
    bench = StageBench("marlin")
    bench.to_host = _ok_before_position
    bench.homed()
    assert bench.ask(bench.host.move(12.0, 20.0, bench.now_s)).is_done
    assert bench.where == pytest.approx(12.0, abs=0.01)


def _ok_before_position(data: bytes) -> bytes:
    """A firmware's other habit: `X:.. Count ..` and the `ok` behind it become one line."""
    return re.sub(rb"(?m)^(X:[^\n]*Count[^\n]*)\nok\n", rb"ok \1\n", data)


@pytest.mark.parametrize("lost", [1, 2, 3])
def test_marlin_goes_on_when_acknowledgements_are_lost(lost: int) -> None:
    bench = StageBench("marlin").homed()
    bench.device.swallow_oks = lost
    assert bench.ask(bench.host.move(15.0, 20.0, bench.now_s)).is_done
    assert bench.where == pytest.approx(15.0, abs=0.01)


def test_a_zaber_axis_that_stalls_is_told_and_must_home() -> None:
    bench = StageBench("zaber").homed()
    errand = bench.host.move(100.0, 20.0, bench.now_s)
    bench.run(0.5)
    bench.device.stall(bench.now_s)
    bench.ask(errand)
    assert "stalled" in str(errand.failure)
    assert not bench.host.position_known
    assert bench.ask(bench.host.home(bench.now_s)).is_done
    beyond = bench.ask(bench.host.move(400.0, 20.0, bench.now_s))
    assert "BADDATA" in str(beyond.failure)
    with pytest.raises(ValueError, match="microstep"):
        type(bench.host)(bench.readings.append, bench.told.append, 0.0)  # type: ignore[call-arg]


def test_grbl_letters_are_those_of_axes() -> None:
    with pytest.raises(ValueError, match="substring"):
        GrblHost(lambda reading: None, lambda event: None, "Q")
