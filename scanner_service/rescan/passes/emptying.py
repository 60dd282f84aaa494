"""Hidden cells that a pass looked into in vain; a kernel that checks nothing."""

import math

from numba import njit

from scanner_service.rescan.passes.marching import FREE, HIDDEN, SURFACE

EMPTY = 4
"""Found empty by the look that is being gone through: still in the way, until the look is over."""

ROUGH = 5
"""Steps within which a way may enter hidden cells again: where hidden space begins is rough by a cell or two."""


@njit(cache=True, nogil=True, error_model="numpy")
def _way_out(state, low, cell, x, y, z, tx, ty, tz):
    """From a hidden place towards a target: (True, last hidden cell) when the way leaves what is hidden just once."""
    dx, dy, dz = tx - x, ty - y, tz - z
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    step = 0.7 * cell / length
    ni, nj, nk = state.shape
    li, lj, lk = -1, -1, -1
    steps_out = 0
    share = 0.0
    while share < 1.0:
        i = math.floor((x + share * dx - low[0]) / cell)
        j = math.floor((y + share * dy - low[1]) / cell)
        k = math.floor((z + share * dz - low[2]) / cell)
        if i < 0 or j < 0 or k < 0 or i >= ni or j >= nj or k >= nk:
            return True, li, lj, lk
        here = state[i, j, k]
        if here == EMPTY:
            here = HIDDEN
        if here == SURFACE or (here == HIDDEN and steps_out > ROUGH):
            return False, li, lj, lk
        if here == HIDDEN:
            li, lj, lk = i, j, k
        else:
            steps_out += 1
        share += step
    return True, li, lj, lk


@njit(cache=True, nogil=True, error_model="numpy")
def empty_places(
    state, low, cell, rotation, origin, travel, along, start, step, returned, laser, camera, lowest, highest, middle,
    view, entry, normals, least_cosine,
):  # fmt: skip
    """Make FREE the HIDDEN cells in the swept volume of a pass that would have shown surface; returns how many."""
    ni, nj, nk = state.shape
    count, rays = returned.shape
    freed = 0
    for i in range(ni):
        for j in range(nj):
            for k in range(nk):
                if state[i, j, k] != HIDDEN:
                    continue
                x, y, z = low[0] + (i + 0.5) * cell, low[1] + (j + 0.5) * cell, low[2] + (k + 0.5) * cell
                ox, oy, oz = x - origin[0], y - origin[1], z - origin[2]
                ly = ox * rotation[0, 1] + oy * rotation[1, 1] + oz * rotation[2, 1]
                s = ly / along[1]
                line = (s - start) / step
                if line < 0 or line > count - 1:
                    continue
                lx = ox * rotation[0, 0] + oy * rotation[1, 0] + oz * rotation[2, 0] - s * along[0]
                lz = ox * rotation[0, 2] + oy * rotation[1, 2] + oz * rotation[2, 2] - s * along[2]
                if lz < lowest or lz > highest:
                    continue
                at_zero = laser[0] + (lx - laser[0]) * laser[2] / (laser[2] - lz)
                ray = ((at_zero - middle) / view + 0.5) * (rays - 1)
                if ray < 0 or ray > rays - 1:
                    continue
                if returned[int(line + 0.5), int(ray + 0.5)]:
                    continue
                px, py, pz = origin[0] + s * travel[0], origin[1] + s * travel[1], origin[2] + s * travel[2]
                ax = px + rotation[0, 0] * laser[0] + rotation[0, 1] * laser[1] + rotation[0, 2] * laser[2]
                ay = py + rotation[1, 0] * laser[0] + rotation[1, 1] * laser[1] + rotation[1, 2] * laser[2]
                az = pz + rotation[2, 0] * laser[0] + rotation[2, 1] * laser[1] + rotation[2, 2] * laser[2]
                fine, ei, ej, ek = _way_out(state, low, cell, x, y, z, ax, ay, az)
                if not fine or ei < 0:
                    continue
                at = entry[ei, ej, ek]
                if at >= 0:
                    fx, fy, fz = ax - x, ay - y, az - z
                    size = math.sqrt(fx * fx + fy * fy + fz * fz)
                    cosine = (fx * normals[at, 0] + fy * normals[at, 1] + fz * normals[at, 2]) / size
                    if cosine < least_cosine:
                        continue
                cx = px + rotation[0, 0] * camera[0] + rotation[0, 1] * camera[1] + rotation[0, 2] * camera[2]
                cy = py + rotation[1, 0] * camera[0] + rotation[1, 1] * camera[1] + rotation[1, 2] * camera[2]
                cz = pz + rotation[2, 0] * camera[0] + rotation[2, 1] * camera[1] + rotation[2, 2] * camera[2]
                fine, _, _, _ = _way_out(state, low, cell, x, y, z, cx, cy, cz)
                if not fine:
                    continue
                if ei != i or ej != j or ek != k:
                    ex, ey, ez = low[0] + (ei + 0.5) * cell, low[1] + (ej + 0.5) * cell, low[2] + (ek + 0.5) * cell
                    fine, _, _, _ = _way_out(state, low, cell, ex, ey, ez, cx, cy, cz)
                    if not fine:
                        continue
                # not before the next look: what is freed now must not clear the way for its neighbours
                state[i, j, k] = EMPTY
                freed += 1
    for i in range(ni):
        for j in range(nj):
            for k in range(nk):
                if state[i, j, k] == EMPTY:
                    state[i, j, k] = FREE
    return freed
