"""Ultra capsules of an RPLIDAR (A2M8, A3): 96 samples in 132 bytes, both halves of the wire; decides nothing.

Every third distance is written down, in twelve bits that grow coarser with it; the two behind it are ten-bit steps
from their neighbours. A triangulating lidar looks past its axis, so that the direction of a sample depends on its
distance. Facts: the manufacturer's SDK, which reads the simulated lidar in the tests.
"""

import struct
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Protocol

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array

ULTRA_BYTES = 132
ULTRA_CABINS = 32
ULTRA_SAMPLES = 96
Int64Array = npt.NDArray[np.int64]

_CODES = np.array([0, 512, 1280, 1792, 3328])
_FROM_MM = np.array([0, 512, 2048, 4096, 16_384])
"""From each of these codes on, which is that distance, a code counts one millimetre more, two, four, eight, sixteen."""
_MOST_MM = 16_384 + (4095 - 3328) * 16
_NOTHING = (-512, 511)  # steps that are none: nothing came back
_STEPS = 510
_NEAREST_MM = 50.0
_FAR_DEG, _UNKNOWN_DEG = 8.0, 7.5
_Q16 = 1 << 16


def coded(distance_mm: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Return the twelve bits of whole millimetres, and by how many bits a step there is coarser than one."""
    level = np.searchsorted(_FROM_MM, distance_mm, side="right") - 1
    return _CODES[level] + ((distance_mm - _FROM_MM[level]) >> level), level


def decoded(code: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Return the millimetres of twelve bits, and by how many bits a step there is coarser than one."""
    level = np.searchsorted(_CODES, code, side="right") - 1
    return _FROM_MM[level] + ((code - _CODES[level]) << level), level


def look_aside_deg(distance_mm: Float64Array) -> Float64Array:
    """Return by how much less than the motor has turned a sample at that distance lies, in degrees."""
    quarter_mm = np.maximum(np.rint(distance_mm * 4), 1.0)
    inverse = np.floor(98_361 / quarter_mm)
    far = np.floor(np.radians(_FAR_DEG) * _Q16) - inverse * 64 - np.floor(inverse**3 / 98_304)
    aside = np.where(distance_mm >= _NEAREST_MM, far, np.floor(np.radians(_UNKNOWN_DEG) * _Q16))
    return np.asarray(np.degrees(aside / _Q16))


class Following(Protocol):
    """What a capsule needs to know of the next one."""

    @property
    def start_q6(self) -> int:
        """Its first angle in 1/64 degree."""

    @property
    def first_code(self) -> int:
        """The code of its first distance, 0 in capsules that write all distances down."""


@dataclass(frozen=True, slots=True)
class UltraCapsule:
    """An intact ultra capsule; its last two distances need the first of the next one, its angles the next start.

    `start_q6` is how far the motor had turned in 1/64 degree, `major` (32,), `first` and `second` (32,) what the cabins
    say. `is_first` says that the stream has just begun.
    """

    start_q6: int
    is_first: bool
    major: Int64Array
    first: Int64Array
    second: Int64Array

    @property
    def n_samples(self) -> int:
        """How many samples it holds."""
        return ULTRA_SAMPLES

    @property
    def first_code(self) -> int:
        """The code of its first distance."""
        return int(self.major[0])

    def samples(self, following: Following) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Clockwise angles (96,) in degrees, distances in mm, 0 where nothing came back, and the turn of the motor."""
        here_mm, here_level = decoded(self.major)
        next_mm, next_level = decoded(np.append(self.major[1:], following.first_code))
        is_blind = (here_mm == 0) & (next_mm != 0)
        base_mm, base_level = np.where(is_blind, next_mm, here_mm), np.where(is_blind, next_level, here_level)
        first_mm = np.where(np.isin(self.first, _NOTHING), 0, base_mm + (self.first << base_level))
        second_mm = np.where(np.isin(self.second, _NOTHING), 0, next_mm + (self.second << next_level))
        distance_mm = np.stack([here_mm, first_mm, second_mm], axis=1).reshape(-1).astype(np.float64)
        distance_mm = np.maximum(distance_mm, 0.0)
        span_deg = (following.start_q6 - self.start_q6) / 64 % 360
        turned_deg = self.start_q6 / 64 + np.arange(ULTRA_SAMPLES) * span_deg / ULTRA_SAMPLES
        return (turned_deg - look_aside_deg(distance_mm)) % 360, distance_mm, turned_deg % 360


def ultra_bytes(start_q6: int, distance_mm: Float64Array, following_mm: float, *, is_first: bool) -> bytes:
    """Return a capsule as it goes on the wire; a distance too far from its neighbours for ten bits is none.

    Parameters
    ----------
    distance_mm : (96,) 0 where nothing came back.
    following_mm : the first distance of the next capsule.
    """
    whole = np.minimum(np.rint(distance_mm), _MOST_MM).astype(np.int64).reshape(ULTRA_CABINS, 3)
    majors = np.append(whole[:, 0], min(round(following_mm), _MOST_MM))
    codes, _ = coded(majors)
    here_mm, here_level = decoded(codes[:-1])
    next_mm, next_level = decoded(codes[1:])
    is_blind = (here_mm == 0) & (next_mm != 0)
    base_mm, base_level = np.where(is_blind, next_mm, here_mm), np.where(is_blind, next_level, here_level)
    words = codes[:-1].copy()
    for place, wanted, base, level in ((12, whole[:, 1], base_mm, base_level), (22, whole[:, 2], next_mm, next_level)):
        step = (wanted - base) >> level
        step = np.where((wanted == 0) | (np.abs(step) > _STEPS), _NOTHING[0], step)
        words |= (step & 0x3FF) << place
    body = struct.pack("<H", start_q6 | is_first << 15) + words.astype("<u4").tobytes()
    check = reduce(xor, body)
    return bytes([0xA0 | check & 0xF, 0x50 | check >> 4]) + body


def read_ultra(data: bytes | bytearray) -> UltraCapsule:
    """Return the content of an intact ultra capsule."""
    (start,) = struct.unpack_from("<H", data, 2)
    words = np.frombuffer(bytes(data[4:]), dtype="<u4").astype(np.int64)
    first, second = words >> 12 & 0x3FF, words >> 22
    return UltraCapsule(
        start & 0x7FFF,
        bool(start >> 15),
        words & 0xFFF,
        np.where(first >= 512, first - 1024, first),
        np.where(second >= 512, second - 1024, second),
    )
