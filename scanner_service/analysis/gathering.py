"""Fetching the points around a cell into a buffer for the kernels; judges nothing."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from drivers.scanline import Float64Array
from scanner_service.analysis.around import AROUND_COUNT, AROUND_MASK, AROUND_NEAR, RINGS, lowest_bit
from scanner_service.analysis.grid import CELL, CHUNK, COUNT, FILLED, FIRST, FRESH, NEAR, OLD, X, Y, Z
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.vector_copy import widen_eight

VECTOR = 16
"""The candidates are padded to a multiple of this, so that vector registers run full."""

_FAR = 1e15
_PAGE = 512  # numbers in a page of memory


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def rings_for(radius_mm, side_q):
    """How many cells far a point with this radius looks; more than RINGS are never needed."""
    return min(RINGS, math.ceil((radius_mm / QUANTUM_MM + 1.0) / side_q))


class Scratch(NamedTuple):
    """Buffers of one thread, large enough for the fullest cells, of which only what is touched becomes memory.

    `near`, `wide` and `fresh` (4, N) hold x, y, z and line of points around; `squares` (N,) distances; `kept` (21,)
    sums and fit of one point.
    """

    near: Float64Array
    wide: Float64Array
    fresh: Float64Array
    squares: Float64Array
    kept: Float64Array


def reserve_scratch(cell_limit: int) -> Scratch:
    """Buffers for cells of at most `cell_limit` points."""
    around, far = 27 * cell_limit, (2 * RINGS + 1) ** 3 * cell_limit
    return Scratch(_rows(4, around), _rows(4, far), _rows(4, far), _rows(1, far)[0], np.empty(21))


def _rows(count: int, length: int) -> Float64Array:
    """(count, N) with room for `length` and padding in each row, so placed that vector registers load without a split.

    Rows begin at cache lines, and at different places within a page: the processor takes addresses that differ by
    whole pages for the same when it looks for what was just written.
    """
    stride = -(-(length + 2 * VECTOR) // _PAGE) * _PAGE + _PAGE // 4 + 8
    room = np.empty(count * stride + 8)
    skipped = (-room.ctypes.data % 64) // 8
    rows: Float64Array = room[skipped : skipped + count * stride].reshape(count, stride)
    return rows


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def gather(block, bits, cell, chunk_next, chunk, b, place, rings, buffer):
    """Copy x, y, z and line of every point in the cells up to `rings` away into the buffer (4, N), and pad.

    Returns how many points there are.
    """
    n = np.int64(0)
    for k in range(AROUND_COUNT[rings, place]):
        other = np.int64(block[b, NEAR + AROUND_NEAR[rings, place, k]])
        if other < 0:
            continue
        mask = bits[other, FILLED] & AROUND_MASK[rings, place, k]
        while mask != np.uint64(0):
            c = np.int64(block[other, CELL + lowest_bit(mask)])
            mask &= mask - np.uint64(1)
            here = np.int64(cell[c, FIRST])
            left = np.int64(cell[c, COUNT])
            while True:
                for column in range(4):  # a whole chunk at once: what is beyond its end is overwritten or padded
                    widen_eight(chunk, here, column, buffer, n)
                n += min(left, CHUNK)
                left -= CHUNK
                if left <= 0:
                    break
                here = np.int64(chunk_next[here])
    for at in range(VECTOR):
        buffer[0, n + at] = _FAR
        buffer[1, n + at], buffer[2, n + at], buffer[3, n + at] = 0.0, 0.0, 0.0
    return n


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def has_fresh(block, bits, b, place, rings):
    """True when a cell up to `rings` away is fresh."""
    for k in range(AROUND_COUNT[rings, place]):
        other = np.int64(block[b, NEAR + AROUND_NEAR[rings, place, k]])
        if other >= 0 and bits[other, FRESH] & AROUND_MASK[rings, place, k] != np.uint64(0):
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def gather_fresh(block, bits, cell, chunk_next, chunk, b, place, rings, fresh):
    """Copy the coordinates of what is new in the fresh cells up to `rings` away, and pad, as `gather` does."""
    n = np.int64(0)
    for k in range(AROUND_COUNT[rings, place]):
        other = np.int64(block[b, NEAR + AROUND_NEAR[rings, place, k]])
        if other < 0:
            continue
        mask = bits[other, FRESH] & AROUND_MASK[rings, place, k]
        while mask != np.uint64(0):
            c = np.int64(block[other, CELL + lowest_bit(mask)])
            mask &= mask - np.uint64(1)
            at, end = np.int64(cell[c, OLD]), np.int64(cell[c, COUNT])
            here = np.int64(cell[c, FIRST])
            while at >= CHUNK:
                here = np.int64(chunk_next[here])
                at -= CHUNK
                end -= CHUNK
            while at < end:
                fresh[0, n], fresh[1, n], fresh[2, n] = chunk[here, X, at], chunk[here, Y, at], chunk[here, Z, at]
                n += 1
                at += 1
                if at == CHUNK:
                    here = np.int64(chunk_next[here])
                    at = np.int64(0)
                    end -= CHUNK
    for at in range(VECTOR):
        fresh[0, n + at], fresh[1, n + at], fresh[2, n + at] = _FAR, 0.0, 0.0
    return n


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True, fastmath={"reassoc", "nsz", "nnan"})
def is_reached(x, y, z, reach, fresh, n_fresh):
    """True when one of the new points lies within a squared distance of (x, y, z)."""
    reached = 0.0
    for k in range(((n_fresh + VECTOR - 1) // VECTOR) * VECTOR):
        dx, dy, dz = fresh[0, k] - x, fresh[1, k] - y, fresh[2, k] - z
        reached += 1.0 if dx * dx + dy * dy + dz * dz <= reach else 0.0
    return reached > 0.0
