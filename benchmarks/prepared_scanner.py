"""A scanner on a pseudo-terminal whose lines were measured and encoded beforehand, and when each line left it.

Runs in a process of its own (`serve_prepared`), so that making scanlines costs the service no time. Knows no service.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection

import numpy as np
import numpy.typing as npt

from benchmarks.cloud import LINE_SPACING_MM, NOISE_MM, POINTS_PER_LINE, make_line
from drivers.protocols.native import encode
from drivers.protocols.native_messages import NM_PER_MM, EndReason, Laser, Start
from drivers.scanline import DeviceInfo, Float64Array, SensorGeometry
from scanner_service.analysis.intake import QUANTUM_MM
from simulators.devices.native import NativeDevice, SceneLine, _Queued
from simulators.pty_port import PtyPort

BAUD_RATE = 480_000_000
"""The sender's own pace: USB 2.0, which has no baud rate; what limits a run is its line rate."""
_SPACING_NM = round(LINE_SPACING_MM * NM_PER_MM)
_SEARCH_BYTES = 1 << 20  # answers between two lines are a few dozen bytes


@dataclass(frozen=True, slots=True)
class PassPlan:
    """One pass over the benchmark's cloud: so many lines, so many a second."""

    lines: int
    rate_hz: float
    seed: int = 1

    @property
    def end_mm(self) -> float:
        """Stage position of the last line; the first is at 0."""
        return (self.lines - 1) * _SPACING_NM / NM_PER_MM


@dataclass(frozen=True, slots=True)
class Sent:
    """What a sender did: all arrays (lines,), seconds of CLOCK_MONOTONIC.

    `returns` are the points of each line that have a return; `due_s` is when the line was to leave, `left_s` when its
    last byte had been written to the terminal.
    """

    returns: npt.NDArray[np.int64]
    due_s: Float64Array
    left_s: Float64Array
    cpu_s: float


class PreparedDevice(NativeDevice):
    """A native scanner that has rehearsed its one pass: its frames are at hand when they are due.

    Everything else, the greeting, the acknowledgements, the end of the pass, is the simulated device's own. Nothing is
    dropped here: what the terminal does not take waits, and shows in `left_s`.
    """

    def __init__(self, info: DeviceInfo, scene_line: SceneLine, plan: PassPlan) -> None:
        whole_pass = 2 * plan.lines * info.points_per_line * 16
        super().__init__(
            info,
            scene_line,
            rng=np.random.default_rng(plan.seed),
            max_line_rate_hz=math.inf,
            buffer_bytes=whole_pass,
        )
        self.sent: list[bytes] = []
        self.began_s = math.nan
        self._prepared: list[list[_Queued]] = []
        self.receive(encode(Laser(1, True)), 0.0)
        self.receive(encode(Start(2, _SPACING_NM, 0, round(plan.end_mm * NM_PER_MM), round(plan.rate_hz * 1000))), 0.0)
        while (running := self._pass) is not None:
            self._queue.clear()
            self._queued_bytes = 0
            super()._measure(running)
            self._prepared.append([item for item in self._queue if item.chunk is not None])
        self._boot(info, 0, 0)

    def last_frames(self) -> list[bytes]:
        """The last frame of every line, each unique by its sequence number and checksum."""
        return [frames[-1].frame for frames in self._prepared]

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        """As the device does, and keep what was sent."""
        data = super().transmit(now_s, room_bytes)
        if data:
            self.sent.append(data)
        return data

    def _measure(self, running) -> None:  # type: ignore[no-untyped-def]  # the device's own class of a pass
        if running.done_lines == 0:
            self.began_s = running.start_s
        frames = self._prepared[running.done_lines]
        self._queue.extend(frames)
        self._queued_bytes += sum(len(item.frame) for item in frames)
        self._next_sequence += len(frames)
        self._next_line += 1
        running.done_lines += 1
        if running.done_lines == running.n_lines:
            self._end_pass(EndReason.REACHED_END, running.due_s)


class TimedPort(PtyPort):
    """The simulated port, noting after each writing when it was and how many bytes had been written by then."""

    def __init__(self, device: PreparedDevice) -> None:
        super().__init__(device, BAUD_RATE)
        self.written: list[tuple[float, int]] = []

    def _write(self) -> None:
        before = self._counts.sent_bytes
        super()._write()
        if self._counts.sent_bytes != before:
            self.written.append((self._clock(), self._counts.sent_bytes))


def prepare(plan: PassPlan) -> tuple[PreparedDevice, npt.NDArray[np.int64]]:
    """The scanner over the cloud, and how many points of each line have a return."""
    rng = np.random.default_rng(plan.seed)
    returns: list[int] = []

    def scene_line(position_mm: float) -> tuple[Float64Array, Float64Array]:
        line = make_line(round(position_mm / LINE_SPACING_MM), rng)
        x_mm, z_mm = np.full((2, POINTS_PER_LINE), np.nan)
        x_mm[line.index] = line.xyz_q[:, 0] * QUANTUM_MM
        z_mm[line.index] = line.xyz_q[:, 2] * QUANTUM_MM
        returns.append(len(line.index))
        return x_mm, z_mm

    optics = SensorGeometry(np.array([0.0, 0.0, 150.0]), np.array([60.0, 0.0, 150.0]), (-30.0, 30.0), NOISE_MM)
    info = DeviceInfo("BENCH-0001", "Prepared scanner", "benchmark", "BENCH-0001-A", 1, POINTS_PER_LINE, optics)
    return PreparedDevice(info, scene_line, plan), np.array(returns)


def leaving_times_s(device: PreparedDevice, written: list[tuple[float, int]]) -> Float64Array:
    """(lines,) when each line's last byte had been written; NaN for a line that never left."""
    stream = b"".join(device.sent)
    frames = device.last_frames()
    ends = np.full(len(frames), len(stream) + 1)
    at = 0
    for number, frame in enumerate(frames):
        found = stream.find(frame, at, at + _SEARCH_BYTES)
        if found < 0:
            break
        at = found + len(frame)
        ends[number] = at
    times_s = np.array([at_s for at_s, _ in written] + [math.nan])
    return np.asarray(times_s[np.searchsorted([total for _, total in written], ends)])


def serve_prepared(parent: Connection, plan: PassPlan, clock: Callable[[], float] = time.monotonic) -> None:
    """A process' whole life: prepare, tell the parent the port, serve until it says anything, hand over `Sent`."""
    device, returns = prepare(plan)
    port = TimedPort(device)
    with port:
        while not (port.is_quiet or port.has_failed):
            time.sleep(0.002)
        parent.send(str(port.path))
        cpu_s = time.process_time()
        parent.recv()
        cpu_s = time.process_time() - cpu_s
    due_s = device.began_s + np.arange(plan.lines) / plan.rate_hz
    parent.send(Sent(returns, due_s, leaving_times_s(device, port.written), cpu_s))
