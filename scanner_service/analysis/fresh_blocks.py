"""Which blocks of a grid changed since they were evaluated, and which these have reached; puts no point anywhere."""

import numpy as np
from numba import njit

from scanner_service.analysis.around import AROUND_COUNT, AROUND_MASK, AROUND_NEAR, lowest_bit
from scanner_service.analysis.grid import (
    BLOCKS,
    CELL,
    COUNT,
    DOUBLES,
    EVALUATIONS,
    FAR,
    FILLED,
    FRESH,
    FRESH_BLOCKS,
    NEAR,
    NEXT_TO,
    ROUND,
    Grid,
)
from scanner_service.analysis.snapshot import Int32Array


@njit(cache=True, nogil=True)
def mark_all_fresh(grid: Grid) -> None:
    """Mark every cell that holds points."""
    bits, fresh, used = grid.bits, grid.fresh, grid.used
    for b in range(used[BLOCKS]):
        if bits[b, FRESH] == 0 and bits[b, FILLED] != 0:
            fresh[used[FRESH_BLOCKS]] = b
            used[FRESH_BLOCKS] += 1
        bits[b, FRESH] |= bits[b, FILLED]


@njit(cache=True, nogil=True)
def blocks_to_evaluate(grid: Grid) -> Int32Array:
    """The blocks with cells that something fresh may have reached, and in their NEXT_TO bits which cells these are.

    Cells that look farther are found by whoever evaluates the block; a block that has such is listed when it lies next
    to a fresh one.
    """
    used, block, bits, fresh = grid.used, grid.block, grid.bits, grid.fresh
    used[EVALUATIONS] += 1
    listed = np.empty(min(27 * used[FRESH_BLOCKS], used[BLOCKS]), dtype=np.int32)
    n = 0
    for i in range(used[FRESH_BLOCKS]):
        b = np.int64(fresh[i])
        places = bits[b, FRESH]
        while places != np.uint64(0):
            place = lowest_bit(places)
            places &= places - np.uint64(1)
            for k in range(AROUND_COUNT[1, place]):
                other = np.int64(block[b, NEAR + AROUND_NEAR[1, place, k]])
                if other >= 0:
                    bits[other, NEXT_TO] |= AROUND_MASK[1, place, k]
        for near in range(27):
            other = np.int64(block[b, NEAR + near])
            if other < 0 or block[other, ROUND] == used[EVALUATIONS]:
                continue
            if bits[other, NEXT_TO] | bits[other, FAR] != np.uint64(0):
                block[other, ROUND] = used[EVALUATIONS]
                listed[n] = other
                n += 1
    return listed[:n]


@njit(cache=True, nogil=True)
def forget_fresh(grid: Grid) -> None:
    """After an evaluation nothing is fresh."""
    for i in range(grid.used[FRESH_BLOCKS]):
        grid.bits[grid.fresh[i], FRESH] = 0
    grid.used[FRESH_BLOCKS] = 0


@njit(cache=True, nogil=True)
def count_points(blocks: Int32Array, grid: Grid) -> int:
    """How many points the blocks may hold."""
    bits, block, cell = grid.bits, grid.block, grid.cell
    count = np.int64(0)
    for b in blocks:
        places = bits[b, FILLED]
        while places != np.uint64(0):
            count += cell[block[b, CELL + lowest_bit(places)], COUNT]
            places &= places - np.uint64(1)
    return count + grid.used[DOUBLES]
