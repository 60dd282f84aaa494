"""Fetching the points around a cell into a buffer for the kernels; judges nothing."""

import math

import numpy as np
from numba import njit

from scanner_service.analysis.grid import CHUNK, cell_near
from scanner_service.analysis.intake import QUANTUM_MM

VECTOR = 16
"""The candidates are padded to a multiple of this, so that vector registers run full."""

_FAR = 1e15


@njit(cache=True, nogil=True, error_model="numpy")
def cells_around(cell_at, cell_block, cell_count, block_key, block_near, block_cell, cell, rings, found):
    """Put the cells up to `rings` away into `found`; returns how many, and how many points they hold."""
    n_found = 0
    n_points = np.int64(0)
    for dx in range(-rings, rings + 1):
        for dy in range(-rings, rings + 1):
            for dz in range(-rings, rings + 1):
                other = cell_near(cell_at, cell_block, block_key, block_near, block_cell, cell, dx, dy, dz)
                if other >= 0:
                    found[n_found] = other
                    n_found += 1
                    n_points += cell_count[other]
    return n_found, n_points


@njit(cache=True, nogil=True, error_model="numpy")
def gather(chunk_next, chunk_xyz, chunk_line, cell_first, cell_count, found, n_found, buffer):
    """Copy x, y, z and line of every point in the cells found, and pad."""
    n = 0
    for k in range(n_found):
        chunk = cell_first[found[k]]
        left = cell_count[found[k]]
        while left > 0:
            here = min(left, CHUNK)
            for j in range(CHUNK):  # a whole chunk at once: what is beyond its end is overwritten or padded
                buffer[0, n + j] = chunk_xyz[chunk, 0, j]
                buffer[1, n + j] = chunk_xyz[chunk, 1, j]
                buffer[2, n + j] = chunk_xyz[chunk, 2, j]
                buffer[3, n + j] = chunk_line[chunk, j]
            n += here
            left -= here
            chunk = chunk_next[chunk]
    for j in range(VECTOR):
        buffer[0, n + j] = _FAR
        buffer[1, n + j], buffer[2, n + j], buffer[3, n + j] = 0.0, 0.0, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def gather_fresh(
    chunk_next, chunk_xyz, chunk_point, cell_first, cell_last, cell_count, found, n_found, first_new, fresh
):
    """Copy the coordinates of those points in the cells found that are new, and pad; returns how many."""
    n = np.int64(0)
    for k in range(n_found):
        cell = found[k]
        if chunk_point[cell_last[cell], (cell_count[cell] - 1) % CHUNK] < first_new:
            continue  # rows of a cell ascend: its last is its newest
        chunk = cell_first[cell]
        left = cell_count[cell]
        while left > 0:
            here = min(left, CHUNK)
            for j in range(here):
                if chunk_point[chunk, j] >= first_new:
                    fresh[0, n] = chunk_xyz[chunk, 0, j]
                    fresh[1, n] = chunk_xyz[chunk, 1, j]
                    fresh[2, n] = chunk_xyz[chunk, 2, j]
                    n += 1
            left -= here
            chunk = chunk_next[chunk]
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def is_reached(points, row, fresh, n_fresh):
    """True when a new point lies within the radius of a point."""
    x, y, z = float(points[row].x), float(points[row].y), float(points[row].z)
    reach = math.floor((points[row].radius_mm / QUANTUM_MM) ** 2)
    reached = False
    for k in range(n_fresh):
        dx, dy, dz = fresh[0, k] - x, fresh[1, k] - y, fresh[2, k] - z
        reached |= dx * dx + dy * dy + dz * dz <= reach + 1.0
    return reached


@njit(cache=True, nogil=True, error_model="numpy")
def gather_wide(grid, cell, limit_mm, wide):
    """All points as far as a radius may grow: the buffer, a larger one if need be, and how many it holds."""
    rings = min(4, math.ceil(limit_mm / (grid.side_q[0] * QUANTUM_MM)))
    found = np.empty(729, dtype=np.int64)
    n_found, n = cells_around(
        grid.cell_at, grid.cell_block, grid.cell_count, grid.block_key, grid.block_near, grid.block_cell,
        cell, rings, found,
    )  # fmt: skip
    if n + VECTOR > wide.shape[1]:
        wide = np.empty((4, 2 * n + VECTOR))
    gather(grid.chunk_next, grid.chunk_xyz, grid.chunk_line, grid.cell_first, grid.cell_count, found, n_found, wide)
    return wide, n
