"""Rays through a grid of cells: carved free, marked as hidden, or asked what stops them; kernels that check nothing."""

import math

import numpy as np
from numba import njit

UNTOUCHED, FREE, HIDDEN, SURFACE = 0, 1, 2, 3
AIR = 2
"""So many cells around a point must rays have gone through before it hangs in the air."""


@njit(cache=True, nogil=True, error_model="numpy")
def enter_cells(low, cell, x, y, z, dx, dy, dz, start):
    """A ray that goes from cell to cell (Amanatides and Woo 1987), at `start` mm of its way from x, y, z.

    Its cell, the sign of a step along each axis, and how far apart borders of cells are along the ray, then how far
    from `start` the next one is, axis by axis.
    """
    x, y, z = (x + start * dx - low[0]) / cell, (y + start * dy - low[1]) / cell, (z + start * dz - low[2]) / cell
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    si, sj, sk = (1 if dx > 0 else -1), (1 if dy > 0 else -1), (1 if dz > 0 else -1)
    ti = cell / abs(dx) if dx != 0 else np.inf
    tj = cell / abs(dy) if dy != 0 else np.inf
    tk = cell / abs(dz) if dz != 0 else np.inf
    mi = ((i + 1 - x) if si > 0 else (x - i)) * ti if dx != 0 else np.inf
    mj = ((j + 1 - y) if sj > 0 else (y - j)) * tj if dy != 0 else np.inf
    mk = ((k + 1 - z) if sk > 0 else (z - k)) * tk if dz != 0 else np.inf
    return i, j, k, si, sj, sk, ti, tj, tk, mi, mj, mk


@njit(cache=True, nogil=True, error_model="numpy")
def first_stop(state, low, cell, x, y, z, dx, dy, dz, start, end):
    """Distance along a ray at which it enters a cell that is HIDDEN or SURFACE; inf when none does before `end`."""
    i, j, k, si, sj, sk, ti, tj, tk, mi, mj, mk = enter_cells(low, cell, x, y, z, dx, dy, dz, start)
    at = 0.0
    ni, nj, nk = state.shape
    while start + at < end:
        if i < 0 or j < 0 or k < 0 or i >= ni or j >= nj or k >= nk:
            return np.inf
        if state[i, j, k] >= HIDDEN:
            return start + at
        if mi <= mj and mi <= mk:
            at, mi, i = mi, mi + ti, i + si
        elif mj <= mk:
            at, mj, j = mj, mj + tj, j + sj
        else:
            at, mk, k = mk, mk + tk, k + sk
    return np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def first_known(state, low, cell, lasers, way, enters, leaves, points, first, in_air):
    """The flat index of the SURFACE cell that stops each ray first (-1: another or none), and who hangs in air."""
    ni, nj, nk = state.shape
    for n in range(len(points)):
        i = math.floor((points[n, 0] - low[0]) / cell)
        j = math.floor((points[n, 1] - low[1]) / cell)
        k = math.floor((points[n, 2] - low[2]) / cell)
        if AIR <= i < ni - AIR and AIR <= j < nj - AIR and AIR <= k < nk - AIR:
            alone = True
            for a in range(-AIR, AIR + 1):
                for b in range(-AIR, AIR + 1):
                    for c in range(-AIR, AIR + 1):
                        alone &= state[i + a, j + b, k + c] == FREE
            in_air[n] = alone
        if enters[n] >= leaves[n]:
            continue
        x, y, z = lasers[n, 0], lasers[n, 1], lasers[n, 2]
        dx, dy, dz = way[n, 0], way[n, 1], way[n, 2]
        stop = first_stop(state, low, cell, x, y, z, dx, dy, dz, enters[n], leaves[n])
        if stop == np.inf:
            continue
        stop += 1e-6
        i = math.floor((x + stop * dx - low[0]) / cell)
        j = math.floor((y + stop * dy - low[1]) / cell)
        k = math.floor((z + stop * dz - low[2]) / cell)
        if 0 <= i < ni and 0 <= j < nj and 0 <= k < nk and state[i, j, k] == SURFACE:
            first[n] = (i * nj + j) * nk + k


@njit(cache=True, nogil=True, error_model="numpy")
def _mark(state, low, cell, x, y, z, dx, dy, dz, start, end, mark):
    """Write `mark` into the cells on a ray: FREE wherever no surface is, HIDDEN only where nothing is known."""
    i, j, k, si, sj, sk, ti, tj, tk, mi, mj, mk = enter_cells(low, cell, x, y, z, dx, dy, dz, start)
    at = 0.0
    ni, nj, nk = state.shape
    while start + at < end:
        if i < 0 or j < 0 or k < 0 or i >= ni or j >= nj or k >= nk:
            return
        here = state[i, j, k]
        if (mark == FREE and here != SURFACE) or here == UNTOUCHED:
            state[i, j, k] = mark
        if mi <= mj and mi <= mk:
            at, mi, i = mi, mi + ti, i + si
        elif mj <= mk:
            at, mj, j = mj, mj + tj, j + sj
        else:
            at, mk, k = mk, mk + tk, k + sk


