"""The host's half against a simulated device in simulated time: resuming, reboots, lost words, no laser by itself."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.protocols.native import Decoder
from drivers.protocols.native_host import NativeHost, Phase
from drivers.protocols.native_messages import Laser, Start
from drivers.protocols.native_requests import PassPlan, Request
from drivers.protocols.scanner_events import (
    Disconnected,
    OtherDevice,
    PassEnded,
    PassNotResumed,
    PassResumed,
    Rebooted,
    Reconnected,
    ScannerEvent,
)
from drivers.scanline import DeviceInfo, Profile, SensorGeometry
from simulators.devices.native import NativeDevice

N_POINTS = 60
TICK_S = 0.01


def scene(stage_mm: float) -> tuple[np.ndarray, np.ndarray]:
    return np.linspace(-3, 3, N_POINTS), np.full(N_POINTS, stage_mm)


def device_named(name: str, boot_id: int = 77) -> NativeDevice:
    geometry = SensorGeometry(np.zeros(3), np.zeros(3), (-9.0, 9.0), 0.01)
    info = DeviceInfo(name, "M", "F", "C", boot_id, N_POINTS, geometry)
    return NativeDevice(info, scene, rng=np.random.default_rng(3))


class Bench:
    """A host and a device on a wire that can be cut, in simulated time."""

    def __init__(self) -> None:
        self.device = device_named("SN-1")
        self.lines: list[Profile] = []
        self.told: list[ScannerEvent] = []
        self.host = NativeHost(lambda line: self.lines.append(line) or True, self.told.append)
        self.now_s = 0.0
        self.plugged = True
        self.commands: list[object] = []  # what the device has heard
        self._ear = Decoder(from_host=True)
        self.lose_to_device = self.lose_to_host = lambda: False

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.now_s += TICK_S
            to_host = self.device.transmit(self.now_s, 4000)
            self.device.next_due_s(self.now_s)
            if not self.plugged:
                self.host.tick(self.now_s)
                continue
            self.host.receive(b"" if self.lose_to_host() else to_host, self.now_s)
            self.host.tick(self.now_s)
            to_device = bytes(self.host.outgoing)
            self.host.outgoing.clear()
            if not self.lose_to_device():
                self.commands += self._ear.receive(to_device)
                self.device.receive(to_device, self.now_s)

    def greet(self) -> "Bench":
        self.host.link_opened(self.now_s)
        self.run(0.5)
        assert self.host.phase is Phase.UP
        return self

    def scan(self, n_lines: int, rate_hz: float = 100.0, resume: bool = True) -> PassPlan:
        plan = PassPlan(0.1, 0.0, 0.1 * (n_lines - 1), rate_hz, resume)
        self.ask(self.host.arm(True, self.now_s))
        self.ask(self.host.start(plan, self.now_s))
        return plan

    def ask(self, request: Request) -> None:
        for _ in range(400):
            if request.done:
                break
            self.run(TICK_S)
        assert request.ok, request

    def unplug(self) -> None:
        self.plugged = False
        self.host.link_lost("pulled out", self.now_s)

    def plug(self) -> None:
        self.plugged = True
        self.device.transmit(self.now_s, 100_000)  # what was under way on the old link is gone
        self.host.link_opened(self.now_s)

    def told_types(self) -> list[type]:
        return [type(event) for event in self.told]


def test_a_quiet_device_is_greeted_with_its_laser_off() -> None:
    bench = Bench().greet()
    assert bench.host.stream is not None
    assert bench.host.stream.info.device_id == "SN-1"
    assert bench.host.laser_on is False


def test_a_stale_stream_is_ended_before_anything_is_counted() -> None:
    bench = Bench().greet()
    bench.scan(10_000)
    bench.run(0.2)
    successor = Bench()
    successor.device = bench.device
    successor.now_s = bench.now_s
    successor.greet()
    assert not bench.device.streaming
    assert not bench.device.laser_on
    assert successor.host.stream is not None
    assert successor.host.stream.tally().to_dict()["chunks"] == {"sent": 0, "stored": 0, "lost": {}}
    successor.scan(20)
    successor.run(1.0)
    assert [line.line_index - successor.lines[0].line_index for line in successor.lines] == list(range(20))


def test_a_whole_pass_is_read_and_its_end_is_told_once() -> None:
    bench = Bench().greet()
    bench.scan(50)
    bench.run(1.5)
    assert [round(line.position_mm, 6) for line in bench.lines] == [round(0.1 * k, 6) for k in range(50)]
    assert bench.told == [PassEnded(1, "reached_end")]
    assert not bench.device.laser_on
    assert bench.host.laser_on is False


def test_a_short_cut_leaves_a_gap_that_is_accounted_for_and_the_pass_goes_on() -> None:
    bench = Bench().greet()
    bench.scan(150)
    bench.run(0.5)
    bench.unplug()
    bench.run(0.3)
    bench.plug()
    bench.run(2.0)
    assert bench.told_types() == [Disconnected, Reconnected, PassEnded]
    assert bench.told[1].streaming is True  # type: ignore[union-attr]
    tally = bench.host.stream.tally()  # type: ignore[union-attr]
    assert tally.lines.sent == 150
    assert tally.lines.whole + tally.lines.partial + sum(tally.lines.lost.values()) == 150
    assert 25 <= tally.lines.lost["disconnected"] <= 40
    assert set(tally.lines.lost) == {"disconnected"}


@pytest.mark.parametrize("resume", [True, False])
def test_after_a_long_cut_the_pass_goes_on_behind_the_last_line_only_if_that_was_asked(resume: bool) -> None:
    bench = Bench().greet()
    bench.scan(150, resume=resume)
    bench.run(0.5)
    bench.unplug()
    bench.run(2.0)
    assert not bench.device.laser_on
    last_mm = bench.lines[-1].position_mm
    bench.plug()
    bench.run(0.6)
    assert bench.device.laser_on is resume
    bench.run(3.0)
    assert bench.told_types()[:3] == [Disconnected, Reconnected, PassEnded]
    assert bench.told[2] == PassEnded(1, "dead_man")
    positions = [round(line.position_mm, 6) for line in bench.lines]
    if resume:
        assert bench.told[3] == PassResumed(2, pytest.approx(last_mm + 0.1))  # type: ignore[arg-type]
        assert bench.told[4] == PassEnded(2, "reached_end")
        assert positions == [round(0.1 * k, 6) for k in range(150)]
    else:
        assert len(bench.told) == 3
        assert len([command for command in bench.commands if isinstance(command, Start)]) == 1
    assert bench.host.stream.tally().lines.balances  # type: ignore[union-attr]


def test_a_reboot_in_the_middle_is_told_and_the_pass_goes_on_in_a_new_boot() -> None:
    bench = Bench().greet()
    bench.scan(100)
    bench.run(0.4)
    bench.device.reboot()
    bench.run(2.5)
    assert bench.told_types() == [Rebooted, PassEnded, PassResumed, PassEnded]
    assert bench.told[0] == Rebooted(77, bench.device.boot_id)
    positions = [round(line.position_mm, 6) for line in bench.lines]
    assert sorted(set(positions)) == [round(0.1 * k, 6) for k in range(100)]
    assert bench.host.stream.tally().lines.balances  # type: ignore[union-attr]


def test_the_hello_of_a_reboot_may_get_lost() -> None:
    bench = Bench().greet()
    bench.scan(100)
    bench.run(0.4)
    bench.device.reboot()
    bench.device.transmit(bench.now_s, 100_000)
    bench.run(2.5)
    assert bench.told_types() == [Rebooted, PassEnded, PassResumed, PassEnded]


def test_another_device_on_the_same_path_is_left_alone() -> None:
    bench = Bench().greet()
    bench.scan(1000)
    bench.run(0.2)
    n_lines = len(bench.lines)
    first, bench.device = bench.device, device_named("SN-2", 5)
    bench.unplug()
    heard = len(bench.commands)
    for _ in range(3):
        bench.plug()
        bench.run(0.5)
        assert bench.host.phase is Phase.OTHER_DEVICE
        bench.unplug()
    assert bench.told[1:] == [OtherDevice("SN-1", "SN-2")]
    assert not [command for command in bench.commands[heard:] if isinstance(command, Laser | Start)]
    assert len(bench.lines) <= n_lines + 1
    bench.device = first
    bench.plug()
    bench.run(1.0)
    assert Reconnected in bench.told_types()


def test_a_stopped_pass_is_not_resumed_even_when_the_link_fails_at_once() -> None:
    bench = Bench().greet()
    bench.scan(1000)
    bench.run(0.2)
    bench.host.stop(bench.now_s)
    bench.unplug()
    bench.run(3.5)
    heard = len(bench.commands)
    bench.plug()
    bench.run(2.0)
    assert not bench.device.laser_on
    assert not [command for command in bench.commands[heard:] if isinstance(command, Laser | Start)]


def test_a_resuming_that_is_refused_is_told() -> None:
    bench = Bench().greet()
    bench.scan(1000)
    bench.run(0.2)
    bench.device._max_line_rate_hz = 1.0
    bench.device.reboot()
    bench.run(4.0)
    assert bench.told_types() == [Rebooted, PassEnded, PassNotResumed]
    bench.run(1.0)
    assert not bench.device.laser_on


def test_a_device_that_falls_silent_is_noticed() -> None:
    bench = Bench().greet()
    bench.scan(1000)
    bench.lose_to_host = lambda: True
    bench.run(0.9)
    assert not bench.host.is_silent(bench.now_s)
    bench.run(0.3)
    assert bench.host.is_silent(bench.now_s)


def test_the_silence_of_a_device_that_was_left_alone_counts_from_when_it_is_spoken_to_again() -> None:
    bench = Bench().greet()
    bench.run(30.0)
    bench.host.arm(True, bench.now_s)
    assert not bench.host.is_silent(bench.now_s)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_on_a_bad_wire_every_chunk_is_accounted_for_and_the_pass_comes_to_its_end(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bench = Bench().greet()
    bench.scan(100)
    bench.lose_to_host = lambda: bool(rng.random() < 0.15)
    bench.lose_to_device = lambda: bool(rng.random() < 0.15)
    for _ in range(100):
        bench.run(0.1)
        if bench.host.is_silent(bench.now_s):
            bench.unplug()
            bench.plug()
        tally = bench.host.stream.tally()  # type: ignore[union-attr]
        assert tally.chunks.balances
        assert tally.lines.balances
        if bench.host.plan is None:
            break
    bench.lose_to_host = bench.lose_to_device = lambda: False
    bench.run(1.0)
    assert bench.host.plan is None
    assert not bench.device.laser_on
    assert isinstance(bench.told[-1], PassEnded)
    tally = bench.host.stream.tally()  # type: ignore[union-attr]
    status = bench.device.status
    assert tally.chunks.sent == status.next_sequence
    assert tally.lines.sent == status.next_line
    assert tally.lines.whole + tally.lines.partial == len(bench.lines)
    assert tally.chunks.stored == sum(
        math.ceil(int((~line.missing).sum()) / 53) for line in bench.lines
    )  # 60 points: chunks of 53 and 7
    assert tally.disagreements == 0
