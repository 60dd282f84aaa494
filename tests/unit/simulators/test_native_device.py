"""The simulated device keeps the manners of docs/protocol.md; time is simulated, too."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.protocols.framing import Damage
from drivers.protocols.native import Decoder, encode
from drivers.protocols.native_messages import (
    NO_RETURN,
    UNKNOWN_NM,
    Ack,
    AckStatus,
    Chunk,
    EndOfPass,
    EndReason,
    EndSeen,
    FromHost,
    Hello,
    HelloRequest,
    Keepalive,
    Laser,
    Message,
    PositionKind,
    Start,
    Stop,
)
from drivers.scanline import DeviceInfo, SensorGeometry
from simulators.devices.native import END_REPEAT_S, NativeDevice
from tests.singles import apart

N_POINTS = 60
INFO = DeviceInfo(
    "SN-1", "M", "F", "C", 77, N_POINTS, SensorGeometry(np.array([0.0, 0.0, 90.0]), np.zeros(3), (-9.0, 9.0), 0.01)
)


def scene(stage_mm: float) -> tuple[np.ndarray, np.ndarray]:
    x_mm = np.linspace(-3, 3, N_POINTS)
    z_mm = np.full(N_POINTS, stage_mm)
    z_mm[7] = np.nan
    return x_mm, z_mm


def new_device(**settings: float) -> NativeDevice:
    return NativeDevice(INFO, scene, rng=np.random.default_rng(3), **settings)  # type: ignore[arg-type]


def hear(device: NativeDevice, now_s: float, room_bytes: int = 1_000_000) -> list[Message]:
    found = apart(Decoder().receive(device.transmit(now_s, room_bytes)))
    assert not [item for item in found if isinstance(item, Damage)]
    return [item for item in found if not isinstance(item, Damage)]


def tell(device: NativeDevice, command: FromHost, now_s: float) -> AckStatus:
    device.receive(encode(command), now_s)
    acks = [item for item in hear(device, now_s) if isinstance(item, Ack) and item.command_id == command.command_id]
    return acks[-1].result


def start(n_lines: int, command_id: int = 2, rate_hz: int = 100) -> Start:
    return Start(command_id, 100_000, 0, 100_000 * (n_lines - 1), rate_hz * 1000)


def test_at_boot_the_laser_is_off_and_a_hello_comes_unasked() -> None:
    device = new_device()
    (hello,) = hear(device, 0.0)
    assert isinstance(hello, Hello)
    assert hello.command_id == 0
    assert hello.info.device_id == "SN-1"
    assert not device.laser_on
    assert not device.streaming
    assert (hello.status.next_sequence, hello.status.next_line, hello.status.pass_index) == (0, 0, 0)
    assert device.next_due_s(0.0) is None


def test_a_pass_sends_every_line_at_its_time_and_place_and_ends_by_itself() -> None:
    device = new_device()
    tell(device, Laser(1, True), 0.0)
    assert tell(device, start(5), 0.0) is AckStatus.OK
    chunks: list[Chunk] = []
    for tick in range(9):
        device.receive(encode(Keepalive(9)), tick * 0.005)
        chunks += [item for item in hear(device, tick * 0.005) if isinstance(item, Chunk)]
    # The command itself was answered at time 0, together with line 0.
    assert {chunk.line_index for chunk in chunks} == {1, 2, 3, 4}
    assert [chunk.sequence for chunk in chunks] == list(range(2, 10))
    assert {chunk.device_time_us for chunk in chunks} == {10_000, 20_000, 30_000, 40_000}
    assert {(c.position_kind, c.position) for c in chunks} == {
        (PositionKind.STAGE_NM, line * 100_000) for line in range(1, 5)
    }
    assert {(c.line_spacing_nm, c.step_nm) for c in chunks} == {(100_000, 100_000)}
    points = np.concatenate([chunk.points for chunk in chunks[:2]])
    assert points.shape == (N_POINTS, 2)
    np.testing.assert_array_equal(points[7], [NO_RETURN, NO_RETURN])
    np.testing.assert_array_equal(points[[0, -1]], [[-30_000, 1000], [30_000, 1000]])
    assert not device.streaming
    assert not device.laser_on
    assert device.status.end_reason is EndReason.REACHED_END


def test_the_first_line_of_a_pass_has_no_measured_step_and_counts_are_scaled() -> None:
    device = new_device(encoder_mm_per_count=0.0005)
    tell(device, Laser(1, True), 0.0)
    device.receive(encode(Start(2, 100_000, 1_000_000, 0, 100_000)), 0.0)
    device.receive(encode(Keepalive(9)), 0.01)
    lines = {item.line_index: item for item in hear(device, 0.011) if isinstance(item, Chunk)}
    assert lines[0].step_nm == UNKNOWN_NM
    assert lines[1].step_nm == -100_000
    assert [(lines[k].position_kind, lines[k].position) for k in (0, 1)] == [
        (PositionKind.ENCODER_COUNT, 2000),
        (PositionKind.ENCODER_COUNT, 1800),
    ]


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_lines_are_measured_where_the_encoder_says_that_the_axis_is_however_late_somebody_looks(way: float) -> None:
    axis_mm = [0.0]
    device = new_device(encoder_mm_per_count=0.001, encoder_mm=lambda now_s: axis_mm[0])  # type: ignore[arg-type]
    tell(device, Laser(1, True), 0.0)
    device.receive(encode(Start(2, 100_000, 0, round(way * 1_000_000), 1_000_000)), 0.0)
    seen = {}
    for now_s, at_mm in ((0.1, 0.0), (0.2, 0.0), (0.3, 0.05), (0.31, 0.35), (0.4, 0.2), (0.41, 0.9995)):
        device.receive(encode(Keepalive(9)), now_s)
        axis_mm[0] = way * at_mm
        lines = [item for item in hear(device, now_s) if isinstance(item, Chunk)]
        seen[now_s] = sorted({round(line.position * way) for line in lines})
        assert all(line.device_time_us == round(now_s * 1e6) for line in lines)
    assert seen == {0.1: [0], 0.2: [], 0.3: [], 0.31: [100, 200, 300], 0.4: [], 0.41: [*range(400, 1001, 100)]}
    assert device.status.end_reason is EndReason.REACHED_END  # the last one to a count


@pytest.mark.parametrize(
    ("command", "result"),
    [
        (Start(2, 0, 0, 1000, 1000), AckStatus.BAD_VALUE),
        (Start(2, -5, 0, 1000, 1000), AckStatus.BAD_VALUE),
        (Start(2, 5, 0, 1000, 0), AckStatus.BAD_VALUE),
        (Start(2, 5, 0, 1000, 100_000_000), AckStatus.BAD_VALUE),
        (Start(2, 5, 0, 60_000_000, 1000), AckStatus.BAD_VALUE),
        (Start(2, 5, -1, 10, 1000), AckStatus.BAD_VALUE),
    ],
)
def test_an_impossible_start_is_refused(command: Start, result: AckStatus) -> None:
    device = new_device(travel_mm=(0.0, 50.0))  # type: ignore[arg-type]
    assert tell(device, start(3), 0.0) is AckStatus.LASER_OFF
    tell(device, Laser(1, True), 0.0)
    assert tell(device, command, 0.0) is result
    assert not device.streaming


def test_a_start_is_busy_while_a_pass_runs_and_its_repetition_is_not_carried_out_again() -> None:
    device = new_device()
    tell(device, Laser(1, True), 0.0)
    assert tell(device, start(50), 0.0) is AckStatus.OK
    assert tell(device, start(50), 0.0) is AckStatus.OK
    assert device.status.pass_index == 1
    assert tell(device, start(50, command_id=3), 0.0) is AckStatus.BUSY
    assert device.streaming


@pytest.mark.parametrize("command", [Stop(5), Laser(5, False)])
def test_stop_and_laser_off_end_the_pass_at_once_with_the_laser_off(command: FromHost) -> None:
    device = new_device()
    tell(device, Laser(1, True), 0.0)
    tell(device, start(50), 0.0)
    device.receive(encode(command), 0.1)
    assert not device.laser_on
    assert not device.streaming
    (end,) = [item for item in hear(device, 0.1) if isinstance(item, EndOfPass)]
    assert end.status.end_reason is EndReason.STOPPED


def test_the_end_is_repeated_until_it_is_seen() -> None:
    device = new_device()
    tell(device, Laser(1, True), 0.0)
    device.receive(encode(start(1)), 0.0)
    ends = 0
    for tick in range(100):
        now_s = tick * 0.01
        ends += sum(isinstance(item, EndOfPass) for item in hear(device, now_s))
    assert ends == 1 + int(0.99 / END_REPEAT_S)
    device.receive(encode(EndSeen(9, 2)), 1.0)  # of another pass
    assert [type(item) for item in hear(device, 1.05)] == [EndOfPass]
    device.receive(encode(EndSeen(9, 1)), 1.1)
    assert hear(device, 3.0) == []
    assert device.next_due_s(3.0) is None


@settings(max_examples=30, deadline=None)
@given(st.floats(0.01, 0.49), st.integers(0, 20), st.booleans())
def test_the_dead_man_stops_laser_and_pass_half_a_second_after_the_last_word(
    every_s: float, n_words: int, stream: bool
) -> None:
    device = new_device()
    tell(device, Laser(1, True), 0.0)
    if stream:
        tell(device, start(100_000), 0.0)
    for word in range(1, n_words + 1):
        device.receive(encode(Keepalive(3)), word * every_s)
        assert device.laser_on
    last_s = n_words * every_s
    device.receive(b"\0\x55noise\0" + encode(Keepalive(3))[:-3] + b"\0\0", last_s + 0.2)  # noise is no word
    device.transmit(last_s + 0.499, 100_000)
    assert device.laser_on
    assert (device.next_due_s(last_s + 0.5) or 0) <= last_s + 0.5 + 1e-9
    device.transmit(last_s + 0.501, 100_000)
    assert not device.laser_on
    assert not device.streaming
    device.receive(encode(Keepalive(4)), last_s + 0.6)
    device.receive(encode(HelloRequest(5)), last_s + 0.6)
    device.transmit(last_s + 0.6, 100_000)
    assert not device.laser_on


@settings(max_examples=40, deadline=None)
@given(st.integers(600, 8000), st.lists(st.integers(0, 1500), min_size=20, max_size=60))
def test_a_slow_wire_makes_the_device_drop_and_count_every_chunk_it_drops(buffer_bytes: int, rooms: list[int]) -> None:
    device = new_device(buffer_bytes=buffer_bytes)
    device.receive(encode(Laser(1, True)) + encode(start(40)), 0.0)
    stream = b""
    for tick, room in enumerate(rooms):
        device.receive(encode(Keepalive(3)), tick * 0.02)
        sent = device.transmit(tick * 0.02, room)
        assert len(sent) <= room
        stream += sent
    while data := device.transmit(len(rooms) * 0.02 - 0.01, 10_000):
        stream += data
    device.receive(encode(HelloRequest(4)), len(rooms) * 0.02 - 0.01)
    stream += device.transmit(len(rooms) * 0.02 - 0.01, 10_000)
    messages = apart(Decoder().receive(stream))
    chunks = [item for item in messages if isinstance(item, Chunk)]
    hello = messages[-1]
    assert isinstance(hello, Hello)
    before = -1
    for seen, chunk in enumerate(chunks):
        assert chunk.sequence > before
        assert chunk.dropped_chunks == chunk.sequence - seen
        lines = {item.line_index for item in chunks[: seen + 1]}
        assert chunk.dropped_lines == chunk.line_index + 1 - len(lines)
        before = chunk.sequence
    # Every answer's totals hold at its place in the stream.
    seen = 0
    for item in messages:
        seen += isinstance(item, Chunk)
        if isinstance(item, Ack | Hello | EndOfPass):
            assert item.status.next_sequence == item.status.dropped_chunks + seen
    assert hello.status.next_sequence == hello.status.dropped_chunks + len(chunks)
    assert hello.status.next_line == hello.status.dropped_lines + len({chunk.line_index for chunk in chunks})


def test_a_reboot_changes_the_boot_id_forgets_everything_and_leaves_the_laser_off() -> None:
    device = new_device()
    tell(device, Laser(1, True), 0.0)
    tell(device, start(50), 0.0)
    device.reboot()
    assert device.boot_id != 77
    assert not device.laser_on
    assert not device.streaming
    (hello,) = hear(device, 0.2)
    assert isinstance(hello, Hello)
    assert hello.status.boot_id == device.boot_id
    assert hello.status.next_sequence == 0


def test_a_scene_with_the_wrong_number_of_points_is_refused() -> None:
    device = NativeDevice(INFO, lambda _: (np.zeros(3), np.zeros(3)), rng=np.random.default_rng(0))
    tell(device, Laser(1, True), 0.0)
    device.receive(encode(start(2)), 0.0)
    with pytest.raises(ValueError, match="3 points for a line of 60"):
        device.transmit(0.0, 10_000)
