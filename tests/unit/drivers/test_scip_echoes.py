"""Several echoes a step: whole, damaged, any bytes; and as a lidar that sees through a pane tells them."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import ScannerRefused
from drivers.protocols.scip import SCANNING, Reply, ReplyDecoder, data_lines, reply
from drivers.protocols.scip_echoes import ECHO_STREAMS, NONE, echo_characters, echoes_of
from drivers.protocols.scip_host import ScipHost
from drivers.protocols.scip_plan import ScipOptions
from simulators.devices.scip import ScipDevice
from simulators.devices.scip_scans import UTM_30LX, UTM_30LX_EW
from tests.unit.drivers.conversation_bench import ConversationBench

VALUES = st.integers(0, (1 << 18) - 1)


def steps_of(width: int):
    echo = st.tuples(*[VALUES] * (width // 3))
    return st.lists(st.lists(echo, min_size=1, max_size=3), min_size=1, max_size=80)


def heard(lines: bytes) -> Reply:
    (answer,) = ReplyDecoder().receive(reply("ND0000010001000", SCANNING, lines))
    assert isinstance(answer, Reply)
    return answer


@pytest.mark.parametrize("width", ECHO_STREAMS.values())
@given(data=st.data())
def test_what_is_said_is_heard_echo_by_echo(width: int, data: st.DataObject) -> None:
    steps = data.draw(steps_of(width))
    scan = echoes_of(heard(data_lines(7, echo_characters(steps))), width, len(steps))
    assert scan is not None
    assert (scan.timestamp, scan.damaged_bytes, scan.damaged.any()) == (7, 0, False)
    for step, echoes in enumerate(steps):
        distances = [echo[0] for echo in echoes] + [NONE] * (3 - len(echoes))
        assert scan.distances[step].tolist() == distances
        if width == 6:
            assert scan.intensities[step].tolist() == [echo[1] for echo in echoes] + [NONE] * (3 - len(echoes))


def test_the_characters_are_those_of_the_protocol() -> None:
    assert echo_characters([[(5432,)], [(5432,), (1234,)]]) == b"1Dh" + b"1Dh&0CB"


@pytest.mark.parametrize("width", ECHO_STREAMS.values())
@given(data=st.data())
def test_a_damaged_block_costs_the_steps_from_there_on_and_no_step_is_told_wrong(
    width: int, data: st.DataObject
) -> None:
    steps = data.draw(steps_of(width))
    time, *blocks = data_lines(7, echo_characters(steps)).split(b"\n")[:-1]
    hit = data.draw(st.integers(0, len(blocks) - 1))
    at = data.draw(st.integers(0, len(blocks[hit]) - 1))
    broken = bytearray(blocks[hit])
    broken[at] ^= 1 << data.draw(st.integers(0, 3))  # a flip that leaves no line end
    blocks[hit] = bytes(broken)
    lines = (time, *blocks)
    scan = echoes_of(Reply("ND0000010001000", SCANNING, lines, 0), width, len(steps))
    assert scan is not None
    assert scan.damaged_bytes == sum(len(block) + 1 for block in blocks[hit:])
    first = int(np.argmax(scan.damaged)) if scan.damaged.any() else len(steps)
    assert scan.damaged[first:].all()
    assert first * width <= hit * 64
    for step in range(first):
        assert scan.distances[step].tolist() == [echo[0] for echo in steps[step]] + [NONE] * (3 - len(steps[step]))


@given(st.lists(st.binary(max_size=80), max_size=8), st.sampled_from([3, 6]), st.integers(1, 40))
def test_any_lines_are_a_scan_or_none(lines: list[bytes], width: int, n_steps: int) -> None:
    scan = echoes_of(Reply("ND", SCANNING, tuple(lines), 0), width, n_steps)
    assert scan is None or scan.distances.shape == (n_steps, 3)


def pane(angles: np.ndarray, _elapsed_s: float) -> np.ndarray:
    """A pane of glass that fills the right half."""
    return np.where(angles < 0.0, 300.0, np.nan)


def wall(angles: np.ndarray, _elapsed_s: float) -> np.ndarray:
    return np.full(len(angles), 900.0)


@pytest.mark.parametrize(
    ("command", "echo", "right_mm"),
    [("ND", "first", 300), ("ND", "last", 900), ("NE", "strongest", 900), ("NE", "first", 300)],
)
def test_a_lidar_that_sees_through_a_pane_gives_the_echo_that_is_wanted(
    command: str, echo: str, right_mm: float
) -> None:
    scene = lambda angles, at_s: np.where(angles < 0.0, pane(angles, at_s), wall(angles, at_s))  # noqa: E731
    behind = lambda angles, at_s: np.where(angles < 0.0, wall(angles, at_s), np.nan)  # noqa: E731
    device = ScipDevice(scene, UTM_30LX_EW, behind=behind)
    options = ScipOptions(field_of_view_rad=(-0.3, 0.3), command=command, echo=echo, work_rate=750_000)
    lidar = ConversationBench(partial(ScipHost, options=options), device).meet()
    lidar.start()
    lidar.scan(5)
    lidar.stop()
    tally = lidar.host.tally()
    assert tally.lines.sent == tally.lines.whole == device.scans_sent
    assert tally.damage == {}
    for line in lidar.lines:
        ranges = np.hypot(line.x_mm, line.z_mm)
        right = line.x_mm < -1e-6
        np.testing.assert_allclose(ranges[right], right_mm)
        np.testing.assert_allclose(ranges[~right], 900.0)


def test_a_model_that_tells_no_echoes_says_so() -> None:
    device = ScipDevice(wall, UTM_30LX)
    options = ScipOptions(field_of_view_rad=(-0.3, 0.3), command="ND", work_rate=750_000)
    with pytest.raises(ScannerRefused, match="does not know this request"):
        ConversationBench(partial(ScipHost, options=options), device).meet().start()


@pytest.mark.parametrize(
    "wrong", [{"echo": "loudest"}, {"echo": "last"}, {"command": "ND", "echo": "strongest"}, {"command": "HD"}]
)
def test_echoes_that_the_command_does_not_tell_are_refused(wrong: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=r"echo|asked with"):
        ScipOptions(**wrong)  # type: ignore[arg-type]
