"""Whatever happens to a line, sent = stored + lost by reason, lines are numbered upwards and time never runs back."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.protocols.conversation import Phase
from drivers.protocols.lms_host import LmsHost
from drivers.protocols.ls100_host import Ls100Host
from drivers.protocols.rplidar_host import RplidarHost
from drivers.protocols.scip_host import ScipHost
from drivers.protocols.scip_plan import ScipOptions
from simulators.devices.echoing import EchoingAdapter
from simulators.devices.lms import LmsDevice
from simulators.devices.ls100 import Ls100Device
from simulators.devices.rplidar import RplidarDevice
from simulators.devices.scip import ScipDevice
from tests.unit.drivers.conversation_bench import ConversationBench, flat_scene


def profile(elapsed_s: float) -> tuple[np.ndarray, np.ndarray]:
    return np.linspace(-5, 5, 200), np.full(200, elapsed_s)


BENCHES = {
    "scip": lambda: ConversationBench(
        partial(ScipHost, options=ScipOptions(field_of_view_rad=(-0.3, 0.3))),
        ScipDevice(flat_scene(), clock_ms=(1 << 24) - 3000),
    ),
    "lms200": lambda: ConversationBench(LmsHost, LmsDevice(flat_scene(), rng=np.random.default_rng(1))),
    "rplidar": lambda: ConversationBench(RplidarHost, RplidarDevice(flat_scene())),
    "ls100": lambda: ConversationBench(Ls100Host, EchoingAdapter(Ls100Device(profile))),
}
ACTIONS = st.sampled_from(["run", "noise", "losses", "cut", "short cut", "restart", "overflow", "junk", "pause"])


def act(bench: ConversationBench, action: str, rng: np.random.Generator) -> None:
    """Let something happen, and half a second go by."""

    def flip(data: bytes) -> bytes:
        bits = np.unpackbits(np.frombuffer(data, dtype=np.uint8))
        return np.packbits(bits ^ (rng.random(len(bits)) < 1e-4).astype(np.uint8)).tobytes()

    match action:
        case "noise":
            bench.corrupt = flip
        case "losses":
            bench.corrupt = lambda data: bytes(byte for byte in data if rng.random() > 1e-3)
        case "cut" | "short cut" if bench.plugged:
            bench.unplug()
            bench.run(3.0 if action == "cut" else 0.1)
            bench.plug()
        case "restart" if bench.host.phase is Phase.UP:
            stop = bench.host.stop(bench.now_s)
            if bench.run(20.0, lambda: stop.done) and bench.host.phase is Phase.UP:
                start = bench.host.start(bench.now_s, resume=True)
                bench.run(20.0, lambda: start.done)
        case "overflow":
            bench.keeps = False
        case "junk":
            bench.host.receive(rng.bytes(int(rng.integers(1, 300))), bench.now_s)
        case "pause":  # the host sleeps: what came meanwhile arrives at once
            held = bytearray()
            bench.corrupt = lambda data: (held.extend(data), b"")[1]
            bench.run(0.4)
            bench.corrupt = lambda data: data
            bench.host.receive(bytes(held), bench.now_s)
    bench.run(0.5)
    bench.corrupt = lambda data: data
    bench.keeps = True


def check(kind: str, actions: list[str], seed: int) -> None:
    bench = BENCHES[kind]().meet()
    bench.start()
    bench.scan(2)
    for action in actions:
        act(bench, action, np.random.default_rng(seed))
    tally = bench.host.tally()
    assert tally.lines.balances
    assert tally.chunks.balances
    assert all(count > 0 for count in tally.lines.lost.values())
    assert tally.lines.whole == sum(line.is_whole for line in bench.lines)
    assert tally.lines.partial == sum(not line.is_whole for line in bench.lines)
    numbers = [line.line_index for line in bench.lines]
    assert numbers == sorted(set(numbers))
    times = [line.device_time_s for line in bench.lines]
    assert times == sorted(times)


@pytest.mark.parametrize("kind", BENCHES)
@given(actions=st.lists(ACTIONS, max_size=6), seed=st.integers(0, 1000))
@settings(max_examples=6, deadline=None)
def test_everything_is_in_the_account(kind: str, actions: list[str], seed: int) -> None:
    check(kind, actions, seed)


@pytest.mark.long
@pytest.mark.parametrize("kind", BENCHES)
@given(actions=st.lists(ACTIONS, max_size=12), seed=st.integers(0, 100_000))
@settings(max_examples=300, deadline=None)
def test_everything_is_in_the_account_at_length(kind: str, actions: list[str], seed: int) -> None:
    check(kind, actions, seed)
