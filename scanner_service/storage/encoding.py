"""A stored line as bytes and back, bit for bit; knows no table, no checksum and no file.

Little endian, no padding (`docs/record.md` has it as a table): a fixed header; the device id; the dropped places by
reason; the index, as runs of consecutive places or raw, whichever is shorter; the coordinates, in format 1 as they are,
in format 2 packed. Lines are stored in format 2; format 1 is read, and is what the hash of raw lines is made of.
"""

import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from scanner_service.analysis.intake import StoredLine
from scanner_service.storage.errors import LineDamaged, NotStorable
from scanner_service.storage.packing import is_one_run, pack, unpack

PLAIN, PACKED = 1, 2
"""Formats of a line."""

_MAGIC = b"SL"
_INDEX_RAW = 0
_INDEX_RUNS = 1
# magic, version, index coding, boot id, pass, line, time, position, spacing, step, 3 vectors,
# places, points, index words, reasons, bytes of the device id
_HEADER = struct.Struct("<2sBB3q4d72sIIIHH")
_REASON = struct.Struct("<HQ")
_RUN = struct.Struct("<ii")
_LEAST_INT64, _MOST_INT64 = -(2**63), 2**63 - 1
_I4, _F8 = np.dtype("<i4"), np.dtype("<f8")


def encode_line(line: StoredLine, version: int = PACKED) -> bytes:
    """The line as bytes in a format, from which `decode_line` makes the same line, NaN payloads included.

    Raises
    ------
    NotStorable : when a field is not of the type and shape that `StoredLine` states, or an integer does not fit.
    """
    points = _shaped(line.xyz_q, np.int32, (len(line.index), 3), "xyz_q")
    index = _shaped(line.index, np.int32, (len(line.index),), "index")
    vectors = b"".join(
        (
            _shaped(line.laser_mm, np.float64, (3,), "laser_mm").astype(_F8, copy=False).data,
            _shaped(line.plane_normal, np.float64, (3,), "plane_normal").astype(_F8, copy=False).data,
            _shaped(line.travel, np.float64, (3,), "travel").astype(_F8, copy=False).data,
        )
    )
    for name, number in (("boot_id", line.boot_id), ("pass_index", line.pass_index), ("line_index", line.line_index)):
        if not _LEAST_INT64 <= number <= _MOST_INT64:
            raise NotStorable(f"{name} must fit 64 signed bits, not {number}")
    device = _text(line.device_id, "device id")
    coding, words = _encode_index(index)
    try:
        header = _HEADER.pack(
            *(_MAGIC, version, coding, line.boot_id, line.pass_index, line.line_index),
            *(line.device_time_s, line.position_mm, line.line_spacing_mm, line.step_mm, vectors),
            *(line.point_count, len(index), len(words) // 4, len(line.dropped), len(device)),
        )
        reasons = [_reason(reason, count) for reason, count in line.dropped.items()]
    except struct.error as error:
        raise NotStorable(f"line {line.line_index} of {line.device_id} does not fit the record: {error}") from error
    coordinates = points.astype(_I4, copy=False).data if version == PLAIN else pack(points)
    return b"".join((header, device, *reasons, words, coordinates))


def decode_line(encoded: bytes) -> StoredLine:
    """The line that `encode_line` made these bytes from.

    Raises
    ------
    LineDamaged : when the bytes are not a line of a known format. Declared sizes are compared with the length
        before anything is allocated.
    """
    if len(encoded) < _HEADER.size:
        raise LineDamaged(f"{len(encoded)} bytes are too few for a line")
    magic, version, coding, boot_id, pass_index, line_index, *rest = _HEADER.unpack_from(encoded)
    time_s, position_mm, spacing_mm, step_mm, vectors, places, count, words, reasons, device_bytes = rest
    if magic != _MAGIC or version not in (PLAIN, PACKED) or coding not in (_INDEX_RAW, _INDEX_RUNS):
        raise LineDamaged(f"not a line of format {PLAIN} or {PACKED}: {encoded[:4].hex(' ')}")
    place = _HEADER.size + device_bytes
    try:
        device_id = encoded[_HEADER.size : place].decode()
        dropped = {}
        for _ in range(reasons):
            length, number = _REASON.unpack_from(encoded, place)
            place += _REASON.size + length
            dropped[encoded[place - length : place].decode()] = number
    except (UnicodeDecodeError, struct.error) as error:
        raise LineDamaged(f"the text fields of the line are damaged: {error}") from error
    rest_bytes = len(encoded) - place - 4 * words
    if rest_bytes < 0 or (version == PLAIN and rest_bytes != 12 * count):
        raise LineDamaged(f"{len(encoded)} bytes, but the header tells of {place + 4 * words + 12 * count}")
    if version == PLAIN:
        xyz_q = np.frombuffer(encoded, "<i4", 3 * count, place + 4 * words).astype(np.int32).reshape(count, 3)
    else:
        xyz_q = unpack(memoryview(encoded)[place + 4 * words :], count)
    index = _decode_index(coding, np.frombuffer(encoded, "<i4", words, place), count)
    laser_mm, plane_normal, travel = np.frombuffer(vectors, "<f8").astype(np.float64).reshape(3, 3)
    return StoredLine(
        device_id=device_id,
        boot_id=boot_id,
        pass_index=pass_index,
        line_index=line_index,
        device_time_s=time_s,
        xyz_q=xyz_q,
        index=index,
        point_count=places,
        laser_mm=laser_mm,
        plane_normal=plane_normal,
        travel=travel,
        position_mm=position_mm,
        line_spacing_mm=spacing_mm,
        step_mm=step_mm,
        dropped=dropped,
    )


def _encode_index(index: npt.NDArray[np.int32]) -> tuple[int, bytes]:
    """The index as (first, length) of its runs of consecutive places, or as it is where that is shorter."""
    if is_one_run(index):  # nearly every line, and several times faster to tell than to look for runs
        return _INDEX_RUNS, _RUN.pack(index[0], len(index))
    steps = index[1:].astype(np.int64) - index[:-1]
    starts = np.concatenate([np.zeros(min(len(index), 1), dtype=np.int64), np.flatnonzero(steps != 1) + 1])
    if 2 * len(starts) >= len(index):
        return _INDEX_RAW, index.astype(_I4, copy=False).tobytes()
    lengths = np.append(starts[1:], len(index)) - starts
    return _INDEX_RUNS, np.stack((index[starts], lengths), axis=1).astype(_I4).tobytes()


def _decode_index(coding: int, words: npt.NDArray[np.int32], count: int) -> npt.NDArray[np.int32]:
    if coding == _INDEX_RAW:
        if len(words) != count:
            raise LineDamaged(f"{len(words)} places for {count} points")
        return words.astype(np.int32)
    if len(words) % 2:
        raise LineDamaged(f"{len(words)} words cannot be runs of places")
    first, length = words.reshape(-1, 2).astype(np.int64).T
    if (length < 1).any() or int(length.sum()) != count or (first + length > 2**31).any():
        raise LineDamaged(f"the runs of places do not make {count} points")
    before = np.cumsum(length) - length
    return (np.repeat(first - before, length) + np.arange(count)).astype(np.int32)


def _shaped(array: Any, dtype: type[np.generic], shape: tuple[int, ...], name: str) -> npt.NDArray[Any]:
    if array.dtype != dtype or array.shape != shape:
        raise NotStorable(f"{name} must be {dtype.__name__} of shape {shape}, not {array.dtype} of {array.shape}")
    return array if array.flags.c_contiguous else np.ascontiguousarray(array)


def _reason(reason: str, count: int) -> bytes:
    name = _text(reason, "reason")
    return _REASON.pack(len(name), count) + name


def _text(text: str, what: str) -> bytes:
    try:
        return text.encode()
    except UnicodeEncodeError as error:
        raise NotStorable(f"the {what} {text!r} is not text that can be stored: {error.reason}") from error
