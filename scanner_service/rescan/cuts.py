"""Cuts through hidden surface: the points near a plane as a chain, and the rays through its steps; kernels.

They check nothing, and know no map. What comes in does not hang on the order of the points, or on how many more there
are outside of a cut.
"""

import math

import numpy as np
from numba import njit

NOTHING, AIR = -1, -2
DETOUR = 1.8  # a way over hidden surface is at most so much longer than the straight one
_TOUCHING = 2.0  # radii: so far apart the neighbourhoods of two points touch
_SHARE = 0.6  # ... but no step is longer than this share of the gap itself
_THIN = 0.35  # steps: of points closer than that one will do
_SIDE = 128  # cells across a cut
_BEHIND = 0.1  # of a step: a ray goes through it when its return lies so far behind, and ...
_NEAR = 3.0  # steps: returns further from the middle of one are not asked
_RAYS = 2  # ... so many through each third of it are no strays
_MOST = 512  # points of a cut; with more they are thinned again


@njit(cache=True, nogil=True, error_model="numpy")
def find_widest_steps(
    columns, rows, groups, borders, starts, ends, ways, normals, own, reaches, found
):  # fmt: skip
    """Write into `found` (k, 2) the rows between which the chain from each start to its end has its widest step."""
    taken = np.full((_SIDE, _SIDE), -1, dtype=np.int64)
    u, v, row = np.empty(_SIDE * _SIDE), np.empty(_SIDE * _SIDE), np.empty(_SIDE * _SIDE, dtype=np.int64)
    for k in range(len(starts)):
        length = math.sqrt(((ends[k] - starts[k]) ** 2).sum())
        step = min(_TOUCHING * reaches[k], _SHARE * length)
        fine = max(_THIN * step, 1.01 * DETOUR * length / _SIDE)
        across = np.cross(normals[k], ways[k])
        while True:
            count, others = _cut(
                columns, rows, groups, borders, starts[k], length, ways[k], across, normals[k], own[k], reaches[k],
                fine, taken, u, v, row,
            )  # fmt: skip
            if count <= _MOST:
                break
            fine *= 1.5
        if not others:
            continue
        u[count], v[count], row[count] = length, 0.0, found[k, 1]
        before, after, widest = _widest_step(u, v, count)
        first = row[before] if before >= 0 else found[k, 0]
        if widest <= step or not (borders[first] or borders[row[after]]):
            found[k, 0] = found[k, 1] = NOTHING
        else:
            found[k, 0], found[k, 1] = first, row[after]


@njit(cache=True, nogil=True, error_model="numpy")
def _cut(
    columns, rows, groups, borders, start, length, way, across, normal, own, reach, fine, taken, u, v, row
):  # fmt: skip
    """The points near the plane of a gap, one a cell of side `fine`: how many, and whether other passes have any."""
    places, begin, lowest, side, wide, long = columns
    count, others = 0, False
    half, rest = 0.5 * DETOUR * length, 0.5 * math.sqrt(DETOUR * DETOUR - 1.0) * length
    first, last = np.empty(2, dtype=np.int64), np.empty(2, dtype=np.int64)
    for axis in range(2):
        extent = math.sqrt((half * way[axis]) ** 2 + (rest * across[axis]) ** 2) + reach * abs(normal[axis])
        middle = start[axis] + 0.5 * length * way[axis] - lowest[axis]
        first[axis] = max(0, math.floor((middle - extent) / side))
        last[axis] = math.floor((middle + extent) / side)
    for i in range(first[0], min(last[0], wide - 1) + 1):
        for j in range(first[1], min(last[1], long - 1) + 1):
            for n in range(begin[i * long + j], begin[i * long + j + 1]):
                x, y, z = places[n, 0] - start[0], places[n, 1] - start[1], places[n, 2] - start[2]
                if abs(x * normal[0] + y * normal[1] + z * normal[2]) > reach:
                    continue
                a = x * way[0] + y * way[1] + z * way[2]
                b = x * across[0] + y * across[1] + z * across[2]
                if math.sqrt(a * a + b * b) + math.sqrt((a - length) ** 2 + b * b) > DETOUR * length:
                    continue
                others |= groups[n] != own
                p = int((a - 0.5 * length + half) / fine)
                q = int((b + half) / fine)
                if taken[p, q] < 0:
                    taken[p, q] = count
                    u[count], v[count], row[count] = a, b, rows[n]
                    count += 1
                    continue
                at = taken[p, q]
                is_border, was_border = borders[rows[n]], borders[row[at]]
                if is_border > was_border or (is_border == was_border and rows[n] < row[at]):  # in whatever order
                    u[at], v[at], row[at] = a, b, rows[n]
    for n in range(count):
        taken[int((u[n] - 0.5 * length + half) / fine), int((v[n] + half) / fine)] = -1
    return count, others


