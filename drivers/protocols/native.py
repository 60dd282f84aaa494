"""The native serial protocol's layouts, both halves of the wire: messages to bytes, bytes to messages; decides nothing.

`docs/protocol.md` is the specification, byte by byte. Everything is little endian. `native_messages.py` holds what the
messages say, `framing.py` frames and checksums, `native_host.py` and the simulator's device the manners.
"""

import struct
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from drivers.protocols.framing import (
    MAX_BODY_BYTES,
    Body,
    Damage,
    DamageReason,
    FrameDecoder,
    frame,
    most_frame_bytes,
)
from drivers.protocols.native_messages import (
    MAX_TEXT_BYTES,
    NM_PER_MM,
    PM_PER_MM,
    PROTOCOL_VERSION,
    TENTH_UM_PER_MM,
    Ack,
    AckStatus,
    Chunk,
    EndOfPass,
    EndReason,
    EndSeen,
    Hello,
    HelloRequest,
    Keepalive,
    Laser,
    Message,
    OtherVersion,
    PositionKind,
    Start,
    Status,
    Stop,
    Type,
)
from drivers.scanline import DeviceInfo, SensorGeometry

_STATUS = struct.Struct("<IBBIIIII")
_HELLO = struct.Struct("<BHHqH3i3i2iI")
_CHUNK = struct.Struct("<IIIIQBq3iqqIIHH")
_RUN = struct.Struct("<II63sH")  # the same bytes, as far as they differ among the chunks of one line
_ACK = struct.Struct("<HBB")
_COMMAND = struct.Struct("<H")
_START = struct.Struct("<HqqqI")
_LASER = struct.Struct("<HB")
_END_SEEN = struct.Struct("<HI")
_POINT_BYTES = 8
MAX_POINTS_PER_CHUNK = (MAX_BODY_BYTES - 1 - _CHUNK.size) // _POINT_BYTES
_LASER_BIT, _STREAMING_BIT = 1, 2


def encode(message: Message) -> bytes:
    """Return `message` as a whole frame, both zeros included.

    Raises
    ------
    struct.error or ValueError : when a field does not fit its place on the wire.
    """
    match message:
        case Hello():
            return frame(bytes([Type.HELLO]) + _hello_payload(message))
        case OtherVersion(version):
            raise ValueError(f"a HELLO of version {version} cannot be written, only read")
        case Chunk():
            return frame(bytes([Type.CHUNK]) + _chunk_payload(message))
        case Ack(command_id, command, result, status):
            return frame(bytes([Type.ACK]) + _ACK.pack(command_id, command, result) + _status_payload(status))
        case EndOfPass(status):
            return frame(bytes([Type.END_OF_PASS]) + _status_payload(status))
        case HelloRequest(command_id):
            return frame(bytes([Type.HELLO_REQUEST]) + _COMMAND.pack(command_id))
        case Start(command_id, spacing, start, end, rate):
            return frame(bytes([Type.START]) + _START.pack(command_id, spacing, start, end, rate))
        case Stop(command_id):
            return frame(bytes([Type.STOP]) + _COMMAND.pack(command_id))
        case Laser(command_id, on):
            return frame(bytes([Type.LASER]) + _LASER.pack(command_id, on))
        case Keepalive(command_id):
            return frame(bytes([Type.KEEPALIVE]) + _COMMAND.pack(command_id))
        case EndSeen(command_id, pass_index):
            return frame(bytes([Type.END_SEEN]) + _END_SEEN.pack(command_id, pass_index))


