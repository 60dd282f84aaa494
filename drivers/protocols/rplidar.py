"""The serial protocol of Slamtec's RPLIDARs, both halves of the wire: requests, descriptors, samples, capsules.

It decides nothing: `rplidar_host.py` has the manners. Everything is little endian. A standard sample has no check worth
the name (three bits), an express capsule an eight-bit exclusive-or; neither has a number.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum
from functools import reduce
from operator import xor
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from drivers.protocols.framing import Damage, DamageReason
from drivers.protocols.rplidar_ultra import ULTRA_BYTES, Following, UltraCapsule, read_ultra
from drivers.scanline import Float64Array

START = 0xA5
DESCRIPTOR_START = b"\xa5\x5a"
DESCRIPTOR_BYTES = 7
SAMPLE_BYTES = 5
CAPSULE_BYTES = 84
CABINS = 16
EXPRESS_SAMPLES = 32
DENSE_SAMPLES = 40
SURE_SAMPLES = 4
"""Good samples in a row by which a lost stream is taken to be found again: one alone is good by chance in 8."""
MAX_REPLY_BYTES = 512


class Command(IntEnum):
    """What a host may ask; from 80h on a request carries a payload."""

    SCAN = 0x20
    FORCE_SCAN = 0x21
    STOP = 0x25
    RESET = 0x40
    GET_INFO = 0x50
    GET_HEALTH = 0x52
    GET_SAMPLERATE = 0x59
    EXPRESS_SCAN = 0x82
    GET_LIDAR_CONF = 0x84
    SET_MOTOR_RPM = 0xA8
    SET_MOTOR_PWM = 0xF0


class Answer(IntEnum):
    """Type of what follows a descriptor."""

    INFO = 0x04
    HEALTH = 0x06
    SAMPLERATE = 0x15
    CONF = 0x20
    STANDARD = 0x81
    EXPRESS = 0x82
    ULTRA = 0x84
    DENSE = 0x85


class Conf(IntEnum):
    """What GET_LIDAR_CONF may be asked for."""

    DESIRED_TURNS = 0x01
    MODE_COUNT = 0x70
    US_PER_SAMPLE = 0x71
    MAX_DISTANCE = 0x74
    ANSWER_TYPE = 0x75
    TYPICAL_MODE = 0x7C
    NAME = 0x7F


LENGTHS = {
    Answer.INFO: 20,
    Answer.HEALTH: 3,
    Answer.SAMPLERATE: 4,
    Answer.STANDARD: SAMPLE_BYTES,
    Answer.EXPRESS: CAPSULE_BYTES,
    Answer.DENSE: CAPSULE_BYTES,
    Answer.ULTRA: ULTRA_BYTES,
}
STREAMS = (Answer.STANDARD, Answer.EXPRESS, Answer.DENSE, Answer.ULTRA)


def request(command: int, payload: bytes = b"") -> bytes:
    """Return a request; with a payload its size and the exclusive-or of all bytes before are added."""
    if command < 0x80:
        return bytes([START, command])
    body = bytes([START, command, len(payload)]) + payload
    return body + bytes([reduce(xor, body)])


def conf_request(what: int, mode: int | None = None) -> bytes:
    """Return a GET_LIDAR_CONF, of one mode where `what` is a mode's."""
    return request(Command.GET_LIDAR_CONF, struct.pack("<I", what) + (b"" if mode is None else struct.pack("<H", mode)))


def descriptor(kind: int, length: int, *, many: bool) -> bytes:
    """Return the descriptor of an answer: one packet of `length` bytes, or many of them."""
    return DESCRIPTOR_START + struct.pack("<IB", length | many << 30, kind)


class Descriptor(NamedTuple):
    """What is to come: packets of `length` bytes, one or many."""

    kind: int
    length: int
    many: bool


@dataclass(frozen=True, slots=True)
class Packet:
    """A single answer's content."""

    kind: int
    data: bytes


class Sample(NamedTuple):
    """One standard sample: clockwise angle in 1/64 degree, distance in 1/4 mm (0: nothing came back)."""

    starts_turn: bool
    quality: int
    angle_q6: int
    distance_q2: int


