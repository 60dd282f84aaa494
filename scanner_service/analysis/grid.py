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

from scanner_service.analysis.snapshot import Int32Array, UInt8Array

CHUNK = 8
BLOCK_CELLS = 64
SMALLEST_SIDE_Q = 2048
"""Cells are never smaller than this, so that cell coordinates stay below 2^20."""


class Grid(NamedTuple):
    """The grid's arrays; `*_used` are one-element counters, index -1 means none.

    `hash_block` (2^k,) holds block + 1 or 0; `block_key` (B, 3) block coordinates; `block_near` (B, 27) neighbouring
    blocks; `block_cell` (B, 64) the cell at each place. `cell_at` (C, 3) cell coordinates, `cell_block` (C,),
    `cell_first`, `cell_last` (C,) chunks, `cell_count` (C,) points, `cell_stale` (C,) 1 while queued in `stale` (C,).
    `chunk_next` (K,), `chunk_xyz` (K, 3, CHUNK) int32 coordinates and `chunk_point` (K, CHUNK) point rows.
    """

    side_q: npt.NDArray[np.int64]
    hash_block: Int32Array
    blocks_used: npt.NDArray[np.int64]
    block_key: Int32Array
    block_near: Int32Array
    block_cell: Int32Array
    cells_used: npt.NDArray[np.int64]
    cell_at: Int32Array
    cell_block: Int32Array
    cell_first: Int32Array
    cell_last: Int32Array
    cell_count: Int32Array
    cell_stale: UInt8Array
    stale_used: npt.NDArray[np.int64]
    stale: Int32Array
    chunks_used: npt.NDArray[np.int64]
    chunk_next: Int32Array
    chunk_xyz: Int32Array
    chunk_point: Int32Array


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
        cells_used=counter(),
        cell_at=np.empty((cells, 3), dtype=np.int32),
        cell_block=np.empty(cells, dtype=np.int32),
        cell_first=np.empty(cells, dtype=np.int32),
        cell_last=np.empty(cells, dtype=np.int32),
        cell_count=np.empty(cells, dtype=np.int32),
        cell_stale=np.empty(cells, dtype=np.uint8),
        stale_used=counter(),
        stale=np.empty(cells, dtype=np.int32),
        chunks_used=counter(),
        chunk_next=np.empty(cells, dtype=np.int32),
        chunk_xyz=np.empty((cells, 3, CHUNK), dtype=np.int32),
        chunk_point=np.empty((cells, CHUNK), dtype=np.int32),
    )


@njit(cache=True, nogil=True)
def _slot(grid: Grid, bx: int, by: int, bz: int) -> int:
    """The place of a block in the hash table: its own, or the empty one where it belongs."""
    mask = len(grid.hash_block) - 1
    h = np.uint64(bx) * np.uint64(0x9E3779B97F4A7C15)
    h ^= np.uint64(by) * np.uint64(0xC2B2AE3D27D4EB4F)
    h ^= np.uint64(bz) * np.uint64(0x165667B19E3779F9)
    h ^= h >> np.uint64(29)
    slot = np.int64(h & np.uint64(mask))
    while True:
        block = grid.hash_block[slot] - 1
        if block < 0:
            return slot
        key = grid.block_key[block]
        if key[0] == bx and key[1] == by and key[2] == bz:
            return slot
        slot = (slot + 1) & mask


@njit(cache=True, nogil=True)
def _block_at(grid: Grid, bx: int, by: int, bz: int) -> int:
    """The block at these block coordinates, made if it is not there; -1 when no block is left."""
    slot = _slot(grid, bx, by, bz)
    block = grid.hash_block[slot] - 1
    if block >= 0:
        return block
    block = grid.blocks_used[0]
    if block >= len(grid.block_key):
        return -1
    grid.blocks_used[0] = block + 1
    grid.hash_block[slot] = block + 1
    grid.block_key[block, 0], grid.block_key[block, 1], grid.block_key[block, 2] = bx, by, bz
    grid.block_cell[block, :] = -1
    for near in range(27):
        dx, dy, dz = near // 9 - 1, (near // 3) % 3 - 1, near % 3 - 1
        if near == 13:
            grid.block_near[block, near] = block
            continue
        other = grid.hash_block[_slot(grid, bx + dx, by + dy, bz + dz)] - 1
        grid.block_near[block, near] = other
        if other >= 0:
            grid.block_near[other, 26 - near] = block
    return block


