"""Passes under stops and interruptions at any moment: nothing sets off after a stop, and nothing waits for ever."""

import contextlib
import itertools
import math
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drivers.errors import DriverError, StageNotConnected, StageStopped
from drivers.passes.at_rest import run_at_rest
from drivers.passes.in_motion import MotionPass
from drivers.passes.stopping import Stopping
from drivers.passes.told import RigPassEnded, Told
from drivers.passes.with_device import run_with_device
from drivers.protocols.scanner_events import Advice, ClockJumped
from drivers.rig_description import PairBy
from drivers.rig_file import parse_rig
from drivers.rig_limits import PassOrder
from drivers.running_rig import RunningRig
from drivers.scanline import Scanline
from drivers.stages.setup import StageSetup
from drivers.stages.unmoved import ConstantSpeed
from scanner_service.sessions.rig_source import Preparation, RigSource
from tests.unit.drivers.pass_bench import AT_REST, MOST_LOOKS, ORDER, BenchScanner, BenchStage, Workshop, bench

PASSES = {
    "in motion": (ORDER, lambda drive: MotionPass(drive, drive.scanner).run()),
    "at rest": (AT_REST, lambda drive: run_at_rest(drive, drive.scanner, drive.driven)),
    "with device": (ORDER, lambda drive: run_with_device(drive, drive.scanner)),
}
RIG = """
name = "bench"
[scanner]
kind = "scip"
port = "/dev/scanner"
field_of_view_mm = [-50, 50]
[stage]
kind = "grbl"
port = "/dev/stage"
travel_mm = [-100, 100]
speed_mm_per_s = [0, 20]
[mounting]
stage_from_sensor = { translation_mm = [0, 0, 0] }
[pairing]
by = "time"
"""


@pytest.mark.parametrize("kind", PASSES)
@pytest.mark.parametrize("moment", [*range(13), 20, 30])
def test_nothing_sets_off_after_a_stop_at_any_moment(kind, moment):
    order, run = PASSES[kind]
    shop, stage, _, drive = bench(order)

    def stop(number):
        if number == moment:
            shop.at_call = lambda _number: None
            drive.stopping.set()
            shop.sent.append("stopping")
            stage.stop()

    shop.at_call = stop
    if moment == 0:
        stop(0)
    with contextlib.suppress(StageStopped):
        run(drive)
    after = shop.sent[shop.sent.index("stopping") + 1 :]
    assert set(after) <= {"stop"}, shop.sent


def test_a_stop_comes_after_what_sets_off_at_that_moment(monkeypatch):
    monkeypatch.setattr("drivers.passes.stopping._SETTING_OFF_S", 600.0)  # however long this machine is held up
    stopping, sent = Stopping(), []
    stopper = threading.Thread(target=lambda: (stopping.set(), sent.append("stop")))
    with stopping.before_it():
        stopper.start()
        while not stopping.is_set():
            pass
        sent.append("move")
    stopper.join()
    assert sent == ["move", "stop"]
    with pytest.raises(StageStopped), stopping.before_it():
        sent.append("move")
    assert sent == ["move", "stop"]


ORDERS = [
    order
    for order in itertools.permutations(("stage-", "stage+", "scanner-", "scanner+"))
    if order.index("stage-") < order.index("stage+") and order.index("scanner-") < order.index("scanner+")
]


@pytest.mark.parametrize("looks_apart", [0, 1, 4])
@pytest.mark.parametrize("order", ORDERS)
def test_stage_and_scanner_that_go_and_come_back_in_any_order_go_on_to_the_end(order, looks_apart):
    shop, stage, scanner, drive = bench()
    happens = {
        "stage-": stage.unplug,
        "stage+": stage.replug,
        "scanner-": scanner.unplug,
        "scanner+": scanner.replug,
    }
    for number, name in enumerate(order):
        look = 10 + number * looks_apart
        earlier = shop.at_look.get(look, lambda: None)
        shop.at_look[look] = lambda earlier=earlier, name=name: (earlier(), happens[name]())
    MotionPass(drive, scanner).run()
    at_mm = np.array([line.position_mm for line in drive.told.take(0.0) if isinstance(line, Scanline)])
    assert at_mm.max() == pytest.approx(10.0, abs=0.51)
    assert np.diff(np.sort(at_mm)).max() < 0.51


