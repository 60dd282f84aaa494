"""Time in which a program was not let run is nobody's silence: waits, errands, scripts and streams outlast it."""

import signal
import subprocess
import sys
import time
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.protocols.listening import LISTENED_S, listened_s
from drivers.protocols.scanner_events import Disconnected, PassEnded
from drivers.protocols.scip_host import ScipHost
from drivers.protocols.scip_plan import ScipOptions
from drivers.protocols.stage_events import PositionLost
from drivers.protocols.stage_host import Phase
from simulators.devices.scip import ScipDevice
from tests.unit.drivers.conversation_bench import ConversationBench, flat_scene
from tests.unit.drivers.stage_bench import KINDS, StageBench

PAUSE_S = 200.0
LATE_ANSWER = """
import threading, time
from drivers.patience import wait_patiently
changed, here = threading.Condition(), []
def answer():
    for _ in range(10):  # a reader that needs a few turns
        time.sleep(0.05)
    with changed:
        here.append(1)
        changed.notify_all()
with changed:
    print("waiting", flush=True)
    threading.Thread(target=answer, daemon=True).start()
    print(wait_patiently(changed, lambda: here, 2.0), flush=True)
    print(wait_patiently(changed, lambda: False, 0.3), flush=True)
"""


def test_a_wait_outlasts_a_pause_of_the_whole_process_and_still_ends() -> None:
    with subprocess.Popen([sys.executable, "-c", LATE_ANSWER], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "waiting\n"
        process.send_signal(signal.SIGSTOP)
        time.sleep(2.5)  # longer than it is willing to wait
        process.send_signal(signal.SIGCONT)
        assert process.stdout.read() == "True\nFalse\n"


@given(st.lists(st.floats(-1.0, 100.0), max_size=50))
def test_listened_time_is_never_more_than_passed_and_bounded_for_each_look(steps_s: list[float]) -> None:
    now_s = total_s = 0.0
    for step_s in steps_s:
        counts_s = listened_s(now_s, now_s + step_s)
        assert 0.0 <= counts_s <= max(0.0, step_s) + 1e-9
        now_s += step_s
        total_s += counts_s
    assert total_s <= LISTENED_S * len(steps_s)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("errand", ["home", "move"])
def test_an_errand_goes_on_after_a_pause_of_the_host(kind: str, errand: str) -> None:
    bench = StageBench(kind).homed()
    target = -30.0 if kind == "grbl" else 30.0
    under_way = bench.host.home(bench.now_s) if errand == "home" else bench.host.move(target, 20.0, bench.now_s)
    bench.run(0.2)
    bench.now_s += PAUSE_S  # nobody looked at the clock meanwhile; the axis has long arrived
    bench.ask(under_way)
    assert under_way.failure is None
    assert bench.host.position_known
    if errand == "move":
        assert bench.where == pytest.approx(target, abs=0.01)


def lidar_bench() -> ConversationBench:
    options = ScipOptions(field_of_view_rad=(-0.8, 0.8), command="MS")
    return ConversationBench(partial(ScipHost, options=options), ScipDevice(flat_scene()))


def test_a_stream_goes_on_after_a_pause_and_what_the_scanner_left_out_is_told_from_what_the_line_lost() -> None:
    lidar = lidar_bench().meet()
    lidar.start()
    lidar.scan(5)
    lidar.now_s += PAUSE_S  # the wire stood still, the lidar went on turning
    lidar.scan(5)
    lines = lidar.host.tally().lines
    left_out = lidar.device.scans_made - lidar.device.scans_sent
    assert left_out > PAUSE_S / 0.1 - 3
    assert lines.lost == {"device_dropped": left_out}
    assert lidar.told_of(Disconnected) == lidar.told_of(PassEnded) == []

    lidar.corrupt = lambda data: bytes(byte ^ 0x10 for byte in data)
    lidar.run(0.5)
    lidar.corrupt = lambda data: data
    lidar.scan(5)
    lines = lidar.host.tally().lines
    assert lines.lost.pop("device_dropped") == left_out
    assert set(lines.lost) == {"damaged"}


def test_a_question_is_waited_for_as_long_as_it_could_be_heard() -> None:
    lidar = lidar_bench().meet()
    task = lidar.host.start(lidar.now_s, resume=True)
    lidar.now_s += PAUSE_S
    lidar.ask(task)
    lidar.scan(2)
    assert lidar.told == []


@pytest.mark.parametrize("looks", [1, 2, 3, 5, 10, 30])
@pytest.mark.parametrize("kind", KINDS)
def test_a_stage_that_is_met_again_while_the_program_is_held_up_keeps_its_position(kind: str, looks: int) -> None:
    bench = StageBench(kind).homed()
    bench.unplug()
    bench.run(0.3)
    bench.plug()
    bench.run(looks * 0.01)
    bench.now_s += PAUSE_S
    bench.host.tick(bench.now_s)  # it had read before the pause; what came meanwhile is read next
    bench.until(lambda: bench.host.phase is Phase.UP, 30.0)
    assert bench.host.position_known
    assert not [event for event in bench.told if isinstance(event, PositionLost)]
