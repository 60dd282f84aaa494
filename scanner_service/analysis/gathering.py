"""Fetching the points around a cell into a buffer for the kernels; judges nothing."""

import math

import numpy as np
from numba import njit

from scanner_service.analysis.around import AROUND_COUNT, AROUND_MASK, AROUND_NEAR, RINGS, lowest_bit
from scanner_service.analysis.grid import CHUNK, LINE, ROW, X, Y, Z
from scanner_service.analysis.intake import QUANTUM_MM

VECTOR = 16
"""The candidates are padded to a multiple of this, so that vector registers run full."""

_FAR = 1e15


@njit(cache=True, nogil=True, error_model="numpy")
def rings_for(radius_mm, side_q):
    """How many cells far a point with this radius looks; more than RINGS are never needed."""
    return min(RINGS, math.ceil((radius_mm / QUANTUM_MM + 1.0) / side_q))


@njit(cache=True, nogil=True, error_model="numpy")
def gather(block_near, block_filled, block_cell, cell_first, cell_count, chunk_next, chunk, block, place, rings, buffer):
    """Copy x, y, z and line of every point in the cells up to `rings` away, and pad.

    Returns the buffer (4, N), a larger one if need be, and how many points it holds.
    """
    n = np.int64(0)
    room = buffer.shape[1] - VECTOR
    for k in range(AROUND_COUNT[rings, place]):
        other = np.int64(block_near[block, AROUND_NEAR[rings, place, k]])
        if other < 0:
            continue
        mask = block_filled[other] & AROUND_MASK[rings, place, k]
        while mask != np.uint64(0):
            cell = np.int64(block_cell[other, lowest_bit(mask)])
            mask &= mask - np.uint64(1)
            left = np.int64(cell_count[cell])
            if n + left > room:
                buffer = _enlarged(buffer, n, n + left)
                room = buffer.shape[1] - VECTOR
            here = np.int64(cell_first[cell])
            while True:
                for at in range(CHUNK):  # a whole chunk at once: what is beyond its end is overwritten or padded
                    buffer[0, n + at] = chunk[here, X, at]
                    buffer[1, n + at] = chunk[here, Y, at]
                    buffer[2, n + at] = chunk[here, Z, at]
                    buffer[3, n + at] = chunk[here, LINE, at]
                n += min(left, CHUNK)
                left -= CHUNK
                if left <= 0:
                    break
                here = np.int64(chunk_next[here])
    for at in range(VECTOR):
        buffer[0, n + at] = _FAR
        buffer[1, n + at], buffer[2, n + at], buffer[3, n + at] = 0.0, 0.0, 0.0
    return buffer, n


@njit(cache=True, nogil=True, error_model="numpy")
def _enlarged(buffer, used, wanted):
    """A buffer with room for twice what is wanted, holding what was used."""
    larger = np.empty((4, 2 * wanted + VECTOR))
    larger[:, :used] = buffer[:, :used]
    return larger


@njit(cache=True, nogil=True, error_model="numpy")
def gather_from(grid, block, place, rings, buffer):
    """The same as `gather`, for those who do it now and then."""
    return gather(
        grid.block_near, grid.block_filled, grid.block_cell, grid.cell_first, grid.cell_count,
        grid.chunk_next, grid.chunk, block, place, rings, buffer,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def has_fresh(block_near, block_fresh, block, place, rings):
    """True when a cell up to `rings` away is fresh."""
    for k in range(AROUND_COUNT[rings, place]):
        other = np.int64(block_near[block, AROUND_NEAR[rings, place, k]])
        if other >= 0 and block_fresh[other] & AROUND_MASK[rings, place, k] != np.uint64(0):
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def gather_fresh(
    block_near, block_fresh, block_cell, cell_first, cell_count, chunk_next, chunk,
    block, place, rings, first_new, fresh,
):  # fmt: skip
    """Copy the coordinates of the new points in the fresh cells up to `rings` away, and pad, as `gather` does."""
    n = np.int64(0)
    for k in range(AROUND_COUNT[rings, place]):
        other = np.int64(block_near[block, AROUND_NEAR[rings, place, k]])
        if other < 0:
            continue
        mask = block_fresh[other] & AROUND_MASK[rings, place, k]
        while mask != np.uint64(0):
            cell = np.int64(block_cell[other, lowest_bit(mask)])
            mask &= mask - np.uint64(1)
            here = np.int64(cell_first[cell])
            left = np.int64(cell_count[cell])
            if n + left + VECTOR > fresh.shape[1]:
                fresh = _enlarged(fresh, n, n + left)
            while left > 0:
                for at in range(min(left, CHUNK)):
                    if chunk[here, ROW, at] >= first_new:
                        fresh[0, n] = chunk[here, X, at]
                        fresh[1, n] = chunk[here, Y, at]
                        fresh[2, n] = chunk[here, Z, at]
                        n += 1
                left -= CHUNK
                here = np.int64(chunk_next[here])
    padded = ((n + VECTOR - 1) // VECTOR) * VECTOR
    for at in range(n, padded):
        fresh[0, at], fresh[1, at], fresh[2, at] = _FAR, 0.0, 0.0
    return fresh, n


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "nsz", "nnan"})
def is_reached(x, y, z, reach, fresh, n_fresh):
    """True when one of the new points lies within a squared distance of (x, y, z)."""
    reached = 0.0
    for k in range(((n_fresh + VECTOR - 1) // VECTOR) * VECTOR):
        dx, dy, dz = fresh[0, k] - x, fresh[1, k] - y, fresh[2, k] - z
        reached += 1.0 if dx * dx + dy * dy + dz * dz <= reach else 0.0
    return reached > 0.0