@pytest.mark.parametrize(
    "skipped", [(), range(2, 30, 2), (5, 6, 7, 20), range(3, 40, 4), *((number,) for number in range(12, 20))]
)
def test_counted_lines_keep_their_places_where_others_are_missing(skipped):
    shop, _, scanner, drive = bench(PassOrder(0.0, 10.0, 0.5), PairBy.COUNT)  # the speed is chosen by the rate
    scanner.skipped = frozenset(skipped)
    MotionPass(drive, scanner).run()
    told = drive.told.take(0.0)
    lines = [event for event in told if isinstance(event, Scanline)]
    numbers = np.array([line.line_index for line in lines])
    at_mm = np.array([line.position_mm for line in lines])
    first = numbers[0] - round(at_mm[0] / 0.5)
    np.testing.assert_allclose(at_mm, 0.5 * (numbers - first))
    assert all(number in skipped for number in range(first, numbers[0]))
    assert sorted({*range(numbers[0], numbers[-1] + 1)} - {*numbers}) == [
        number for number in skipped if numbers[0] < number < numbers[-1]
    ]
    # A line was exposed when its time tells: by then the stage had gone the way that its place says, to one spacing.
    set_off_s = shop.moved_s[-1]
    truly_mm = 10.0 * (np.array([line.device_time_s for line in lines]) - set_off_s)
    assert np.abs(truly_mm - at_mm).max() <= drive.lines.report().largest_uncertainty_mm + 1e-6
    assert not [event for event in told if isinstance(event, Advice)]


@pytest.mark.parametrize(("speed", "is_told"), [(10.0, False), (9.0, False), (2.0, True), (20.0, True)])
@pytest.mark.parametrize("held_up_at", [None, 12, 20])
def test_a_count_that_does_not_match_is_told_and_a_pause_of_the_program_is_no_mismatch(speed, is_told, held_up_at):
    shop, _, scanner, drive = bench(PassOrder(0.0, 10.0, 0.5, speed), PairBy.COUNT)

    def hold_up():  # the stage goes on, the scanner too, and what it says is lost
        shop.now_s += 600 * 0.05
        scanner.miss(600)

    if held_up_at is not None and not is_told:
        shop.at_look[held_up_at] = hold_up
    MotionPass(drive, scanner).run()
    told = [event.text for event in drive.told.take(0.0) if isinstance(event, Advice)]
    assert any("lines and places do not match" in text for text in told) is is_told


def on_a_conveyor(spacing_mm, by=PairBy.TIME):
    """A pass of 20 lines a second over a conveyor of 10 mm/s: lines come half a millimetre apart."""
    shop, _, scanner, drive = bench(PassOrder(0.0, 10.0, spacing_mm), by)
    belt = ConstantSpeed(
        StageSetup(None, None, speed_mm_per_s=(10.0, 10.0), options={"speed_tolerance": 0.0}, clock=shop.clock)
    )
    return scanner, replace(drive, stage=belt, driven=None)


@pytest.mark.parametrize("by", [PairBy.TIME, PairBy.COUNT])
def test_a_spacing_that_a_conveyor_cannot_give_is_refused_with_the_one_that_it_gives(by):
    scanner, drive = on_a_conveyor(1e-4, by)
    with pytest.raises(
        DriverError, match=r"0\.0001 mm apart cannot be had: at 10 mm/s and 20 lines .* come 0\.5 mm apart"
    ):
        MotionPass(drive, scanner).run()
    assert sum(isinstance(event, Scanline) for event in drive.told.take(0.0)) < 10


@pytest.mark.parametrize(
    ("spacing_mm", "is_told"), [(0.1, True), (0.3, False), (0.5, False), (0.9, False), (1.5, True)]
)
def test_lines_that_come_farther_apart_or_closer_than_ordered_are_taken_and_told(spacing_mm, is_told):
    scanner, drive = on_a_conveyor(spacing_mm)
    MotionPass(drive, scanner).run()
    told = drive.told.take(0.0)
    assert sum(isinstance(event, Scanline) for event in told) >= 20
    assert any(isinstance(event, Advice) and "come 0.5 mm apart" in event.text for event in told) is is_told


@pytest.mark.parametrize("at_look", range(1, 8))
def test_a_pause_among_the_first_lines_on_a_conveyor_is_no_spacing(at_look):
    scanner, drive = on_a_conveyor(0.5)  # asked line by line, as some scanners are: it measures nothing meanwhile

    def hold_up():
        scanner.shop.now_s += 0.6

    scanner.shop.at_look[at_look] = hold_up
    MotionPass(drive, scanner).run()
    assert not [event for event in drive.told.take(0.0) if isinstance(event, Advice)]