@njit(cache=True, nogil=True, error_model="numpy")
def gather(points, use, line, pass_number, normals, fails, region, low, cell, index, sums, first, pass_bits):
    """Add up the points of each cell.

    `index` (the grid's shape) numbers the cells in the order in which they are met, -1 = none; `sums` (cells, 10) are
    x, y, z, normal's x, y, z, points, failing points, the number of a region (0: none), points with a normal. `first`
    (n,) is True for the first point that a pass has in a cell; `pass_bits` (cells,) remembers the passes. Returns the
    number of cells.
    """
    count = 0
    for row in range(len(points)):
        first[row] = False
        if not use[row]:
            continue
        i = int((points[row, 0] - low[0]) / cell)
        j = int((points[row, 1] - low[1]) / cell)
        k = int((points[row, 2] - low[2]) / cell)
        at = index[i, j, k]
        if at < 0:
            if count == len(sums):
                return -1
            at = count
            index[i, j, k] = at
            count += 1
        sums[at, 0] += points[row, 0]
        sums[at, 1] += points[row, 1]
        sums[at, 2] += points[row, 2]
        if normals[row, 0] == normals[row, 0]:
            sums[at, 3] += normals[row, 0]
            sums[at, 4] += normals[row, 1]
            sums[at, 5] += normals[row, 2]
            sums[at, 9] += 1.0
        sums[at, 6] += 1.0
        if fails[row]:
            sums[at, 7] += 1.0
            if region[row] > 0:
                sums[at, 8] = region[row]
        bit = np.uint64(1) << np.uint64(pass_number[line[row]] % 64)
        if not pass_bits[at] & bit:
            pass_bits[at] |= bit
            first[row] = True
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def carve(state, low, cell, rows, points, line, laser, depth):
    """Mark what each of some points hides behind it, up to `depth`, then free the way from each to its laser."""
    for turn in range(2):
        for n in range(len(rows)):
            row = rows[n]
            x, y, z = points[row, 0], points[row, 1], points[row, 2]
            dx, dy, dz = laser[line[row], 0] - x, laser[line[row], 1] - y, laser[line[row], 2] - z
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            if not length > 0:
                continue
            dx, dy, dz = dx / length, dy / length, dz / length
            if turn == 0:
                _mark(state, low, cell, x, y, z, -dx, -dy, -dz, 0.0, depth, HIDDEN)
            else:
                _mark(state, low, cell, x, y, z, dx, dy, dz, cell, length, FREE)


@njit(cache=True, nogil=True, error_model="numpy")
def fill_pockets(state, rounds):
    """Make HIDDEN what is UNTOUCHED among solid cells on four sides or more: rays part, and leave such pockets."""
    ni, nj, nk = state.shape
    for _ in range(rounds):
        for i in range(1, ni - 1):
            for j in range(1, nj - 1):
                for k in range(1, nk - 1):
                    if state[i, j, k] == UNTOUCHED:
                        solid = (
                            (state[i - 1, j, k] >= HIDDEN)
                            + (state[i + 1, j, k] >= HIDDEN)
                            + (state[i, j - 1, k] >= HIDDEN)
                            + (state[i, j + 1, k] >= HIDDEN)
                            + (state[i, j, k - 1] >= HIDDEN)
                            + (state[i, j, k + 1] >= HIDDEN)
                        )
                        if solid >= 4:
                            state[i, j, k] = HIDDEN


@njit(cache=True, nogil=True, error_model="numpy")
def outward(state, cells, out):
    """Direction (m, 3) from what is solid to what is empty around each of some cells (m, 3); not yet of length 1."""
    ni, nj, nk = state.shape
    for n in range(len(cells)):
        gx, gy, gz = 0.0, 0.0, 0.0
        for a in range(-3, 4):
            for b in range(-3, 4):
                for c in range(-3, 4):
                    squared = a * a + b * b + c * c
                    i, j, k = cells[n, 0] + a, cells[n, 1] + b, cells[n, 2] + c
                    if 0 < squared <= 9 and 0 <= i < ni and 0 <= j < nj and 0 <= k < nk:
                        sign = -1.0 if state[i, j, k] >= HIDDEN else 1.0
                        weight = sign / squared
                        gx, gy, gz = gx + weight * a, gy + weight * b, gz + weight * c
        out[n, 0], out[n, 1], out[n, 2] = gx, gy, gz


@njit(cache=True, nogil=True, error_model="numpy")
def share_around(mask, cells, out):
    """Share (m,) of the cells within three of each of some cells (m, 3) that are in a mask of the grid's shape."""
    ni, nj, nk = mask.shape
    for n in range(len(cells)):
        inside = 0
        for i in range(max(0, cells[n, 0] - 3), min(ni, cells[n, 0] + 4)):
            for j in range(max(0, cells[n, 1] - 3), min(nj, cells[n, 1] + 4)):
                for k in range(max(0, cells[n, 2] - 3), min(nk, cells[n, 2] + 4)):
                    inside += mask[i, j, k]
        out[n] = inside / 343.0


@njit(cache=True, nogil=True, error_model="numpy")
def open_faces(state, out):
    """Cells (the i, j, k of each, in rows of `out`) that are HIDDEN with an empty neighbour; returns how many.

    The outermost layer of the grid is left out: what is hidden there ends only because the grid does.
    """
    ni, nj, nk = state.shape
    count = 0
    for i in range(1, ni - 1):
        for j in range(1, nj - 1):
            for k in range(1, nk - 1):
                if state[i, j, k] != HIDDEN:
                    continue
                if (
                    state[i - 1, j, k] < HIDDEN
                    or state[i + 1, j, k] < HIDDEN
                    or state[i, j - 1, k] < HIDDEN
                    or state[i, j + 1, k] < HIDDEN
                    or state[i, j, k - 1] < HIDDEN
                    or state[i, j, k + 1] < HIDDEN
                ):
                    if count == len(out):
                        return count
                    out[count, 0], out[count, 1], out[count, 2] = i, j, k
                    count += 1
    return count