@dataclass(frozen=True, slots=True)
class Capsule:
    """Many samples of one express packet, whose angles need the start of the next.

    `start_q6` is its first clockwise angle in 1/64 degree, `distance_mm` (n,) 0 where nothing came back, `offset_q3`
    (n,) what each angle is to be lessened by, in 1/8 degree. `is_first` says that the stream has just begun.
    """

    kind: int
    start_q6: int
    is_first: bool
    distance_mm: Float64Array
    offset_q3: npt.NDArray[np.int64]

    @property
    def n_samples(self) -> int:
        """How many samples it holds."""
        return len(self.distance_mm)

    @property
    def first_code(self) -> int:
        """None of its distances is told by the next capsule."""
        return 0

    def samples(self, following: Following) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Clockwise angles (n,) in degrees, 0 to 360, distances in mm, and the angles by which turns are told apart."""
        n = len(self.distance_mm)
        span_deg = (following.start_q6 - self.start_q6) / 64 % 360
        angles_deg = np.asarray((self.start_q6 / 64 + np.arange(n) * span_deg / n - self.offset_q3 / 8) % 360)
        return angles_deg, self.distance_mm, angles_deg


AnyCapsule: TypeAlias = Capsule | UltraCapsule


def sample_bytes(sample: Sample) -> bytes:
    """Return a standard sample as it goes on the wire."""
    starts = 1 if sample.starts_turn else 2
    return struct.pack("<BHH", sample.quality << 2 | starts, sample.angle_q6 << 1 | 1, sample.distance_q2)


def capsule_bytes(capsule: Capsule) -> bytes:
    """Return an express or dense capsule as it goes on the wire."""
    distances = capsule.distance_mm.astype(np.int64)
    if capsule.kind == Answer.DENSE:
        content = distances.astype("<u2").tobytes()
    else:
        offsets = capsule.offset_q3 & 0x3F
        words = (distances << 2 | offsets >> 4).reshape(CABINS, 2)
        low = offsets.reshape(CABINS, 2) & 0xF
        content = b"".join(
            struct.pack("<HHB", first, second, one | other << 4)
            for (first, second), (one, other) in zip(words.tolist(), low.tolist(), strict=True)
        )
    body = struct.pack("<H", capsule.start_q6 | capsule.is_first << 15) + content
    check = reduce(xor, body)
    return bytes([0xA0 | check & 0xF, 0x50 | check >> 4]) + body


def is_sample(data: bytes | bytearray) -> bool:
    """True when five bytes can be a standard sample; so can one in eight of any five bytes."""
    return (data[0] ^ data[0] >> 1) & 1 == 1 and data[1] & 1 == 1


def read_sample(data: bytes | bytearray) -> Sample:
    """Return the sample in five bytes that can be one."""
    flags, angle, distance = struct.unpack("<BHH", data)
    return Sample(bool(flags & 1), flags >> 2, angle >> 1, distance)


def is_capsule(data: bytes | bytearray) -> bool:
    """True when these bytes, as many as a capsule has, are an intact one."""
    if data[0] >> 4 != 0xA or data[1] >> 4 != 0x5:
        return False
    return reduce(xor, data[2:]) == (data[0] & 0xF | (data[1] & 0xF) << 4)


def read_capsule(data: bytes | bytearray, kind: int, *, signed_offsets: bool = False) -> Capsule:
    """Return the content of an intact capsule.

    The published readers disagree on the six bits of an offset: a plain number, or a sign and five bits. The plain one
    is the manufacturer's own.
    """
    (start,) = struct.unpack_from("<H", data, 2)
    if kind == Answer.DENSE:
        distances = np.frombuffer(bytes(data[4:]), dtype="<u2").astype(np.float64)
        return Capsule(kind, start & 0x7FFF, bool(start >> 15), distances, np.zeros(DENSE_SAMPLES, dtype=np.int64))
    cabins = np.frombuffer(bytes(data[4:]), dtype=[("words", "<u2", 2), ("low", "u1")])
    words = cabins["words"].astype(np.int64)
    low = np.stack([cabins["low"] & 0xF, cabins["low"] >> 4], axis=1).astype(np.int64)
    offsets = ((words & 3) << 4 | low).reshape(-1)
    if signed_offsets:
        offsets = np.where(offsets & 0x20, -(offsets & 0x1F), offsets & 0x1F)
    return Capsule(kind, start & 0x7FFF, bool(start >> 15), (words >> 2).reshape(-1).astype(np.float64), offsets)


Heard: TypeAlias = Descriptor | Packet | Sample | AnyCapsule | Damage


class AnswerDecoder:
    """Bytes from a lidar in, descriptors, packets, samples, capsules and damage out; keeps at most 512 bytes.

    `expect` is to be called with each request: what comes is then no stream any more until a descriptor of that kind
    says so. At any time: bytes received = `accepted_bytes` + bytes of damage + `pending_bytes`.
    """

    def __init__(self, *, signed_offsets: bool = False) -> None:
        self._buffer = bytearray()
        self._signed_offsets = signed_offsets
        self._expected: Descriptor | None = None
        self._wanted_kind: int | None = None
        self._skipped_bytes = 0
        self._is_sure = True
        self.accepted_bytes = 0

    @property
    def pending_bytes(self) -> int:
        """Bytes received of which nothing can be said yet."""
        return len(self._buffer) + self._skipped_bytes

    def expect(self, kind: int) -> None:
        """A request was sent: the next thing to understand is a descriptor of `kind`; what came before is none."""
        self._expected = None
        self._wanted_kind = kind
        self._skip(len(self._buffer))

    def reset(self) -> int:
        """Forget what has begun; return how many bytes that were."""
        n_bytes = self.pending_bytes
        self._buffer.clear()
        self._skipped_bytes = 0
        self._expected = self._wanted_kind = None
        return n_bytes

    def receive(self, data: bytes) -> list[Heard]:
        """Take the next bytes; return what they complete."""
        found: list[Heard] = []
        self._buffer += data
        while True:
            expected = self._expected
            if expected is None:
                more = self._find_descriptor(found)
            elif not expected.many:
                more = self._take_packet(expected, found)
            elif expected.kind == Answer.STANDARD:
                more = self._take_sample(found)
            else:
                more = self._take_capsule(expected, found)
            if not more:
                return found

    def _skip(self, n_bytes: int) -> None:
        del self._buffer[:n_bytes]
        self._skipped_bytes += n_bytes
        self._is_sure = False

    def _accept(self, n_bytes: int, found: list[Heard]) -> bytes:
        if self._skipped_bytes:
            found.append(Damage(DamageReason.DEBRIS, self._skipped_bytes))
            self._skipped_bytes = 0
        data = bytes(self._buffer[:n_bytes])
        del self._buffer[:n_bytes]
        self.accepted_bytes += n_bytes
        return data

    def _find_descriptor(self, found: list[Heard]) -> bool:
        at = self._buffer.find(DESCRIPTOR_START)
        if at < 0:
            at = len(self._buffer) - self._buffer.endswith(DESCRIPTOR_START[:1])
        if at:
            self._skip(at)
        if len(self._buffer) < DESCRIPTOR_BYTES:
            return False
        word, kind = struct.unpack_from("<IB", self._buffer, 2)
        length, many = word & 0x3FFFFFFF, word >> 30
        fits = (4 < length <= MAX_REPLY_BYTES) if kind == Answer.CONF else LENGTHS.get(kind) == length
        if not fits or many != (kind in STREAMS) or self._wanted_kind not in (None, kind):
            self._skip(1)
            return True
        self._accept(DESCRIPTOR_BYTES, found)
        self._expected = Descriptor(kind, length, bool(many))
        self._is_sure = True
        found.append(self._expected)
        return True

    def _take_packet(self, expected: Descriptor, found: list[Heard]) -> bool:
        if len(self._buffer) < expected.length:
            return False
        found.append(Packet(expected.kind, self._accept(expected.length, found)))
        self._expected = None
        return True

    def _take_sample(self, found: list[Heard]) -> bool:
        wanted = 1 if self._is_sure else SURE_SAMPLES
        buffer = self._buffer
        for k in range(wanted):
            at = k * SAMPLE_BYTES
            if len(buffer) < at + SAMPLE_BYTES:
                return False
            if not is_sample(buffer[at : at + SAMPLE_BYTES]):
                self._skip(1)
                return True
        for _ in range(wanted):
            sample = read_sample(self._accept(SAMPLE_BYTES, found))
            found.append(sample)
        self._is_sure = True
        return True

    def _take_capsule(self, expected: Descriptor, found: list[Heard]) -> bool:
        if len(self._buffer) < expected.length:
            return False
        if self._buffer[0] >> 4 != 0xA or not is_capsule(self._buffer[: expected.length]):
            self._skip(1)
            return True
        data = self._accept(expected.length, found)
        if expected.kind == Answer.ULTRA:
            found.append(read_ultra(data))
        else:
            found.append(read_capsule(data, expected.kind, signed_offsets=self._signed_offsets))
        return True


class RequestDecoder:
    """The device's ear: bytes from a host in, (command, payload) out; a request whose sum is wrong is passed over."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def receive(self, data: bytes) -> list[tuple[int, bytes]]:
        """Take the next bytes; return the requests that they complete."""
        found: list[tuple[int, bytes]] = []
        self._buffer += data
        while True:
            at = self._buffer.find(START)
            del self._buffer[: at if at >= 0 else len(self._buffer)]
            if len(self._buffer) < 2:
                return found
            command = self._buffer[1]
            if command < 0x80:
                del self._buffer[:2]
                found.append((command, b""))
                continue
            if len(self._buffer) < 3 or len(self._buffer) < 4 + self._buffer[2]:
                return found
            end = 4 + self._buffer[2]
            whole = bytes(self._buffer[:end])
            if reduce(xor, whole):
                del self._buffer[:1]
                continue
            del self._buffer[:end]
            found.append((command, whole[3:-1]))