@pytest.mark.parametrize(
    ("speed", "rate_hz", "text"), [(math.nan, 38.0, "the pass goes at 19 mm/s"), (20.0, 40.0, "go at 19 mm/s or less")]
)
def test_a_wire_that_has_no_time_for_all_lines_slows_the_pass_down_or_is_told(speed, rate_hz, text):
    _, _, scanner, drive = bench(PassOrder(0.0, 10.0, 0.5, speed))
    drive.description.limits.line_rate_hz = (0.0, 1000.0)
    scanner.most_lines_per_s = 40.0 - 1e-9
    shop = scanner.shop
    shop.at_look[20] = scanner.stop_pass
    run_with_device(drive, scanner)
    assert scanner.ordered[-1] == pytest.approx(rate_hz)
    assert [event.text for event in drive.told.take(0.0) if isinstance(event, Advice) and text in event.text]


def test_a_scanner_that_waits_for_places_where_the_stage_will_not_come_is_not_waited_for():
    shop, stage, scanner, drive = bench(by=PairBy.DEVICE)
    scanner.skipped = range(10, MOST_LOOKS)  # its encoder has slipped: the stage rests, and places are missing
    assert run_with_device(drive, scanner) == "stopped"
    assert not scanner.laser_on
    assert [event for event in drive.told.take(0.0) if isinstance(event, Advice) and "the stage rests" in event.text]
    shop, stage, scanner, drive = bench(by=PairBy.DEVICE)
    shop.at_look[10] = stage.unplug
    with pytest.raises(StageNotConnected):
        run_with_device(drive, scanner)


def rig(makes_stage=BenchStage):
    shop = Workshop()
    stage, scanner = makes_stage(shop), BenchScanner(shop)
    return stage, RunningRig(parse_rig(RIG), scanner=scanner, stage=stage, clock=shop.clock)


def ended(running):
    while True:
        for event in running.events(1.0):
            if isinstance(event, RigPassEnded):
                return event


def test_a_rig_that_was_stopped_sets_off_again_only_when_it_is_entered_anew():
    stage, running = rig()
    running.enter()
    running.stop()
    with pytest.raises(StageStopped, match="entered anew"):
        running.start(ORDER)
    assert stage.shop.sent == ["stop"]
    running.enter()
    running.start(ORDER)
    assert ended(running).reason == "reached_end"
    running.exit()


def test_a_stop_while_a_pass_is_about_to_start_is_not_forgotten():
    stage, running = rig()
    running.enter()
    stage.at_known = running.stop  # asked within `start`, behind every check of whoever calls it
    with pytest.raises(StageStopped):
        running.start(ORDER)
    assert stage.shop.sent == ["stop"]


class SlowToHome(BenchStage):
    """Its homing begins only after somebody's stop, and lasts until the next one."""

    def __init__(self, shop):
        super().__init__(shop)
        self.asked, self.first_stop, self.homing, self.next_stop = (threading.Event() for _ in range(4))

    def home(self):
        self.asked.set()
        assert self.first_stop.wait(30.0)
        self.homing.set()
        assert self.next_stop.wait(30.0), "the homing goes on after the stop"
        raise StageStopped("stopped")

    def stop(self):
        super().stop()
        (self.next_stop if self.homing.is_set() else self.first_stop).set()


class Ended:
    """A sink that only wants to know how it ended."""

    def __init__(self):
        self.failures = []

    def ended(self, failure):
        self.failures.append(failure)


def test_a_homing_that_begins_behind_the_stop_of_its_session_is_stopped_too():
    stage, running = rig(SlowToHome)
    description = parse_rig(RIG)
    info = SimpleNamespace(geometry=None, device_id="S")
    source, sink = RigSource(running, ORDER, info, Preparation(home=True), description), Ended()
    running.enter()
    source.start(sink)
    assert stage.asked.wait(30.0)
    source.stop()
    assert sink.failures == [None]
    assert set(stage.shop.sent) == {"stop"}


def test_events_that_nobody_fetched_are_counted_and_told_before_the_end():
    told = Told()
    for count in range(1_007):
        told.event(ClockJumped(count))
    end = RigPassEnded("stopped", None, bench()[3].lines.report())
    told.event(end)
    taken = told.take(0.0)
    assert taken[-1] is end
    assert [event.text.split()[0] for event in taken if isinstance(event, Advice)] == ["7"]
    assert len(taken) == 1_002
    told.event(ClockJumped(1))
    assert told.take(0.0) == [ClockJumped(1)]
