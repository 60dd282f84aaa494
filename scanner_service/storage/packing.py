"""The coordinates of a line as steps from point to point, in as few bytes as the steps need; knows no line.

Along a line x goes on nearly evenly, y hardly at all, and z by little but for edges. Each column is its first value,
then the steps, each less the smallest of them, in 0, 1, 2 or 4 bytes; a few far steps are put beside. Exact: all is
arithmetic of whole numbers modulo 2**32.
"""

import struct

import numpy as np
import numpy.typing as npt
from numba import njit

from scanner_service.storage.errors import LineDamaged

_HEAD = struct.Struct("<iiBBH")  # first value, smallest step, bytes a step, 0, far steps
_HEAD_BYTES = 12
_FAR = np.dtype([("place", "<u4"), ("step", "<i4")])
_STEPS = {0: None, 1: np.dtype("u1"), 2: np.dtype("<u2"), 4: np.dtype("<u4")}
_MOST_FAR = 65_535


def pack(xyz_q: npt.NDArray[np.int32]) -> memoryview:
    """The coordinates (n, 3) as bytes, of which at least one a point."""
    if len(xyz_q) == 0:
        return memoryview(b"")
    room = np.empty(3 * (_HEAD_BYTES + 4 * len(xyz_q)), dtype=np.uint8)
    return room.data[: _pack(np.ascontiguousarray(xyz_q), room)]


def unpack(packed: memoryview, count: int) -> npt.NDArray[np.int32]:
    """The coordinates (count, 3) that `pack` made these bytes from.

    Raises
    ------
    LineDamaged : when they are not the bytes of so many points; looked at before anything is allocated.
    """
    if count == 0:
        if len(packed):
            raise LineDamaged(f"{len(packed)} bytes of coordinates for no point")
        return np.empty((0, 3), dtype=np.int32)
    if len(packed) < 3 * _HEAD_BYTES:
        raise LineDamaged(f"{len(packed)} bytes are too few for the coordinates of a line")
    heads = [_HEAD.unpack_from(packed, column * _HEAD_BYTES) for column in range(3)]
    if any(width not in _STEPS or zero for _, _, width, zero, _ in heads):
        raise LineDamaged("the coordinates are packed in a way that is not known")
    needed = sum(8 * far + width * (count - 1) for _, _, width, _, far in heads) + 3 * _HEAD_BYTES
    if needed != len(packed) or (count > 1 and not any(width for _, _, width, _, _ in heads)):
        raise LineDamaged(f"{len(packed)} bytes of coordinates, but their heads tell of {needed}")
    xyz_q = np.empty((count, 3), dtype=np.int32)
    place = 3 * _HEAD_BYTES
    for column, (first, smallest, width, _, far) in enumerate(heads):
        jumps = np.frombuffer(packed, _FAR, far, place)
        place += 8 * far
        stored = _STEPS[width]
        if stored is None:
            steps = np.full(count - 1, smallest, dtype=np.int32)
        else:
            steps = np.frombuffer(packed, stored, count - 1, place).astype(np.int32) + np.int32(smallest)
        place += width * (count - 1)
        if far:
            if int(jumps["place"].max()) >= count - 1:
                raise LineDamaged("a far step lies beyond the last point")
            steps[jumps["place"]] = jumps["step"]
        xyz_q[0, column] = first
        np.cumsum(steps, dtype=np.int32, out=xyz_q[1:, column])
        xyz_q[1:, column] += np.int32(first)
    return xyz_q


def is_one_run(index: npt.NDArray[np.int32]) -> bool:
    """True for more than two places (n,) that follow each other."""
    return len(index) > 2 and bool(_is_one_run(index))


def compile_packing() -> None:
    """Compile the kernels, or load them from the cache."""
    pack(np.zeros((2, 3), dtype=np.int32))
    is_one_run(np.arange(3, dtype=np.int32))


@njit(cache=True)
def _is_one_run(index):  # type: ignore[no-untyped-def]
    for place in range(1, len(index)):  # noqa: SIM110 - a kernel takes no generator
        if np.int64(index[place]) - np.int64(index[place - 1]) != 1:
            return False
    return True


@njit(cache=True)  # a few microseconds: giving the interpreter away for them costs more
def _pack(xyz_q, room):  # type: ignore[no-untyped-def]
    """Fill `room` (uint8); returns how many bytes were used. Loops are plain, so that they run on several at once."""
    count = xyz_q.shape[0]
    steps = np.empty(count - 1, dtype=np.int32)
    used = 3 * _HEAD_BYTES
    nothing_yet = True
    for column in range(3):
        for row in range(count - 1):
            steps[row] = xyz_q[row + 1, column] - xyz_q[row, column]
        low = high = steps[0] if count > 1 else np.int32(0)
        for row in range(count - 1):
            low, high = min(low, steps[row]), max(high, steps[row])
        far = 0
        if low < -32768 or high > 32767:
            low, high, far = _near(steps)
        if 8 * far > count or far > _MOST_FAR:
            width, smallest, far = 4, np.int32(0), 0
        else:
            smallest = low
            span = np.int64(high) - np.int64(low)
            width = 0 if span == 0 else 1 if span < 256 else 2
            if column == 2 and nothing_yet and width == 0:
                width = 1  # so that the bytes bound how many points there are
        nothing_yet = nothing_yet and width == 0
        head = column * _HEAD_BYTES
        _put(room, head, xyz_q[0, column], 4)
        _put(room, head + 4, smallest, 4)
        room[head + 8] = width
        room[head + 9] = 0
        _put(room, head + 10, far, 2)
        for row in range(count - 1 if far else 0):
            if steps[row] < -32768 or steps[row] > 32767:
                _put(room, used, row, 4)
                _put(room, used + 4, steps[row], 4)
                used += 8
                steps[row] = smallest
        place = room[used : used + width * (count - 1)]
        used += len(place)
        if width == 1:
            for row in range(count - 1):
                place[row] = np.uint8(steps[row] - smallest)
        elif width == 2:
            for row in range(count - 1):
                step = np.uint16(steps[row] - smallest)
                place[2 * row] = np.uint8(step)
                place[2 * row + 1] = np.uint8(step >> 8)
        elif width == 4:
            for row in range(count - 1):
                _put(place, 4 * row, steps[row], 4)
    return used


@njit(cache=True)
def _near(steps):  # type: ignore[no-untyped-def]
    """The smallest and the largest of the steps that are not far, 0 when all are, and how many are."""
    low, high, far = np.int32(32767), np.int32(-32768), 0
    for step in steps:
        if step < -32768 or step > 32767:
            far += 1
        else:
            low, high = min(low, step), max(high, step)
    if low > high:
        low = high = np.int32(0)
    return low, high, far


@njit(cache=True, inline="always")
def _put(room, place, value, width):  # type: ignore[no-untyped-def]
    whole = np.int64(value)
    for byte in range(width):
        room[place + byte] = (whole >> (8 * byte)) & 255
