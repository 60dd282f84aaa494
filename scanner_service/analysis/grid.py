"""A sparse grid of cells that hold points: where things are; knows nothing of neighbourhoods, lines or normals.

Space is cut into cubic cells of side `side_q` quanta. 4 x 4 x 4 cells form a block; blocks are found by a hash of
their coordinates and know their 26 neighbours, so a cell's surroundings cost at most one look-up a block. A cell
holds its points in chunks of CHUNK, each with its own copy of the coordinates, so that reading a neighbourhood
touches little memory. All arrays are reserved at the ceiling: the operating system gives pages when they are first
touched, so growth never copies and no scanline waits for it.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from scanner_service.analysis.points import PointArray
from scanner_service.analysis.snapshot import Int32Array, UInt8Array

CHUNK = 8
BLOCK_CELLS = 64
QUEUED, SPREAD = 1, 2
SMALLEST_SIDE_Q = 2048
"""Cells are never smaller than this, so that cell coordinates stay below 2^20."""


class Grid(NamedTuple):
    """The grid's arrays; `*_used` are one-element counters, index -1 means none.

    `hash_block` (2^k,) holds block + 1 or 0; `block_key` (B, 3) block coordinates; `block_near` (B, 27) neighbouring
    blocks; `block_cell` (B, 64) the cell at each place; `block_needy` (B,) 1 once one of its cells was needy, and
    `block_round` (B,) the round in which those around were queued. `cell_at` (C, 3) cell coordinates, `cell_block`
    (C,), `cell_first`, `cell_last` (C,) chunks, `cell_count` (C,) points, `cell_needy` (C,) 1 when a point of it looks
    farther than the neighbouring cells, `cell_stale` (C,) QUEUED in `stale` (C,), or SPREAD when its neighbours are
    queued too. `chunk_next` (K,), `chunk_xyz` (K, 3, CHUNK) int32 coordinates, `chunk_line` (K, CHUNK) scanlines and
    `chunk_point` (K, CHUNK) point rows, ascending along a cell. `round` counts evaluations.
    """

    side_q: npt.NDArray[np.int64]
    hash_block: Int32Array
    blocks_used: npt.NDArray[np.int64]
    block_key: Int32Array
    block_near: Int32Array
    block_cell: Int32Array
    block_needy: UInt8Array
    block_round: Int32Array
    cells_used: npt.NDArray[np.int64]
    cell_at: Int32Array
    cell_block: Int32Array
    cell_first: Int32Array
    cell_last: Int32Array
    cell_count: Int32Array
    cell_stale: UInt8Array
    cell_needy: UInt8Array
    stale_used: npt.NDArray[np.int64]
    stale: Int32Array
    chunks_used: npt.NDArray[np.int64]
    chunk_next: Int32Array
    chunk_xyz: Int32Array
    chunk_line: Int32Array
    chunk_point: Int32Array
    round: Int32Array


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
        block_needy=np.zeros(blocks, dtype=np.uint8),
        block_round=np.zeros(blocks, dtype=np.int32),
        cells_used=counter(),
        cell_at=np.empty((cells, 3), dtype=np.int32),
        cell_block=np.empty(cells, dtype=np.int32),
        cell_first=np.empty(cells, dtype=np.int32),
        cell_last=np.empty(cells, dtype=np.int32),
        cell_count=np.empty(cells, dtype=np.int32),
        cell_stale=np.empty(cells, dtype=np.uint8),
        cell_needy=np.empty(cells, dtype=np.uint8),
        stale_used=counter(),
        stale=np.empty(cells, dtype=np.int32),
        chunks_used=counter(),
        chunk_next=np.empty(cells, dtype=np.int32),
        chunk_xyz=np.empty((cells, 3, CHUNK), dtype=np.int32),
        chunk_line=np.empty((cells, CHUNK), dtype=np.int32),
        chunk_point=np.empty((cells, CHUNK), dtype=np.int32),
        round=np.ones(1, dtype=np.int32),
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
def _block_at(hash_block, blocks_used, block_key, block_near, block_cell, bx, by, bz):
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
def cell_near(cell_at, cell_block, block_key, block_near, block_cell, cell, dx, dy, dz):
    """The cell at an offset of at most 4 cells from `cell`, or -1 when nothing is there."""
    x, y, z = cell_at[cell, 0] + dx, cell_at[cell, 1] + dy, cell_at[cell, 2] + dz
    block = cell_block[cell]
    bx, by, bz = block_key[block, 0], block_key[block, 1], block_key[block, 2]
    near = ((x >> 2) - bx + 1) * 9 + ((y >> 2) - by + 1) * 3 + (z >> 2) - bz + 1
    block = block_near[block, near]
    if block < 0:
        return np.int64(-1)
    return np.int64(block_cell[block, ((x & 3) << 4) | ((y & 3) << 2) | (z & 3)])


@njit(cache=True, nogil=True)
def cell_of(grid: Grid, x: int, y: int, z: int) -> int:
    """The cell at these cell coordinates, or -1 when nothing is there."""
    block = grid.hash_block[_slot(grid.hash_block, grid.block_key, x >> 2, y >> 2, z >> 2)] - 1
    if block < 0:
        return np.int64(-1)
    return np.int64(grid.block_cell[block, ((x & 3) << 4) | ((y & 3) << 2) | (z & 3)])


@njit(cache=True, nogil=True)
def insert_points(
    grid: Grid, points: PointArray, first_row: int, line: int, cell_limit: int, counted: UInt8Array
) -> int:
    """Put the points of a line, rows first_row, first_row + 1, ..., into their cells; queue what they reach.

    What they reach: their cells, the 26 around each, and the needy cells of the blocks around. A cell that is made
    later in the round queues itself, so what was spread once in a round needs no second time.

    `counted` (k,) comes in as 1 for points to insert and 0 for points to pass over, and goes out with 0 where a cell
    already holds `cell_limit` points. Returns how many points were taken in hand; fewer than k means the grid is full.
    """
    hash_block, blocks_used, block_key = grid.hash_block, grid.blocks_used, grid.block_key
    block_near, block_cell, block_needy = grid.block_near, grid.block_cell, grid.block_needy
    cell_needy = grid.cell_needy
    block_round, cells_used, cell_at, cell_block = grid.block_round, grid.cells_used, grid.cell_at, grid.cell_block
    cell_first, cell_last, cell_count, cell_stale = grid.cell_first, grid.cell_last, grid.cell_count, grid.cell_stale
    stale_used, stale, chunks_used, chunk_next = grid.stale_used, grid.stale, grid.chunks_used, grid.chunk_next
    chunk_xyz, chunk_line, chunk_point = grid.chunk_xyz, grid.chunk_line, grid.chunk_point
    side, this_round = grid.side_q[0], grid.round[0]
    cell, block = np.int64(-1), np.int64(-1)
    lx, ly, lz = np.int64(0), np.int64(0), np.int64(0)
    for i in range(len(counted)):
        if counted[i] == 0:
            continue
        row = first_row + i
        px, py, pz = points[row].x, points[row].y, points[row].z
        x, y, z = px // side, py // side, pz // side
        if cell < 0 or x != lx or y != ly or z != lz:
            if cell < 0 or x >> 2 != lx >> 2 or y >> 2 != ly >> 2 or z >> 2 != lz >> 2:
                block = _block_at(hash_block, blocks_used, block_key, block_near, block_cell, x >> 2, y >> 2, z >> 2)
                if block < 0:
                    return i
            place = ((x & 3) << 4) | ((y & 3) << 2) | (z & 3)
            cell = np.int64(block_cell[block, place])
            if cell < 0:
                cell = cells_used[0]
                if cell >= len(cell_block):
                    return i
                cells_used[0] = cell + 1
                block_cell[block, place] = cell
                cell_at[cell, 0], cell_at[cell, 1], cell_at[cell, 2] = x, y, z
                cell_block[cell] = block
                cell_first[cell] = -1
                cell_last[cell] = -1
                cell_count[cell] = 0
                cell_stale[cell] = 0
                cell_needy[cell] = 0
            if cell_stale[cell] != SPREAD:
                _queue_around(
                    cell_at, cell_block, block_key, block_near, block_cell, cell_stale, stale, stale_used, cell
                )
                if block_round[block] != this_round:
                    block_round[block] = this_round
                    _queue_needy(block_near, block_needy, block_cell, cell_needy, cell_stale, stale, stale_used, block)
            lx, ly, lz = x, y, z
        count = cell_count[cell]
        if count >= cell_limit:
            counted[i] = 0
            continue
        place = count % CHUNK
        chunk = np.int64(cell_last[cell])
        if place == 0:
            if count == 0 and chunk >= 0:  # emptied by a removal: its first chunk is free again
                chunk = np.int64(cell_first[cell])
            elif count > 0 and chunk_next[chunk] >= 0:  # shortened by a removal
                chunk = np.int64(chunk_next[chunk])
            else:
                chunk = chunks_used[0]
                if chunk >= len(chunk_next):
                    return i
                chunks_used[0] = chunk + 1
                chunk_next[chunk] = -1
                if count == 0:
                    cell_first[cell] = chunk
                else:
                    chunk_next[cell_last[cell]] = chunk
            cell_last[cell] = chunk
        chunk_xyz[chunk, 0, place] = px
        chunk_xyz[chunk, 1, place] = py
        chunk_xyz[chunk, 2, place] = pz
        chunk_line[chunk, place] = line
        chunk_point[chunk, place] = row
        cell_count[cell] = count + 1
    return len(counted)


@njit(cache=True, nogil=True)
def _queue_around(cell_at, cell_block, block_key, block_near, block_cell, cell_stale, stale, stale_used, cell):
    """Queue a cell and the 26 around it."""
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                near = cell_near(cell_at, cell_block, block_key, block_near, block_cell, cell, dx, dy, dz)
                if near >= 0 and cell_stale[near] == 0:
                    cell_stale[near] = QUEUED
                    stale[stale_used[0]] = near
                    stale_used[0] += 1
    cell_stale[cell] = SPREAD


@njit(cache=True, nogil=True)
def remove_points(grid: Grid, points: PointArray, rows: Int32Array) -> int:
    """Take points out of their cells and queue what they reached; returns how many were found there."""
    block_key, block_near, block_cell = grid.block_key, grid.block_near, grid.block_cell
    block_needy, cell_at, cell_block, cell_stale = grid.block_needy, grid.cell_at, grid.cell_block, grid.cell_stale
    cell_needy = grid.cell_needy
    stale, stale_used, cell_first, cell_last = grid.stale, grid.stale_used, grid.cell_first, grid.cell_last
    cell_count, chunk_next, chunk_point = grid.cell_count, grid.chunk_next, grid.chunk_point
    chunk_xyz, chunk_line, side = grid.chunk_xyz, grid.chunk_line, grid.side_q[0]
    removed = 0
    for i in range(len(rows)):
        row = rows[i]
        cell = cell_of(grid, points[row].x // side, points[row].y // side, points[row].z // side)
        if cell < 0:
            continue
        # Everything behind the row moves one place forward: the rows of a cell stay in ascending order.
        to_chunk, to_place, found = np.int64(-1), 0, False
        chunk, left = cell_first[cell], cell_count[cell]
        before_last = np.int64(-1)
        while left > 0:
            for j in range(min(left, CHUNK)):
                if found:
                    for axis in range(3):
                        chunk_xyz[to_chunk, axis, to_place] = chunk_xyz[chunk, axis, j]
                    chunk_line[to_chunk, to_place] = chunk_line[chunk, j]
                    chunk_point[to_chunk, to_place] = chunk_point[chunk, j]
                elif chunk_point[chunk, j] == row:
                    found = True
                if found:
                    to_chunk, to_place = chunk, j
            left -= CHUNK
            if left > 0:
                before_last = chunk
            chunk = chunk_next[chunk]
        if not found:
            continue
        removed += 1
        cell_count[cell] -= 1
        if cell_count[cell] % CHUNK == 0 and cell_count[cell] > 0:
            cell_last[cell] = before_last
        _queue_around(cell_at, cell_block, block_key, block_near, block_cell, cell_stale, stale, stale_used, cell)
        block = cell_block[cell]
        _queue_needy(block_near, block_needy, block_cell, cell_needy, cell_stale, stale, stale_used, block)
    return removed


@njit(cache=True, nogil=True)
def _queue_needy(block_near, block_needy, block_cell, cell_needy, cell_stale, stale, stale_used, block):
    """Queue the cells around whose points look farther than their neighbours."""
    for i in range(27):
        other = block_near[block, i]
        if other < 0 or block_needy[other] == 0:
            continue
        for place in range(BLOCK_CELLS):
            cell = block_cell[other, place]
            if cell >= 0 and cell_needy[cell] != 0 and cell_stale[cell] == 0:
                cell_stale[cell] = QUEUED
                stale[stale_used[0]] = cell
                stale_used[0] += 1


@njit(cache=True, nogil=True)
def take_stale(grid: Grid) -> Int32Array:
    """Empty the queue: the cells to evaluate, each once; a new round begins."""
    cell_stale = grid.cell_stale
    cells = grid.stale[: grid.stale_used[0]].copy()
    for i in range(len(cells)):
        cell_stale[cells[i]] = 0
    grid.stale_used[0] = 0
    grid.round[0] += 1
    return cells


@njit(cache=True, nogil=True)
def queue_all(grid: Grid) -> None:
    """Queue every cell."""
    cell_stale, stale = grid.cell_stale, grid.stale
    for cell in range(grid.cells_used[0]):
        cell_stale[cell] = SPREAD
        stale[cell] = cell
    grid.stale_used[0] = grid.cells_used[0]
