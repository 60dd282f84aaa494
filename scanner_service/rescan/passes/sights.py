"""Sights from places through cells: what hides them is hidden space, and known surface where they cross its plane.

Kernels that check nothing. A cell of surface is wider than the surface in it: a sight that stays on the side from which
the surface was seen, on its way through the cell, passes beside it.
"""

import math

import numpy as np
from numba import njit

from scanner_service.rescan.passes.marching import HIDDEN, SURFACE, enter_cells

CLEAR = 3.0
"""Cells that a sight goes before anything is in its way: beside an inner edge the other wall begins that near, and
where hidden space begins is rough."""

LIFT = 0.5
"""Cells above its place from which a sight begins."""

BENEATH = 0.5
"""Cells that a sight may go beneath the plane of a cell's points: they are noisy, and their mean rounds an edge."""

ROUGH = 2.0
"""Cells within which hidden space may be left and entered again: where it begins is rough."""


@njit(cache=True, nogil=True, error_model="numpy")
def _is_hidden(state, index, points, normals, low, cell, x, y, z, dx, dy, dz, start, end):
    """Whether hidden space or known surface stands in the way of a ray between two distances.

    `index` (the grid's shape) is the row of `points`, `normals` (m, 3) that a cell of surface has; without one, or with
    the normal 0 of a wall that was seen from both sides, the whole cell stands in the way.
    """
    i, j, k, si, sj, sk, ti, tj, tk, mi, mj, mk = enter_cells(low, cell, x, y, z, dx, dy, dz, start)
    at = 0.0
    ni, nj, nk = state.shape
    while start + at < end:
        if i < 0 or j < 0 or k < 0 or i >= ni or j >= nj or k >= nk:
            return False
        if state[i, j, k] == HIDDEN:
            return True
        if state[i, j, k] > HIDDEN:
            row = index[i, j, k]
            if row < 0:
                return True
            nx, ny, nz = normals[row, 0], normals[row, 1], normals[row, 2]
            if nx == 0 and ny == 0 and nz == 0:
                return True
            rising = nx * dx + ny * dy + nz * dz
            begun = start + at
            height = (
                (x + begun * dx - points[row, 0]) * nx
                + (y + begun * dy - points[row, 1]) * ny
                + (z + begun * dz - points[row, 2]) * nz
            )
            left = min(mi, mj, mk) - at
            if min(height, height + left * rising) < -BENEATH * cell:
                return True
        if mi <= mj and mi <= mk:
            at, mi, i = mi, mi + ti, i + si
        elif mj <= mk:
            at, mj, j = mj, mj + tj, j + sj
        else:
            at, mk, k = mk, mk + tk, k + sk
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def clear_ways(state, index, points, facing, low, cell, places, normals, directions, least_cosine, out):
    """Whether each place (n, 3) sees far along each direction (d, 3); False below `least_cosine` to its normal."""
    lift, clear = LIFT * cell, CLEAR * cell
    for n in range(len(places)):
        x, y, z = (places[n, 0] + lift * normals[n, 0], places[n, 1] + lift * normals[n, 1],
                   places[n, 2] + lift * normals[n, 2])  # fmt: skip
        for d in range(len(directions)):
            dx, dy, dz = directions[d, 0], directions[d, 1], directions[d, 2]
            out[n, d] = False
            if dx * normals[n, 0] + dy * normals[n, 1] + dz * normals[n, 2] >= least_cosine:
                out[n, d] = not _is_hidden(
                    state, index, points, facing, low, cell, x, y, z, dx, dy, dz, clear, np.inf
                )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def clear_sights(state, index, points, facing, low, cell, places, normals, targets, asked, out):
    """Whether each place (n, 3) sees its own target (n, 3); only where `asked`, False elsewhere."""
    lift, clear = LIFT * cell, CLEAR * cell
    for n in range(len(places)):
        out[n] = False
        if not asked[n]:
            continue
        x, y, z = (places[n, 0] + lift * normals[n, 0], places[n, 1] + lift * normals[n, 1],
                   places[n, 2] + lift * normals[n, 2])  # fmt: skip
        dx, dy, dz = targets[n, 0] - x, targets[n, 1] - y, targets[n, 2] - z
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length > 0:
            dx, dy, dz = dx / length, dy / length, dz / length
            out[n] = not _is_hidden(
                state, index, points, facing, low, cell, x, y, z, dx, dy, dz, clear, length
            )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def follow_hidden(state, index, normals, two_sided, low, cell, places, ways, length, stopped):
    """How far hidden space goes on from places (n, 3) along their ways; whether the back of known surface ends it."""
    ni, nj, nk = state.shape
    longest = 2.0 * cell * (ni + nj + nk)
    for n in range(len(places)):
        gone = 0.0
        while gone < longest:
            i = math.floor((places[n, 0] + gone * ways[n, 0] - low[0]) / cell)
            j = math.floor((places[n, 1] + gone * ways[n, 1] - low[1]) / cell)
            k = math.floor((places[n, 2] + gone * ways[n, 2] - low[2]) / cell)
            if i < 0 or j < 0 or k < 0 or i >= ni or j >= nj or k >= nk:
                break
            if gone > ROUGH * cell and state[i, j, k] == SURFACE:
                row = index[i, j, k]
                if row < 0 or two_sided[row]:
                    stopped[n] = True
                else:
                    facing = normals[row, 0] * ways[n, 0] + normals[row, 1] * ways[n, 1] + normals[row, 2] * ways[n, 2]
                    stopped[n] = facing > 0
                break
            if gone > ROUGH * cell and state[i, j, k] < HIDDEN:
                break
            gone += 0.5 * cell
        length[n] = gone
