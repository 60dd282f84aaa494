"""A sparse grid of cells: a hash table of blocks of 4 x 4 x 4 cells, each cell a chain of chunks of points.

Knows stored coordinates and scanlines, no neighbourhoods. Nothing is ever moved: a cell keeps its number, a point its
place, and memory comes into being as it is touched, so no line waits for a table to grow.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from scanner_service.analysis.around import BLOCK_CELLS
from scanner_service.analysis.points import PointArray
from scanner_service.analysis.snapshot import Int32Array, UInt8Array

CHUNK = 6
X, Y, Z, LINE, ROW = range(5)
SMALLEST_SIDE_Q = 2048
"""Cells are never smaller than this, so that cell coordinates stay below 2^20."""


class Grid(NamedTuple):
    """The grid's arrays; index -1 means none.

    `used` (6,) counts blocks, cells, chunks, blocks listed in `fresh`, evaluations, and rows that share an entry.
    `hash_block` (2^k,) holds block + 1 or 0. `block` (B, 96) holds the 27 blocks around (NEAR), the cells of the 64
    places (CELL), three block coordinates (KEY) and the evaluation for which the block was last listed (ROUND).

    `bits` (B, 8) has a bit a place: FILLED, it holds points; FRESH, it got or lost one since the last evaluation;
    NEXT_TO, it or a cell next to it is fresh, while that is evaluated; FAR, FAR + 1, FAR + 2, a point of it looks at
    least 2, 3 or 4 cells far; DOUBLED, an entry of it stands for several rows. `block_laser_q` (B, 2, 3) is the box of
    the lasers that saw the block's points, and `fresh` (B,) lists the blocks with fresh cells.

    `cell` (C, 4) holds first and last chunk, the number of entries and, in a fresh cell, how many of them are older
    than the last evaluation. `chunk` (K, 5, CHUNK) holds x, y, z, scanline and point row of each entry, rows ascending
    along a cell, and `chunk_next` (K,) the chunk behind. In crowded cells the rows of a scanline that have the same
    coordinates share an entry: `more` (K, CHUNK) says how many rows beside its own it stands for, and `next_double`
    (P,) leads from each row to the next of them, by row + 1, 0 at the end.
    """

    side_q: npt.NDArray[np.int64]
    used: npt.NDArray[np.int64]
    hash_block: Int32Array
    block: Int32Array
    bits: npt.NDArray[np.uint64]
    block_laser_q: npt.NDArray[np.float64]
    fresh: Int32Array
    cell: Int32Array
    chunk_next: Int32Array
    chunk: Int32Array
    more: Int32Array
    next_double: Int32Array


BLOCKS, CELLS, CHUNKS, FRESH_BLOCKS, EVALUATIONS, DOUBLES = range(6)
NEAR, CELL, KEY, ROUND = 0, 27, 91, 94
FILLED, FRESH, NEXT_TO, FAR, DOUBLED = 0, 1, 2, 3, 6
FIRST, LAST, COUNT, OLD = range(4)


_LONGEST_LINE = 4096
"""Before a line is taken there must be a block for each of its points."""

CROWDED = 64
"""A cell with so many entries looks for the same point before it takes another."""


def cell_side_q(radius_mm: float, quantum_mm: float) -> int:
    """Side of cells in which a radius never reaches beyond the next cell, rounding of cell coordinates included."""
    return max(math.ceil(radius_mm / quantum_mm) + 1, SMALLEST_SIDE_Q)


def reserve_grid(side_q: int, max_points: int) -> Grid:
    """An empty grid with room for `max_points` points in cells of `side_q` quanta."""
    blocks = max_points // 8 + min(max_points, _LONGEST_LINE)
    return Grid(
        side_q=np.array([side_q], dtype=np.int64),
        used=np.zeros(6, dtype=np.int64),
        hash_block=np.zeros(1 << (blocks + blocks // 2).bit_length(), dtype=np.int32),
        block=np.empty((blocks, 96), dtype=np.int32),
        bits=np.empty((blocks, 8), dtype=np.uint64),
        block_laser_q=np.empty((blocks, 2, 3), dtype=np.float64),
        fresh=np.empty(blocks, dtype=np.int32),
        cell=np.empty((max_points, 4), dtype=np.int32),
        chunk_next=np.empty(max_points, dtype=np.int32),
        chunk=np.empty((max_points, 5, CHUNK), dtype=np.int32),
        more=np.zeros((max_points, CHUNK), dtype=np.int32),
        next_double=np.zeros(max_points, dtype=np.int32),
    )


# The kernels take the arrays they need one by one: an array taken out of a tuple inside a loop costs two atomic
# operations each time, which is more than the work itself.


@njit(cache=True, nogil=True)
def _slot(hash_block, block, bx, by, bz):
    """The place of a block in the hash table: its own, or the empty one where it belongs."""
    # Blocks near each other share a page of the table, or a scan would touch all of it at once.
    mask = len(hash_block) - 1
    h = np.uint64(bx >> 3) * np.uint64(0x9E3779B97F4A7C15)
    h ^= np.uint64(by >> 3) * np.uint64(0xC2B2AE3D27D4EB4F)
    h ^= np.uint64(bz >> 3) * np.uint64(0x165667B19E3779F9)
    h ^= h >> np.uint64(29)
    h = (h << np.uint64(9)) | np.uint64(((bx & 7) << 6) | ((by & 7) << 3) | (bz & 7))
    slot = np.int64(h & np.uint64(mask))
    while True:
        b = hash_block[slot] - 1
        if b < 0 or (block[b, KEY] == bx and block[b, KEY + 1] == by and block[b, KEY + 2] == bz):
            return slot
        slot = (slot + 1) & mask


@njit(cache=True, nogil=True)
def _block_at(hash_block, used, block, bits, block_laser_q, bx, by, bz):
    """The block at these block coordinates, made if it is not there; -1 when no block is left."""
    slot = _slot(hash_block, block, bx, by, bz)
    b = np.int64(hash_block[slot] - 1)
    if b >= 0:
        return b
    b = used[BLOCKS]
    if b >= len(block):
        return np.int64(-1)
    used[BLOCKS] = b + 1
    hash_block[slot] = b + 1
    block[b, KEY], block[b, KEY + 1], block[b, KEY + 2] = bx, by, bz
    block[b, ROUND] = -1
    for place in range(BLOCK_CELLS):
        block[b, CELL + place] = -1
    for k in range(8):
        bits[b, k] = 0
    for axis in range(3):
        block_laser_q[b, 0, axis], block_laser_q[b, 1, axis] = math.inf, -math.inf
    for near in range(27):
        if near == 13:
            block[b, NEAR + near] = b
            continue
        dx, dy, dz = near // 9 - 1, (near // 3) % 3 - 1, near % 3 - 1
        other = hash_block[_slot(hash_block, block, bx + dx, by + dy, bz + dz)] - 1
        block[b, NEAR + near] = other
        if other >= 0:
            block[other, NEAR + 26 - near] = b
    return b


@njit(cache=True, nogil=True)
def place_of(grid: Grid, x: int, y: int, z: int) -> tuple[int, int]:
    """Block, and place in it, of the stored coordinates; block -1 when nothing is there."""
    per_side = 1.0 / grid.side_q[0]
    cx, cy, cz = math.floor(x * per_side), math.floor(y * per_side), math.floor(z * per_side)
    b = grid.hash_block[_slot(grid.hash_block, grid.block, cx >> 2, cy >> 2, cz >> 2)] - 1
    return np.int64(b), ((cx & 3) << 4) | ((cy & 3) << 2) | (cz & 3)


@njit(cache=True)
def insert_points(
    grid: Grid,
    points: PointArray,
    first_row: int,
    line: int,
    laser_q: npt.NDArray[np.float64],
    cell_limit: int,
    shares: bool,
    counted: UInt8Array,
) -> int:
    """Put the points of a line, rows first_row, first_row + 1, ..., into their cells, and mark these as fresh.

    `laser_q` (3,) is the line's laser position; with `shares` rows with the same coordinates may share an entry.
    `counted` (k,) comes in as 1 for points to insert and 0 for points to pass over, and goes out with 0 where a cell
    already holds `cell_limit` entries. Returns how many points were taken in hand; fewer than k means the grid is full.
    """
    used, hash_block, block, bits, fresh = grid.used, grid.hash_block, grid.block, grid.bits, grid.fresh
    block_laser_q, cell, chunk_next, chunk = grid.block_laser_q, grid.cell, grid.chunk_next, grid.chunk
    per_side = 1.0 / grid.side_q[0]
    lx, ly, lz = laser_q[0], laser_q[1], laser_q[2]
    c, b = np.int64(-1), np.int64(-1)
    ax, ay, az = 0, 0, 0
    for i in range(len(counted)):
        if counted[i] == 0:
            continue
        row = first_row + i
        px, py, pz = points[row].x, points[row].y, points[row].z
        x, y, z = math.floor(px * per_side), math.floor(py * per_side), math.floor(pz * per_side)
        if c < 0 or x != ax or y != ay or z != az:
            if b < 0 or x >> 2 != ax >> 2 or y >> 2 != ay >> 2 or z >> 2 != az >> 2:
                near = _near_of((x >> 2) - (ax >> 2), (y >> 2) - (ay >> 2), (z >> 2) - (az >> 2))
                known = np.int64(block[b, NEAR + near]) if b >= 0 and near >= 0 else np.int64(-1)
                b = known
                if b < 0:
                    b = _block_at(hash_block, used, block, bits, block_laser_q, x >> 2, y >> 2, z >> 2)
                if b < 0:
                    return i
                _stretch(block_laser_q, b, lx, ly, lz)
            place = ((x & 3) << 4) | ((y & 3) << 2) | (z & 3)
            c = np.int64(block[b, CELL + place])
            if c < 0:
                c = used[CELLS]
                if c >= len(cell):
                    return i
                used[CELLS] = c + 1
                block[b, CELL + place] = c
                cell[c, FIRST], cell[c, LAST], cell[c, COUNT], cell[c, OLD] = -1, -1, 0, 0
            if _mark_fresh(bits, fresh, used, b, place):
                cell[c, OLD] = cell[c, COUNT]
            bits[b, FILLED] |= np.uint64(1) << np.uint64(place)
            ax, ay, az = x, y, z
        count = np.int64(cell[c, COUNT])
        if count >= CROWDED and shares and _share(grid, points, c, row):
            bits[b, DOUBLED] |= np.uint64(1) << np.uint64(place)
            continue
        if count >= cell_limit:
            counted[i] = 0
            continue
        at = count % CHUNK
        last = np.int64(cell[c, LAST])
        if at == 0:
            if count == 0 and last >= 0:  # emptied by a removal: its first chunk is free again
                last = np.int64(cell[c, FIRST])
            elif count > 0 and chunk_next[last] >= 0:  # shortened by a removal
                last = np.int64(chunk_next[last])
            else:
                last = used[CHUNKS]
                if last >= len(chunk_next):
                    return i
                used[CHUNKS] = last + 1
                chunk_next[last] = -1
                if count == 0:
                    cell[c, FIRST] = last
                else:
                    chunk_next[cell[c, LAST]] = last
            cell[c, LAST] = last
        chunk[last, X, at] = px
        chunk[last, Y, at] = py
        chunk[last, Z, at] = pz
        chunk[last, LINE, at] = line
        chunk[last, ROW, at] = row
        cell[c, COUNT] = count + 1
    return len(counted)


@njit(cache=True, nogil=True)
def _share(grid, points, c, row):
    """Let a row share the entry of a cell with the same coordinates, scanline and radius; False when there is none."""
    chunk, cell = grid.chunk, grid.cell
    here, left = np.int64(cell[c, FIRST]), np.int64(cell[c, COUNT])
    x, y, z, line = points[row].x, points[row].y, points[row].z, points[row].line
    while left > 0:
        for at in range(min(left, CHUNK)):
            if chunk[here, X, at] == x and chunk[here, Y, at] == y and chunk[here, Z, at] == z:
                other = chunk[here, ROW, at]
                if chunk[here, LINE, at] == line and points[other].radius_mm == points[row].radius_mm:
                    grid.more[here, at] += 1
                    grid.next_double[row] = grid.next_double[other]
                    grid.next_double[other] = row + 1
                    grid.used[DOUBLES] += 1
                    return True
        left -= CHUNK
        here = np.int64(grid.chunk_next[here])
    return False


@njit(cache=True, nogil=True)
def _near_of(dx, dy, dz):
    """Number of the neighbouring block at this offset, -1 when it is no neighbour."""
    if abs(dx) > 1 or abs(dy) > 1 or abs(dz) > 1:
        return -1
    return 9 * (dx + 1) + 3 * (dy + 1) + dz + 1


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
def _mark_fresh(bits, fresh, used, b, place):
    """Note that something changed in a cell; False when that was known."""
    before = bits[b, FRESH]
    bit = np.uint64(1) << np.uint64(place)
    if before & bit != np.uint64(0):
        return False
    if before == np.uint64(0):
        fresh[used[FRESH_BLOCKS]] = b
        used[FRESH_BLOCKS] += 1
    bits[b, FRESH] = before | bit
    return True


@njit(cache=True, nogil=True)
def remove_points(grid: Grid, points: PointArray, rows: Int32Array) -> int:
    """Take points out of their cells and mark these as fresh; returns how many were found there.

    Rows that share an entry are of one scanline and go together.
    """
    bits, cell, chunk_next, chunk, more = grid.bits, grid.cell, grid.chunk_next, grid.chunk, grid.more
    removed = 0
    for row in rows:
        b, place = place_of(grid, points[row].x, points[row].y, points[row].z)
        c = np.int64(grid.block[b, CELL + place]) if b >= 0 else np.int64(-1)
        if c < 0:
            continue
        # Everything behind the row moves one place forward: the rows of a cell stay in ascending order.
        to_chunk, to_at, found = np.int64(-1), 0, False
        here, left = np.int64(cell[c, FIRST]), np.int64(cell[c, COUNT])
        before_last = np.int64(-1)
        while left > 0:
            for at in range(min(left, CHUNK)):
                if found:
                    for column in range(5):
                        chunk[to_chunk, column, to_at] = chunk[here, column, at]
                    more[to_chunk, to_at] = more[here, at]
                elif chunk[here, ROW, at] == row:
                    found = True
                    removed += 1 + more[here, at]
                    grid.used[DOUBLES] -= more[here, at]
                if found:
                    to_chunk, to_at = here, at
            left -= CHUNK
            if left > 0:
                before_last = here
            here = np.int64(chunk_next[here])
        if not found:
            continue
        more[to_chunk, to_at] = 0
        cell[c, COUNT] -= 1
        if cell[c, COUNT] % CHUNK == 0 and cell[c, COUNT] > 0:
            cell[c, LAST] = before_last
        if cell[c, COUNT] == 0:
            bits[b, FILLED] &= ~(np.uint64(1) << np.uint64(place))
        _mark_fresh(bits, grid.fresh, grid.used, b, place)
    return removed
