"""The device's half of the native protocol: commands in, lines out, time passed in; knows no pty and no optics.

What it measures is asked of `scene_line`; what it says is `drivers.protocols.native`; the manners (dead-man, buffers,
drops, repetition of the end of a pass) are those of `docs/protocol.md`, and are all here.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from drivers.protocols.native import MAX_POINTS_PER_CHUNK, Decoder, encode
from drivers.protocols.native_messages import (
    DEAD_MAN_S,
    NM_PER_MM,
    NO_RETURN,
    TENTH_UM_PER_MM,
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
    PositionKind,
    Start,
    Status,
    Stop,
    Type,
)
from drivers.scanline import DeviceInfo

Float64Array = npt.NDArray[np.float64]
SceneLine = Callable[[float], tuple[Float64Array, Float64Array]]

END_REPEAT_S = 0.2
_ENCODER_LOOK_S = 0.002
_LINES_AT_ONCE = 32  # at most so many are rendered in one call, so that commands are never kept waiting
_U32 = 0xFFFFFFFF
_POINT_LIMIT = 2**31 - 1
_COMMAND_TYPES = {HelloRequest: Type.HELLO_REQUEST, Start: Type.START, Stop: Type.STOP, Laser: Type.LASER}


@dataclass(slots=True)
class _Pass:
    """A pass under way: line k is measured at start_s + k / rate_hz, at start_nm + k * step_nm."""

    index: int
    start_s: float
    rate_hz: float
    start_nm: int
    step_nm: int
    n_lines: int
    done_lines: int = 0
    passed_s: float | None = None  # when the axis whose encoder is read has come to the next line

    @property
    def due_s(self) -> float:
        return self.start_s + self.done_lines / self.rate_hz if self.passed_s is None else self.passed_s

    @property
    def place_nm(self) -> int:
        return self.start_nm + self.done_lines * self.step_nm


@dataclass(frozen=True, slots=True)
class _Queued:
    """A frame waiting for the wire, and the chunk it holds; an end of a pass when there is none."""

    frame: bytes
    chunk: Chunk | None


class NativeDevice:
    """A laser-line scanner on its own stage, as far as the wire can tell.

    Parameters
    ----------
    info : who it says it is; `info.boot_id` is that of the first boot.
    scene_line : what the sensor sees with its stage at a position in mm: x and z of `info.points_per_line` points in
        the sensor frame, mm, NaN where there is no return.
    rng : chance, for the boot ids after the first.
    max_line_rate_hz : a START beyond it is refused.
    travel_mm : (lowest, highest) position of the stage; a START beyond it is refused.
    buffer_bytes : what may wait for the wire. Chunks that do not fit are dropped, and counted, when they are measured.
    encoder_mm_per_count : when given, positions are told in counts of this size, otherwise in nanometres.
    encoder_mm : where a foreign axis stands at a time, when the scanner reads the encoder of one and has no stage of
        its own: each line is then measured when the axis has come to its place, to a count, and not when it is due.
    first_sequence, first_line : where the counters of the first boot begin.
    """

    def __init__(
        self,
        info: DeviceInfo,
        scene_line: SceneLine,
        *,
        rng: np.random.Generator,
        max_line_rate_hz: float = 4000.0,
        travel_mm: tuple[float, float] = (-math.inf, math.inf),
        buffer_bytes: int = 32_768,
        encoder_mm_per_count: float = 0.0,
        encoder_mm: Callable[[float], float] | None = None,
        dead_man_s: float = DEAD_MAN_S,
        first_sequence: int = 0,
        first_line: int = 0,
    ) -> None:
        self._scene_line = scene_line
        self._rng = rng
        self._max_line_rate_hz = max_line_rate_hz
        self._travel_mm = travel_mm
        self._buffer_bytes = buffer_bytes
        self._encoder_mm_per_count = encoder_mm_per_count
        self._encoder_mm = encoder_mm
        self._dead_man_s = dead_man_s
        self._laser = tuple(round(float(mm) * TENTH_UM_PER_MM) for mm in info.geometry.laser_mm)
        self._boot(info, first_sequence, first_line)

    def _boot(self, info: DeviceInfo, sequence: int, line: int) -> None:
        self._info = info
        self._decoder = Decoder(from_host=True)
        self._next_sequence = sequence
        self._next_line = line
        self._dropped_chunks = self._dropped_lines = 0
        self._laser_on = False
        self._pass: _Pass | None = None
        self._pass_index = 0
        self._end_reason = EndReason.NONE
        self._unseen_end_s: float | None = None  # when the end of the last pass is to be sent again
        self._heard_s = -math.inf
        self._last_answer: tuple[FromHost, AckStatus] | None = None  # so that a repeated command is not done twice
        self._on_wire = bytearray()
        self._answers: deque[tuple[FromHost | None, AckStatus]] = deque([(None, AckStatus.OK)])
        self._queue: deque[_Queued] = deque()
        self._queued_bytes = 0

    @property
    def boot_id(self) -> int:
        """The present boot's id."""
        return self._info.boot_id

    @property
    def laser_on(self) -> bool:
        """True while the laser shines."""
        return self._laser_on

    @property
    def streaming(self) -> bool:
        """True while a pass is running."""
        return self._pass is not None

    @property
    def status(self) -> Status:
        """State and totals as of the next byte that goes on the wire between two frames."""
        first = next((item.chunk for item in self._queue if item.chunk is not None), None)
        return Status(
            self.boot_id,
            self._laser_on,
            self.streaming,
            self._end_reason,
            self._pass_index,
            first.sequence if first else self._next_sequence,
            first.line_index if first else self._next_line,
            first.dropped_chunks if first else self._dropped_chunks,
            first.dropped_lines if first else self._dropped_lines,
        )

    def reboot(self) -> None:
        """Start anew, as after a power cut: another boot id, counters at zero, laser off, buffers lost."""
        boot_id = self.boot_id
        while boot_id == self.boot_id:
            boot_id = int(self._rng.integers(0, 2**32))
        self._boot(replace(self._info, boot_id=boot_id), 0, 0)

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes from the host; what does not check is passed over."""
        self._watch(now_s)
        for item in self._decoder.receive(data):
            if isinstance(item, HelloRequest | Start | Stop | Laser | Keepalive | EndSeen):
                self._heard_s = now_s
                self._obey(item, now_s)

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        """Return at most `room_bytes` bytes of what there is to send by now."""
        self._watch(now_s)
        for _ in range(_LINES_AT_ONCE):
            self._fill(room_bytes)
            if self._pass is None or not self._is_due(self._pass, now_s):
                break
            if self._encoder_mm is not None:
                self._pass.passed_s = now_s
            self._measure(self._pass)
        if self._unseen_end_s is not None and now_s >= self._unseen_end_s and not self._queue:
            self._queue_end(now_s)
        self._fill(room_bytes)
        sent = bytes(self._on_wire[:room_bytes])
        del self._on_wire[:room_bytes]
        return sent

    def next_due_s(self, now_s: float) -> float | None:
        """Return when there is next something to do: now while bytes wait; None: not before something is received."""
        self._watch(now_s)
        if self._on_wire or self._answers or self._queue:
            return now_s
        due = []
        if self._pass is not None:
            next_s = self._pass.due_s if self._encoder_mm is None else now_s + _ENCODER_LOOK_S
            due.append(max(now_s, next_s))
        if self._unseen_end_s is not None:
            due.append(max(now_s, self._unseen_end_s))
        if self._laser_on or self.streaming:
            due.append(self._heard_s + self._dead_man_s)
        return min(due, default=None)

    def _watch(self, now_s: float) -> None:
        """The dead-man: laser and stage stop when the host has been silent for too long."""
        if (self._laser_on or self.streaming) and now_s - self._heard_s >= self._dead_man_s:
            self._end_pass(EndReason.DEAD_MAN, now_s)
            self._laser_on = False

    def _obey(self, command: FromHost, now_s: float) -> None:
        if isinstance(command, EndSeen):
            if command.pass_index == self._pass_index:
                self._unseen_end_s = None
            return
        if isinstance(command, HelloRequest | Keepalive):
            self._answers.append((command, AckStatus.OK))
            return
        if self._last_answer is not None and self._last_answer[0] == command:
            self._answers.append((command, self._last_answer[1]))
            return
        result = AckStatus.OK
        match command:
            case Start():
                result = self._start(command, now_s)
            case Stop():
                self._end_pass(EndReason.STOPPED, now_s)
                self._laser_on = False
            case Laser(_, on):
                if not on:
                    self._end_pass(EndReason.STOPPED, now_s)
                self._laser_on = on
        self._last_answer = (command, result)
        self._answers.append((command, result))

    def _start(self, command: Start, now_s: float) -> AckStatus:
        if self._pass is not None or any(item.chunk is None for item in self._queue):
            return AckStatus.BUSY
        if not self._laser_on:
            return AckStatus.LASER_OFF
        lowest_mm, highest_mm = self._travel_mm
        inside = all(lowest_mm <= nm / NM_PER_MM <= highest_mm for nm in (command.start_nm, command.end_nm))
        rate_hz = command.line_rate_mhz / 1000
        if not inside or command.line_spacing_nm <= 0 or not 0 < rate_hz <= self._max_line_rate_hz:
            return AckStatus.BAD_VALUE
        travel_nm = command.end_nm - command.start_nm
        n_lines = abs(travel_nm) // command.line_spacing_nm + 1
        step_nm = command.line_spacing_nm if travel_nm >= 0 else -command.line_spacing_nm
        self._pass_index = (self._pass_index + 1) & _U32
        self._end_reason = EndReason.NONE
        self._unseen_end_s = None
        self._pass = _Pass(self._pass_index, now_s, rate_hz, command.start_nm, step_nm, n_lines)
        return AckStatus.OK

    def _end_pass(self, reason: EndReason, now_s: float) -> None:
        if self._pass is None:
            return
        self._pass = None
        self._laser_on = False
        self._end_reason = reason
        self._queue_end(now_s)

    def _queue_end(self, now_s: float) -> None:
        """The end goes behind the last chunk, and will be repeated until the host has seen it."""
        self._queue.append(_Queued(b"", None))
        self._unseen_end_s = now_s + END_REPEAT_S

    def _is_due(self, running: _Pass, now_s: float) -> bool:
        """Whether the next line is to be measured: by the clock, or by how far the axis has come."""
        if self._encoder_mm is None:
            return running.due_s <= now_s
        ahead_mm = self._encoder_mm(now_s) - running.place_nm / NM_PER_MM
        return math.copysign(1.0, running.step_nm) * ahead_mm >= -self._encoder_mm_per_count

    def _measure(self, running: _Pass) -> None:
        """Measure the line that is due, and queue its chunks as far as they fit."""
        due_s = running.due_s
        stage_nm = running.place_nm
        # Rendering a line of which nothing can be kept would only make a late simulator later.
        has_room = self._queued_bytes + 512 <= self._buffer_bytes
        n_points = self._info.points_per_line
        points = self._points(stage_nm) if has_room else np.full((n_points, 2), NO_RETURN, dtype=np.int32)
        step_nm = running.step_nm if running.done_lines else UNKNOWN_NM
        counts = self._encoder_mm_per_count > 0
        position = round(stage_nm / NM_PER_MM / self._encoder_mm_per_count) if counts else stage_nm
        kept = 0
        dropped_lines = self._dropped_lines
        for first in range(0, n_points, MAX_POINTS_PER_CHUNK):
            chunk = Chunk(
                self.boot_id,
                self._next_sequence,
                running.index,
                self._next_line,
                round(due_s * 1e6),
                PositionKind.ENCODER_COUNT if counts else PositionKind.STAGE_NM,
                position,
                (self._laser[0], self._laser[1], self._laser[2]),
                abs(running.step_nm),
                step_nm,
                self._dropped_chunks,
                dropped_lines,
                n_points,
                first,
                points[first : first + MAX_POINTS_PER_CHUNK],
            )
            frame = encode(chunk)
            if has_room and self._queued_bytes + len(frame) <= self._buffer_bytes:
                self._queue.append(_Queued(frame, chunk))
                self._queued_bytes += len(frame)
                kept += 1
            else:
                self._dropped_chunks = (self._dropped_chunks + 1) & _U32
            self._next_sequence = (self._next_sequence + 1) & _U32
        self._dropped_lines = (self._dropped_lines + (kept == 0)) & _U32
        self._next_line = (self._next_line + 1) & _U32
        running.done_lines += 1
        if running.done_lines == running.n_lines:
            self._end_pass(EndReason.REACHED_END, due_s)

    def _points(self, stage_nm: int) -> npt.NDArray[np.int32]:
        """Return what the sensor sees as the wire has it: (n, 2) tenths of a micrometre."""
        x_mm, z_mm = self._scene_line(stage_nm / NM_PER_MM)
        xz = np.stack([x_mm, z_mm], axis=1)
        if xz.shape != (self._info.points_per_line, 2):
            raise ValueError(f"the scene gave {xz.shape[0]} points for a line of {self._info.points_per_line}")
        with np.errstate(invalid="ignore"):
            scaled = np.rint(xz * TENTH_UM_PER_MM)
            seen = np.abs(scaled) <= _POINT_LIMIT  # False for NaN, too
        return np.where(seen.all(axis=1, keepdims=True), scaled, NO_RETURN).astype(np.int32)

    def _fill(self, room_bytes: int) -> None:
        """Put whole frames on the wire until there are `room_bytes`; answers go before lines."""
        while len(self._on_wire) < room_bytes:
            if self._answers:
                self._on_wire += self._answer(*self._answers.popleft())
            elif self._queue:
                item = self._queue.popleft()
                self._queued_bytes -= len(item.frame)
                self._on_wire += item.frame if item.chunk is not None else encode(EndOfPass(self.status))
            else:
                return

    def _answer(self, command: FromHost | None, result: AckStatus) -> bytes:
        if command is None or isinstance(command, HelloRequest):
            command_id = 0 if command is None else command.command_id
            return encode(Hello(command_id, self._info, self._encoder_mm_per_count, self._dead_man_s, self.status))
        kind = _COMMAND_TYPES.get(type(command), Type.KEEPALIVE)
        return encode(Ack(command.command_id, kind, result, self.status))
