"""A sparse grid of cells: a hash table of blocks of 4 x 4 x 4 cells, each cell a chain of chunks of points.

Knows stored coordinates and scanlines, no neighbourhoods. Nothing is ever moved: a cell keeps its number, a point its
place, and memory comes into being as it is touched, so no line waits for a table to grow.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from scanner_service.analysis.around import BLOCK_CELLS, lowest_bit
from scanner_service.analysis.points import PointArray
from scanner_service.analysis.snapshot import Int32Array, UInt8Array

CHUNK = 8
X, Y, Z, LINE, ROW = range(5)
SMALLEST_SIDE_Q = 2048
"""Cells are never smaller than this, so that cell coordinates stay below 2^20."""


class Grid(NamedTuple):
    """The grid's arrays; `*_used` are one-element counters, index -1 means none.

    `hash_block` (2^k,) holds block + 1 or 0; `block_key` (B, 3) block coordinates; `block_near` (B, 27) blocks around;
    `block_cell` (B, 64) the cell at each place. Bits a cell (`around`): `block_filled` (B,) holds points, `block_fresh`
    (B,) got or lost one since the last evaluation, `block_far` (B, 3) has a point that looks at least 2, 3 or 4 cells
    far. `block_laser_q` (B, 2, 3) lowest and highest laser position of the block's points. `fresh` (B,) lists the
    blocks with fresh cells; `block_round` (B,) is the round in which a block was last listed for evaluation. `cell_first`,
    `cell_last` (C,) chunks and `cell_count` (C,) points. `chunk` (K, 5, CHUNK) holds x, y, z, scanline and point row,
    rows ascending along a cell, and `chunk_next` (K,) the chunk behind. `round` counts evaluations.
    """

    side_q: npt.NDArray[np.int64]
    hash_block: Int32Array
    blocks_used: npt.NDArray[np.int64]
    block_key: Int32Array
    block_near: Int32Array
    block_cell: Int32Array
    block_filled: npt.NDArray[np.uint64]
    block_fresh: npt.NDArray[np.uint64]
    block_far: npt.NDArray[np.uint64]
    block_laser_q: npt.NDArray[np.float64]
    block_round: Int32Array
    fresh_used: npt.NDArray[np.int64]
    fresh: Int32Array
    cells_used: npt.NDArray[np.int64]
    cell_first: Int32Array
    cell_last: Int32Array
    cell_count: Int32Array
    chunks_used: npt.NDArray[np.int64]
    chunk_next: Int32Array
    chunk: Int32Array
    round: Int32Array


def cell_side_q(radius_mm: float, quantum_mm: float) -> int:
    """Side of cells in which a radius never reaches beyond the next cell, rounding of cell coordinates included."""
    return max(math.ceil(radius_mm / quantum_mm) + 1, SMALLEST_SIDE_Q)


def reserve_grid(side_q: int, max_points: int) -> Grid:
    """An empty grid with room for `max_points` points in cells of `side_q` quanta."""
    cells = max_points
    blocks = max(1024, max_points // 4)
    hash_size = 1 << (2 * blocks - 1).bit_length()

    def counter() -> npt.NDArray[np.int64]:
        return np.zeros(1, dtype=np.int64)

    return Grid(
        side_q=np.array([side_q], dtype=np.int64),
        hash_block=np.zeros(hash_size, dtype=np.int32),
        blocks_used=counter(),
        block_key=np.empty((blocks, 3), dtype=np.int32),
        block_near=np.empty((blocks, 27), dtype=np.int32),
        block_cell=np.empty((blocks, BLOCK_CELLS), dtype=np.int32),
        block_filled=np.zeros(blocks, dtype=np.uint64),
        block_fresh=np.zeros(blocks, dtype=np.uint64),
        block_far=np.zeros((blocks, 3), dtype=np.uint64),
        block_laser_q=np.empty((blocks, 2, 3), dtype=np.float64),
        block_round=np.zeros(blocks, dtype=np.int32),
        fresh_used=counter(),
        fresh=np.empty(blocks, dtype=np.int32),
        cells_used=counter(),
        cell_first=np.empty(cells, dtype=np.int32),
        cell_last=np.empty(cells, dtype=np.int32),
        cell_count=np.empty(cells, dtype=np.int32),
        chunks_used=counter(),
        chunk_next=np.empty(cells, dtype=np.int32),
        chunk=np.empty((cells, 5, CHUNK), dtype=np.int32),
        round=np.zeros(1, dtype=np.int32),
    )


# The kernels take the arrays they need one by one: an array taken out of a tuple inside a loop costs two atomic
# operations each time, which is more than the work itself.


@njit(cache=True, nogil=True)
def _slot(hash_block, block_key, bx, by, bz):
    """The place of a block in the hash table: its own, or the empty one where it belongs."""
    mask = len(hash_block) - 1
    h = np.uint64(bx) * np.uint64(0x9E3779B97F4A7C15)
    h ^= np.uint64(by) * np.uint64(0xC2B2AE3D27D4EB4F)
    h ^= np.uint64(bz) * np.uint64(0x165667B19E3779F9)
    h ^= h >> np.uint64(29)
    slot = np.int64(h & np.uint64(mask))
    while True:
        block = hash_block[slot] - 1
        if block < 0 or (block_key[block, 0] == bx and block_key[block, 1] == by and block_key[block, 2] == bz):
            return slot
        slot = (slot + 1) & mask


@njit(cache=True, nogil=True)
def _block_at(hash_block, blocks_used, block_key, block_near, block_cell, block_laser_q, bx, by, bz):
    """The block at these block coordinates, made if it is not there; -1 when no block is left."""
    slot = _slot(hash_block, block_key, bx, by, bz)
    block = np.int64(hash_block[slot] - 1)
    if block >= 0:
        return block
    block = blocks_used[0]
    if block >= len(block_key):
        return np.int64(-1)
    blocks_used[0] = block + 1
    hash_block[slot] = block + 1
    block_key[block, 0], block_key[block, 1], block_key[block, 2] = bx, by, bz
    for place in range(BLOCK_CELLS):
        block_cell[block, place] = -1
    for axis in range(3):
        block_laser_q[block, 0, axis], block_laser_q[block, 1, axis] = math.inf, -math.inf
    for near in range(27):
        if near == 13:
            block_near[block, near] = block
            continue
        dx, dy, dz = near // 9 - 1, (near // 3) % 3 - 1, near % 3 - 1
        other = hash_block[_slot(hash_block, block_key, bx + dx, by + dy, bz + dz)] - 1
        block_near[block, near] = other
        if other >= 0:
            block_near[other, 26 - near] = block
    return block


@njit(cache=True, nogil=True)
def place_of(grid: Grid, x: int, y: int, z: int) -> tuple[int, int]:
    """Block, and place in it, of the stored coordinates; block -1 when nothing is there."""
    per_side = 1.0 / grid.side_q[0]
    cx, cy, cz = math.floor(x * per_side), math.floor(y * per_side), math.floor(z * per_side)
    block = grid.hash_block[_slot(grid.hash_block, grid.block_key, cx >> 2, cy >> 2, cz >> 2)] - 1
    return np.int64(block), ((cx & 3) << 4) | ((cy & 3) << 2) | (cz & 3)


@njit(cache=True, nogil=True)
def insert_points(
    grid: Grid,
    points: PointArray,
    first_row: int,
    line: int,
    laser_q: npt.NDArray[np.float64],
    cell_limit: int,
    counted: UInt8Array,
) -> int:
    """Put the points of a line, rows first_row, first_row + 1, ..., into their cells, and mark these as fresh.

    `laser_q` (3,) is the line's laser position. `counted` (k,) comes in as 1 for points to insert and 0 for points to
    pass over, and goes out with 0 where a cell already holds `cell_limit` points. Returns how many points were taken
    in hand; fewer than k means the grid is full.
    """
    hash_block, blocks_used, block_key = grid.hash_block, grid.blocks_used, grid.block_key
    block_near, block_cell, block_laser_q = grid.block_near, grid.block_cell, grid.block_laser_q
    block_filled, block_fresh, fresh, fresh_used = grid.block_filled, grid.block_fresh, grid.fresh, grid.fresh_used
    cells_used, cell_first, cell_last, cell_count = grid.cells_used, grid.cell_first, grid.cell_last, grid.cell_count
    chunks_used, chunk_next, chunk = grid.chunks_used, grid.chunk_next, grid.chunk
    per_side = 1.0 / grid.side_q[0]
    lx, ly, lz = laser_q[0], laser_q[1], laser_q[2]
    cell, block = np.int64(-1), np.int64(-1)
    ax, ay, az = 0, 0, 0
    for i in range(len(counted)):
        if counted[i] == 0:
            continue
        row = first_row + i
        px, py, pz = points[row].x, points[row].y, points[row].z
        x, y, z = math.floor(px * per_side), math.floor(py * per_side), math.floor(pz * per_side)
        if cell < 0 or x != ax or y != ay or z != az:
            if block < 0 or x >> 2 != ax >> 2 or y >> 2 != ay >> 2 or z >> 2 != az >> 2:
                block = _block_at(
                    hash_block, blocks_used, block_key, block_near, block_cell, block_laser_q, x >> 2, y >> 2, z >> 2
                )
                if block < 0:
                    return i
                _stretch(block_laser_q, block, lx, ly, lz)
            place = ((x & 3) << 4) | ((y & 3) << 2) | (z & 3)
            cell = np.int64(block_cell[block, place])
            if cell < 0:
                cell = cells_used[0]
                if cell >= len(cell_first):
                    return i
                cells_used[0] = cell + 1
                block_cell[block, place] = cell
                cell_first[cell] = -1
                cell_last[cell] = -1
                cell_count[cell] = 0
            _mark_fresh(block_fresh, fresh, fresh_used, block, place)
            block_filled[block] |= np.uint64(1) << np.uint64(place)
            ax, ay, az = x, y, z
        count = np.int64(cell_count[cell])
        if count >= cell_limit:
            counted[i] = 0
            continue
        at = count % CHUNK
        last = np.int64(cell_last[cell])
        if at == 0:
            if count == 0 and last >= 0:  # emptied by a removal: its first chunk is free again
                last = np.int64(cell_first[cell])
            elif count > 0 and chunk_next[last] >= 0:  # shortened by a removal
                last = np.int64(chunk_next[last])
            else:
                last = chunks_used[0]
                if last >= len(chunk_next):
                    return i
                chunks_used[0] = last + 1
                chunk_next[last] = -1
                if count == 0:
                    cell_first[cell] = last
                else:
                    chunk_next[cell_last[cell]] = last
            cell_last[cell] = last
        chunk[last, X, at] = px
        chunk[last, Y, at] = py
        chunk[last, Z, at] = pz
        chunk[last, LINE, at] = line
        chunk[last, ROW, at] = row
        cell_count[cell] = count + 1
    return len(counted)


@njit(cache=True, nogil=True)
def _stretch(block_laser_q, block, x, y, z):
    """Widen the box of a block's lasers."""
    block_laser_q[block, 0, 0], block_laser_q[block, 1, 0] = (
        min(block_laser_q[block, 0, 0], x), max(block_laser_q[block, 1, 0], x),
    )  # fmt: skip
    block_laser_q[block, 0, 1], block_laser_q[block, 1, 1] = (
        min(block_laser_q[block, 0, 1], y), max(block_laser_q[block, 1, 1], y),
    )  # fmt: skip
    block_laser_q[block, 0, 2], block_laser_q[block, 1, 2] = (
        min(block_laser_q[block, 0, 2], z), max(block_laser_q[block, 1, 2], z),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _mark_fresh(block_fresh, fresh, fresh_used, block, place):
    """Note that something changed in a cell."""
    if block_fresh[block] == 0:
        fresh[fresh_used[0]] = block
        fresh_used[0] += 1
    block_fresh[block] |= np.uint64(1) << np.uint64(place)


@njit(cache=True, nogil=True)
def remove_points(grid: Grid, points: PointArray, rows: Int32Array) -> int:
    """Take points out of their cells and mark these as fresh; returns how many were found there."""
    cell_first, cell_last, cell_count = grid.cell_first, grid.cell_last, grid.cell_count
    chunk_next, chunk = grid.chunk_next, grid.chunk
    removed = 0
    for row in rows:
        block, place = place_of(grid, points[row].x, points[row].y, points[row].z)
        cell = np.int64(grid.block_cell[block, place]) if block >= 0 else np.int64(-1)
        if cell < 0:
            continue
        # Everything behind the row moves one place forward: the rows of a cell stay in ascending order.
        to_chunk, to_at, found = np.int64(-1), 0, False
        here, left = np.int64(cell_first[cell]), np.int64(cell_count[cell])
        before_last = np.int64(-1)
        while left > 0:
            for at in range(min(left, CHUNK)):
                if found:
                    for column in range(5):
                        chunk[to_chunk, column, to_at] = chunk[here, column, at]
                elif chunk[here, ROW, at] == row:
                    found = True
                if found:
                    to_chunk, to_at = here, at
            left -= CHUNK
            if left > 0:
                before_last = here
            here = np.int64(chunk_next[here])
        if not found:
            continue
        removed += 1
        cell_count[cell] -= 1
        if cell_count[cell] % CHUNK == 0 and cell_count[cell] > 0:
            cell_last[cell] = before_last
        if cell_count[cell] == 0:
            grid.block_filled[block] &= ~(np.uint64(1) << np.uint64(place))
        _mark_fresh(grid.block_fresh, grid.fresh, grid.fresh_used, block, place)
    return removed


@njit(cache=True, nogil=True)
def mark_all_fresh(grid: Grid) -> None:
    """Mark every cell that holds points."""
    for block in range(grid.blocks_used[0]):
        if grid.block_fresh[block] == 0 and grid.block_filled[block] != 0:
            grid.fresh[grid.fresh_used[0]] = block
            grid.fresh_used[0] += 1
        grid.block_fresh[block] |= grid.block_filled[block]


@njit(cache=True, nogil=True)
def blocks_to_evaluate(grid: Grid) -> Int32Array:
    """The blocks that hold fresh cells or lie next to one that does; a new round begins."""
    block_near, block_round, fresh = grid.block_near, grid.block_round, grid.fresh
    grid.round[0] += 1
    this_round = grid.round[0]
    listed = np.empty(min(27 * grid.fresh_used[0], grid.blocks_used[0]), dtype=np.int32)
    n = 0
    for i in range(grid.fresh_used[0]):
        for near in range(27):
            block = np.int64(block_near[fresh[i], near])
            if block >= 0 and block_round[block] != this_round:
                block_round[block] = this_round
                listed[n] = block
                n += 1
    return listed[:n]


@njit(cache=True, nogil=True)
def forget_fresh(grid: Grid) -> None:
    """After an evaluation nothing is fresh."""
    for i in range(grid.fresh_used[0]):
        grid.block_fresh[grid.fresh[i]] = 0
    grid.fresh_used[0] = 0


@njit(cache=True, nogil=True)
def count_points(blocks: Int32Array, grid: Grid) -> int:
    """How many points the blocks hold."""
    block_filled, block_cell, cell_count = grid.block_filled, grid.block_cell, grid.cell_count
    count = np.int64(0)
    for block in blocks:
        cells = block_filled[block]
        while cells != np.uint64(0):
            count += cell_count[block_cell[block, lowest_bit(cells)]]
            cells &= cells - np.uint64(1)
    return count
