"""The serial protocol of SICK's Profiler 2 and Optex FASTUS LS-100, both halves of the wire: frames, reads, profiles.

It decides nothing: `ls100_host.py` has the manners. Facts: SICK 8017035, chapter 8. Frames are the same both ways:
02, length in words of the data, command, data, 03, exclusive-or; everything is big endian.
"""

import struct
from dataclasses import dataclass
from functools import reduce
from operator import xor

import numpy as np

from drivers.protocols.prefixed import PrefixedDecoder
from drivers.scanline import BoolArray, Float64Array

STX, ETX = 0x02, 0x03
MAX_WORDS = 255
_OVERHEAD_BYTES = 6

READ = 0x0002
PROFILE_ADDRESS = 0x400B
SET_SHUTTER, GET_SHUTTER = 0x200E, 0x200F
SET_CAMERA_MODE, GET_CAMERA_MODE = 0x201B, 0x201C

HEADER_WORDS = 4
"""Words in front of a profile's first point."""
POINT_WORDS = 2
MAX_POINTS_PER_READ = 126
_SIZE_PER_POINT = 32
NO_MEASUREMENT = 0x7FFF
COUNTS_PER_MM = 1000.0
TIME_SPAN, TIME_TICK_S = 1 << 16, 1e-4

ERRORS = {
    0xE001: "it does not know the command",
    0xE002: "a parameter is wrong",
    0xE003: "the frame was incomplete",
    0xE004: "the check of the request was wrong",
    0xE005: "a byte's stop bit was missing: the rates differ, or the line is bad",
    0xE006: "its memory failed",
    0xE007: "both sides spoke at once",
    0xE008: "that is not allowed while it measures",
}
TRANSIENT_ERRORS = (0xE003, 0xE004, 0xE005, 0xE007)


def frame(command: int, data: bytes = b"") -> bytes:
    """Return a whole frame; raises ValueError for data of an odd length or of more than 510 bytes."""
    if len(data) % 2 or len(data) > 2 * MAX_WORDS:
        raise ValueError(f"a frame carries 0 to {MAX_WORDS} words, not {len(data)} bytes")
    body = struct.pack(">BH", len(data) // 2, command) + data
    return bytes([STX]) + body + bytes([ETX, reduce(xor, body)])


@dataclass(frozen=True, slots=True)
class Frame:
    """An intact frame; `whole` are all its bytes, by which the echo of an adapter is told from a reply."""

    command: int
    data: bytes
    whole: bytes


class FrameDecoder(PrefixedDecoder[Frame]):
    """Bytes in, frames and damage out, of either direction."""

    def _length(self, buffer: bytearray) -> int | None:
        if buffer[0] != STX:
            return 0
        return None if len(buffer) < 2 else 2 * buffer[1] + _OVERHEAD_BYTES

    def _read(self, whole: bytes) -> Frame | None:
        if whole[-2] != ETX or reduce(xor, whole[1:-2]) != whole[-1]:
            return None
        return Frame(int.from_bytes(whole[2:4], "big"), whole[4:-2], whole)


def read_request(address: int, count: int, words: int, step: int = 1) -> bytes:
    """Return the request to read `count` items of `words` words each, every `step`-th, from `address`.

    Raises
    ------
    ValueError : when the reply would not fit a frame.
    """
    if not (count >= 1 and 1 <= words <= 15 and 1 <= step <= 15 and 2 + count * words <= MAX_WORDS):
        raise ValueError(f"{count} items of {words} words, every {step}th, cannot be read at once")
    return frame(READ, struct.pack(">IBB", address, count, words << 4 | step))


def reads_of_profile(address: int, n_points: int, step: int = 1) -> list[tuple[int, int]]:
    """Return (address, points) of each read that a profile of `n_points` takes when every `step`-th is wanted."""
    wanted = -(-n_points // step)
    first = address + HEADER_WORDS
    return [
        (first + at * step * POINT_WORDS, min(MAX_POINTS_PER_READ, wanted - at))
        for at in range(0, wanted, MAX_POINTS_PER_READ)
    ]


def read_header(data: bytes, *, has_time: bool | None) -> tuple[int, int | None]:
    """Return how many points a profile has, and its time in 0.1 ms when the reply carries one.

    The manual's printed reply shows a time, but its length and its sum fit one without. `has_time` says which of the
    two readings must hold; None takes either, by the length.

    Raises
    ------
    ValueError : when the reply is of neither form, or of the other one.
    """
    forms = {False: 6, True: 8}
    if len(data) not in forms.values() or (has_time is not None and len(data) != forms[has_time]):
        raise ValueError(f"the reply has {len(data)} bytes, which is not the form that was agreed on")
    size = int.from_bytes(data[4:6], "big")
    return size // _SIZE_PER_POINT, int.from_bytes(data[6:8], "big") if len(data) == 8 else None


def header_data(address: int, n_points: int, time: int | None) -> bytes:
    """Return the data of a reply that `read_header` reads."""
    data = struct.pack(">IH", address, n_points * _SIZE_PER_POINT)
    return data if time is None else data + struct.pack(">H", time)


def read_points(data: bytes, n_points: int) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Return x and z (n,) in mm, NaN where nothing was measured, and where that is (n,).

    A reply may be a word longer than the points, as the manual's length of its example says.

    Raises
    ------
    ValueError : when the reply is shorter, or longer.
    """
    if len(data) - 4 - 4 * n_points not in (0, 2):
        raise ValueError(f"{len(data)} bytes do not hold {n_points} points")
    counts = np.frombuffer(data, dtype=">i2", count=2 * n_points, offset=4).reshape(-1, 2)
    nothing = np.asarray((counts == NO_MEASUREMENT).any(axis=1))
    xz_mm = counts.astype(np.float64) / COUNTS_PER_MM
    xz_mm[nothing] = np.nan
    return xz_mm[:, 0].copy(), xz_mm[:, 1].copy(), nothing