def line_bytes(n_points: int) -> int:
    """Return the most bytes that a line of so many points takes on the wire."""
    n_chunks = -(-n_points // MAX_POINTS_PER_CHUNK)
    return n_chunks * most_frame_bytes(1 + _CHUNK.size) + n_points * _POINT_BYTES + n_points * _POINT_BYTES // 254


class Decoder:
    """Bytes of one direction in, messages and damage out, in the order of the wire; bounded memory on any input.

    At any time: bytes received = `accepted_bytes` + bytes of damage + `padding_bytes` + `pending_bytes`.
    """

    def __init__(self, *, from_host: bool = False) -> None:
        self._frames = FrameDecoder()
        self._from_host = from_host
        self.accepted_bytes = 0

    @property
    def pending_bytes(self) -> int:
        """Bytes received of which nothing can be said yet."""
        return self._frames.pending_bytes

    @property
    def padding_bytes(self) -> int:
        """Zeros received that belong to no frame."""
        return self._frames.padding_bytes

    def receive(self, data: bytes) -> list[Message | Damage]:
        """Take the next bytes; return what they complete, chunks that continue each other as one."""
        found: list[Message | Damage] = []
        run: _Run | None = None
        for item in self._frames.receive(data):
            if run is not None:
                if isinstance(item, Body) and run.takes(item.data):
                    self.accepted_bytes += item.n_bytes
                    continue
                found[-1] = run.chunk()
            said = self._judge(item)
            found.append(said)
            run = _Run(said) if isinstance(said, Chunk) else None
        if run is not None:
            found[-1] = run.chunk()
        return found

    def reset(self) -> list[Damage]:
        """Forget the frame under way, as after a lost link; return its bytes as damage."""
        return self._frames.reset()

    def _judge(self, item: Body | Damage) -> Message | Damage:
        if isinstance(item, Damage):
            return item
        kind = item.data[0]
        parse = (_FROM_HOST if self._from_host else _FROM_DEVICE).get(kind)
        if parse is None:
            return Damage(DamageReason.UNKNOWN_TYPE, item.n_bytes)
        try:
            message: Message = parse(item.data[1:])
        except (struct.error, ValueError, IndexError):  # UnicodeDecodeError is a ValueError
            return Damage(DamageReason.BAD_LAYOUT, item.n_bytes)
        self.accepted_bytes += item.n_bytes
        return message


class _Run:
    """Chunks of one line that continue each other: numbers and places in a row, and the same header otherwise."""

    def __init__(self, first: Chunk) -> None:
        self._first = first
        self._points: list[bytes] = []
        self._repeated: bytes = _RUN.unpack_from(_chunk_head(first))[2]
        self._next_sequence = (first.sequence + 1) % 2**32
        self._next_point = first.first_point + len(first.points)

    def takes(self, body: bytes) -> bool:
        """Take a frame's body; False, and nothing taken, when it is none of the run."""
        n_bytes = len(body) - 1 - _CHUNK.size
        if n_bytes < _POINT_BYTES or n_bytes % _POINT_BYTES or body[0] != Type.CHUNK:
            return False
        boot_id, sequence, repeated, first_point = _RUN.unpack_from(body, 1)
        next_point = first_point + n_bytes // _POINT_BYTES
        if (
            repeated != self._repeated
            or sequence != self._next_sequence
            or first_point != self._next_point
            or boot_id != self._first.boot_id
            or next_point > self._first.points_in_line
        ):
            return False
        self._points.append(body[1 + _CHUNK.size :])
        self._next_sequence = (sequence + 1) % 2**32
        self._next_point = next_point
        return True

    def chunk(self) -> Chunk:
        """The run as one chunk."""
        first = self._first
        if not self._points:
            return first
        points = np.frombuffer(b"".join((first.points.tobytes(), *self._points)), dtype="<i4").reshape(-1, 2)
        sizes = (len(first.points), *(len(piece) // _POINT_BYTES for piece in self._points))
        return replace(first, points=points, sizes=sizes)


def _status_payload(status: Status) -> bytes:
    flags = _LASER_BIT * status.laser_on | _STREAMING_BIT * status.streaming
    return _STATUS.pack(
        status.boot_id,
        flags,
        status.end_reason,
        status.pass_index,
        status.next_sequence,
        status.next_line,
        status.dropped_chunks,
        status.dropped_lines,
    )


def _status(payload: bytes) -> Status:
    boot_id, flags, end_reason, *counts = _STATUS.unpack(payload)
    if flags & ~(_LASER_BIT | _STREAMING_BIT):
        raise ValueError(f"unknown flags {flags:#04x}")
    return Status(boot_id, bool(flags & _LASER_BIT), bool(flags & _STREAMING_BIT), EndReason(end_reason), *counts)


def _hello_payload(hello: Hello) -> bytes:
    info, geometry = hello.info, hello.info.geometry
    head = _HELLO.pack(
        PROTOCOL_VERSION,
        hello.command_id,
        info.points_per_line,
        round(hello.encoder_mm_per_count * PM_PER_MM),
        round(hello.dead_man_s * 1000),
        *_tenth_um(geometry.laser_mm),
        *_tenth_um(geometry.camera_mm),
        *_tenth_um(np.array(geometry.range_mm)),
        round(geometry.noise_mm * NM_PER_MM),
    )
    texts = [text.encode() for text in (info.device_id, info.model, info.firmware, info.calibration_id)]
    for text in texts:
        if len(text) > MAX_TEXT_BYTES:
            raise ValueError(f"a text in HELLO has at most {MAX_TEXT_BYTES} bytes of UTF-8, not {len(text)}")
    return head + _status_payload(hello.status) + b"".join(bytes([len(text)]) + text for text in texts)


def _hello(payload: bytes) -> Hello | OtherVersion:
    if payload[:1] != bytes([PROTOCOL_VERSION]):
        return OtherVersion(payload[0])
    _version, command_id, points, pm_per_count, dead_man_ms, *optics = _HELLO.unpack_from(payload)
    laser, camera, span, noise_nm = optics[0:3], optics[3:6], optics[6:8], optics[8]
    at = _HELLO.size + _STATUS.size
    status = _status(payload[_HELLO.size : at])
    texts = []
    for _ in range(4):
        length = payload[at] if at < len(payload) else MAX_TEXT_BYTES + 1
        text = payload[at + 1 : at + 1 + length]
        if length > MAX_TEXT_BYTES or len(text) != length:
            raise ValueError("a text is too long, or cut off")
        texts.append(text.decode())
        at += 1 + length
    if at != len(payload) or points < 1:
        raise ValueError("bytes after the last text, or lines without points")
    geometry = SensorGeometry(
        laser_mm=np.array(laser) / TENTH_UM_PER_MM,
        camera_mm=np.array(camera) / TENTH_UM_PER_MM,
        range_mm=(span[0] / TENTH_UM_PER_MM, span[1] / TENTH_UM_PER_MM),
        noise_mm=noise_nm / NM_PER_MM,
    )
    info = DeviceInfo(texts[0], texts[1], texts[2], texts[3], status.boot_id, points, geometry)
    return Hello(command_id, info, pm_per_count / PM_PER_MM, dead_man_ms / 1000, status)


def _tenth_um(lengths_mm: npt.NDArray[np.float64]) -> list[int]:
    return [round(float(length) * TENTH_UM_PER_MM) for length in lengths_mm]


def _chunk_payload(chunk: Chunk) -> bytes:
    points = np.ascontiguousarray(chunk.points, dtype="<i4")
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"a chunk's points have shape (k, 2), not {points.shape}")
    _check_span(chunk.points_in_line, chunk.first_point, len(points))
    return _chunk_head(chunk) + points.tobytes()


def _chunk_head(chunk: Chunk) -> bytes:
    return _CHUNK.pack(
        chunk.boot_id,
        chunk.sequence,
        chunk.pass_index,
        chunk.line_index,
        chunk.device_time_us,
        chunk.position_kind,
        chunk.position,
        *chunk.laser,
        chunk.line_spacing_nm,
        chunk.step_nm,
        chunk.dropped_chunks,
        chunk.dropped_lines,
        chunk.points_in_line,
        chunk.first_point,
    )


def _chunk(payload: bytes) -> Chunk:
    n_bytes = len(payload) - _CHUNK.size
    if n_bytes % _POINT_BYTES:
        raise ValueError("a point is cut off")
    boot, sequence, pass_index, line, time_us, kind, position, *rest = _CHUNK.unpack_from(payload)
    lx, ly, lz, spacing, step, dropped_chunks, dropped_lines, n_line, first = rest
    _check_span(n_line, first, n_bytes // _POINT_BYTES)
    points = np.frombuffer(payload, dtype="<i4", offset=_CHUNK.size).reshape(-1, 2)
    return Chunk(
        boot,
        sequence,
        pass_index,
        line,
        time_us,
        PositionKind(kind),
        position,
        (lx, ly, lz),
        spacing,
        step,
        dropped_chunks,
        dropped_lines,
        n_line,
        first,
        points,
    )


def _check_span(points_in_line: int, first_point: int, n_points: int) -> None:
    if not (1 <= n_points <= MAX_POINTS_PER_CHUNK and first_point + n_points <= points_in_line):
        raise ValueError(f"points {first_point} to {first_point + n_points} do not fit a line of {points_in_line}")


def _ack(payload: bytes) -> Ack:
    command_id, command, result = _ACK.unpack_from(payload)
    return Ack(command_id, command, AckStatus(result), _status(payload[_ACK.size :]))


def _laser(payload: bytes) -> Laser:
    command_id, on = _LASER.unpack(payload)
    if on not in (0, 1):
        raise ValueError(f"the laser is 0 or 1, not {on}")
    return Laser(command_id, bool(on))


_FROM_DEVICE: dict[int, Callable[[bytes], Message]] = {
    Type.HELLO: _hello,
    Type.CHUNK: _chunk,
    Type.ACK: _ack,
    Type.END_OF_PASS: lambda payload: EndOfPass(_status(payload)),
}
_FROM_HOST: dict[int, Callable[[bytes], Message]] = {
    Type.HELLO_REQUEST: lambda payload: HelloRequest(*_COMMAND.unpack(payload)),
    Type.START: lambda payload: Start(*_START.unpack(payload)),
    Type.STOP: lambda payload: Stop(*_COMMAND.unpack(payload)),
    Type.LASER: _laser,
    Type.KEEPALIVE: lambda payload: Keepalive(*_COMMAND.unpack(payload)),
    Type.END_SEEN: lambda payload: EndSeen(*_END_SEEN.unpack(payload)),
}