@njit(cache=True, nogil=True)
def cell_near(grid: Grid, cell: int, dx: int, dy: int, dz: int) -> int:
    """The cell at an offset of at most 4 cells from `cell`, or -1 when nothing is there."""
    at = grid.cell_at[cell]
    x, y, z = at[0] + dx, at[1] + dy, at[2] + dz
    block = grid.cell_block[cell]
    key = grid.block_key[block]
    near = ((x >> 2) - key[0] + 1) * 9 + ((y >> 2) - key[1] + 1) * 3 + (z >> 2) - key[2] + 1
    block = grid.block_near[block, near]
    if block < 0:
        return -1
    return np.int64(grid.block_cell[block, ((x & 3) << 4) | ((y & 3) << 2) | (z & 3)])


@njit(cache=True, nogil=True)
def _mark_stale_around(grid: Grid, cell: int) -> None:
    """Queue a cell and its 26 neighbours: something in their reach has changed."""
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                near = cell_near(grid, cell, dx, dy, dz)
                if near >= 0 and grid.cell_stale[near] == 0:
                    grid.cell_stale[near] = 1
                    grid.stale[grid.stale_used[0]] = near
                    grid.stale_used[0] += 1


@njit(cache=True, nogil=True)
def insert_points(grid: Grid, xyz_q: Int32Array, first_row: int, cell_limit: int, counted: UInt8Array) -> int:
    """Put points (k, 3) with rows first_row, first_row + 1, ... into their cells; queue what they reach.

    `counted` (k,) comes in as 1 for points to insert and 0 for points to pass over, and goes out with 0 where a cell
    already holds `cell_limit` points. Returns how many points were taken in hand; fewer than k means the grid is full.
    """
    side = grid.side_q[0]
    last_cell = np.int64(-1)
    lx, ly, lz = np.int64(0), np.int64(0), np.int64(0)
    for i in range(len(xyz_q)):
        if counted[i] == 0:
            continue
        x, y, z = xyz_q[i, 0] // side, xyz_q[i, 1] // side, xyz_q[i, 2] // side
        cell = last_cell
        if cell < 0 or x != lx or y != ly or z != lz:
            block = _block_at(grid, x >> 2, y >> 2, z >> 2)
            if block < 0:
                return i
            place = ((x & 3) << 4) | ((y & 3) << 2) | (z & 3)
            cell = np.int64(grid.block_cell[block, place])
            if cell < 0:
                cell = grid.cells_used[0]
                if cell >= len(grid.cell_block):
                    return i
                grid.cells_used[0] = cell + 1
                grid.block_cell[block, place] = cell
                grid.cell_at[cell, 0], grid.cell_at[cell, 1], grid.cell_at[cell, 2] = x, y, z
                grid.cell_block[cell] = block
                grid.cell_first[cell] = -1
                grid.cell_last[cell] = -1
                grid.cell_count[cell] = 0
                grid.cell_stale[cell] = 0
            _mark_stale_around(grid, cell)
            last_cell, lx, ly, lz = cell, x, y, z
        count = grid.cell_count[cell]
        if count >= cell_limit:
            counted[i] = 0
            continue
        place = count % CHUNK
        chunk = np.int64(grid.cell_last[cell])
        if place == 0:
            chunk = grid.chunks_used[0]
            if chunk >= len(grid.chunk_next):
                return i
            grid.chunks_used[0] = chunk + 1
            grid.chunk_next[chunk] = -1
            if count == 0:
                grid.cell_first[cell] = chunk
            else:
                grid.chunk_next[grid.cell_last[cell]] = chunk
            grid.cell_last[cell] = chunk
        grid.chunk_xyz[chunk, 0, place] = xyz_q[i, 0]
        grid.chunk_xyz[chunk, 1, place] = xyz_q[i, 1]
        grid.chunk_xyz[chunk, 2, place] = xyz_q[i, 2]
        grid.chunk_point[chunk, place] = first_row + i
        grid.cell_count[cell] = count + 1
    return len(xyz_q)


@njit(cache=True, nogil=True)
def mark_all_stale(grid: Grid) -> None:
    """Queue every cell."""
    for cell in range(grid.cells_used[0]):
        if grid.cell_stale[cell] == 0:
            grid.cell_stale[cell] = 1
            grid.stale[grid.stale_used[0]] = cell
            grid.stale_used[0] += 1