@njit(cache=True, nogil=True, error_model="numpy")
def _widest_step(u, v, last):
    """The widest step of the chain from (0, 0) to the place `last` whose widest step is the least; -1: the start.

    Prim's tree over the places, grown from the start until it reaches the last.
    """
    best, before = np.empty(last + 1), np.full(last + 1, -1, dtype=np.int64)
    done = np.zeros(last + 1, dtype=np.bool_)
    for n in range(last + 1):
        best[n] = math.sqrt(u[n] * u[n] + v[n] * v[n])
    while True:
        at = -1
        for n in range(last + 1):
            if not done[n] and (at < 0 or best[n] < best[at]):
                at = n
        done[at] = True
        if at == last:
            break
        for n in range(last + 1):
            if not done[n]:
                away = math.sqrt((u[n] - u[at]) ** 2 + (v[n] - v[at]) ** 2)
                if away < best[n]:
                    best[n], before[n] = away, at
    widest = last
    at = before[last]
    while at >= 0:
        if best[at] > best[widest]:
            widest = at
        at = before[at]
    return before[widest], widest, best[widest]


@njit(cache=True, nogil=True, error_model="numpy")
def find_crossed(columns, lasers, firsts, lasts, normals, reaches, middles, halves, crossed):
    """Note (k,) which steps the rays to some returns go through, in the middle; returns in the window are looked at."""
    places, begin, lowest, side, wide, long = columns
    count, low, high = np.zeros(3, dtype=np.int64), np.empty(3), np.empty(3)
    for k in range(len(firsts)):
        if crossed[k]:
            continue
        e, f, g = lasts[k] - firsts[k]
        step = math.sqrt(e * e + f * f + g * g)
        m = np.cross(normals[k], lasts[k] - firsts[k])
        m /= math.sqrt((m * m).sum())
        near = _NEAR * step
        for axis in range(3):
            middle = 0.5 * (firsts[k, axis] + lasts[k, axis])
            low[axis] = max(middle - near, middles[k, axis] - halves[k])
            high[axis] = min(middle + near, middles[k, axis] + halves[k])
        i0, j0 = max(0, math.floor((low[0] - lowest[0]) / side)), max(0, math.floor((low[1] - lowest[1]) / side))
        i1, j1 = math.floor((high[0] - lowest[0]) / side), math.floor((high[1] - lowest[1]) / side)
        count[:] = 0
        for i in range(i0, min(i1, wide - 1) + 1):
            for j in range(j0, min(j1, long - 1) + 1):
                if count.min() >= _RAYS:
                    continue
                for n in range(begin[i * long + j], begin[i * long + j + 1]):
                    x, y, z = places[n, 0], places[n, 1], places[n, 2]
                    if x < low[0] or y < low[1] or z < low[2] or x > high[0] or y > high[1] or z > high[2]:
                        continue
                    a, b, c = x - firsts[k, 0], y - firsts[k, 1], z - firsts[k, 2]
                    behind = a * m[0] + b * m[1] + c * m[2]
                    p, q, r = lasers[n, 0] - x, lasers[n, 1] - y, lasers[n, 2] - z
                    towards = p * m[0] + q * m[1] + r * m[2]
                    if abs(behind) < _BEHIND * step or behind * towards >= 0 or abs(towards) < abs(behind):
                        continue
                    share = -behind / towards
                    a, b, c = a + share * p, b + share * q, c + share * r
                    if abs(a * normals[k, 0] + b * normals[k, 1] + c * normals[k, 2]) > reaches[k]:
                        continue
                    at = math.floor(3.0 * (a * e + b * f + c * g) / (step * step))
                    if 0 <= at < 3:
                        count[at] += 1
        crossed[k] = count.min() >= _RAYS
