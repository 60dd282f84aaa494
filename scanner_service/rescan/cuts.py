"""Cuts through hidden surface: the points near a plane as a chain, and the rays through its steps; kernels.

They check nothing, and know no map. What comes out does not hang on the order of the points, nor on points outside of a
cut. Lengths are millimetres in the part frame, k counts gaps, n points. A gap goes from its start along its unit way to
its end; its cut is the plane through it with the unit normal, and what it hides lies in it along normal x way.

Points stand in columns, a tuple of: places (n, 3), where each column begins (c + 1,), the lowest corner (2,), the side,
and how many columns there are along x and along y.
"""

import math

import numpy as np
from numba import njit

STEPS = 3  # so many steps of a chain are told at most
DETOUR = 1.8  # a way over hidden surface is at most so much longer than the straight one
_TOUCHING = 2.0  # radii: so far apart the neighbourhoods of two points touch
_SHARE = 0.6  # ... but no step is longer than this share of the gap itself
_THIN = 0.35  # steps: of points closer than that one will do
_SIDE = 256  # cells across a cut
_MOST = 512  # points of a cut; with more they are thinned again
_SLACK_MM = 1e-6  # by which columns are looked for around a window
_BEHIND = 0.1  # of a step: a ray goes through it when its return lies so far behind, and ...
_NEAR = 3.0  # steps: returns further from the middle of one are not asked
_RAYS = 2  # ... so many through each third of it are no strays


@njit(cache=True, nogil=True, error_model="numpy")
def find_steps(columns, rows, groups, borders, starts, ends, ways, normals, own, reaches, found, alone):
    """The steps over nothing of the chain from each start to its end, the widest first.

    `rows` (n,) and `groups` (n,) are the points' rows and passes, `borders` whether a row of the map may be where
    surface ends, `own` (k,) the gaps' passes, `reaches` (k,) their radii. Written are `found` (k, STEPS, 2), the rows
    at both ends of each step, -1 where there are fewer, and `alone` (k,), True where no other pass has a point in the
    cut. On entry `found` holds the rows of the start and the end; where a gap is alone it still does.
    """
    taken, seen = np.full((_SIDE, _SIDE), -1, dtype=np.int64), np.zeros((_SIDE, _SIDE), dtype=np.bool_)
    u, v, row = np.empty(_SIDE * _SIDE), np.empty(_SIDE * _SIDE), np.empty(_SIDE * _SIDE, dtype=np.int64)
    for k in range(len(starts)):
        length = math.sqrt(((ends[k] - starts[k]) ** 2).sum())
        fine = max(_THIN * min(_TOUCHING * reaches[k], _SHARE * length), 1.01 * DETOUR * length / _SIDE)
        while True:
            count, others = _cut(
                columns, rows, groups, borders, starts[k], length, ways[k], normals[k], own[k], reaches[k], fine,
                taken, seen, u, v, row,
            )  # fmt: skip
            if count <= _MOST:
                break
            fine *= 1.5
        alone[k] = not others
        if not others:
            continue
        first, last = found[k, 0]
        u[count], v[count], row[count] = length, 0.0, last
        before, width = _chain(u, v, count, reaches[k])
        enough = max(min(_TOUCHING * reaches[k], _SHARE * length), fine / _THIN)  # thinned points are further apart
        found[k] = -1
        for n in range(STEPS):
            widest, at = -1, count
            while at >= 0:
                one = row[before[at]] if before[at] >= 0 else first
                if (
                    width[at] > enough
                    and (borders[one] or borders[row[at]])
                    and (widest < 0 or width[at] > width[widest])
                ):
                    widest = at
                at = before[at]
            if widest < 0:
                break
            found[k, n, 0] = row[before[widest]] if before[widest] >= 0 else first
            found[k, n, 1] = row[widest]
            width[widest] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _cut(columns, rows, groups, borders, start, length, way, normal, own, reach, fine, taken, seen, u, v, row):
    """The points near the plane of a gap, one a cell of side `fine`: how many, and whether other passes have any.

    Of those in a cell one at a border stands for all, then the one of the lowest row. `u` along the gap, `v` across it
    and `row` are written; `taken` is all -1 before and after. Points for which the way by them is longer than DETOUR
    times the gap are left out, an ellipse around it; so are those on the side that the gap does not hide, and cells in
    which its own pass `own` has a point: what that has seen is not hidden from it. `seen` is False before and after.
    """
    places, begin, lowest, side, many_x, many_y = columns
    across = np.cross(normal, way)
    count = 0
    half, rest = 0.5 * DETOUR * length, 0.5 * math.sqrt(DETOUR * DETOUR - 1.0) * length
    first, last = np.empty(2, dtype=np.int64), np.empty(2, dtype=np.int64)
    for axis in range(2):
        extent = math.sqrt((half * way[axis]) ** 2 + (rest * across[axis]) ** 2) + reach * abs(normal[axis]) + _SLACK_MM
        middle = start[axis] + 0.5 * length * way[axis] - lowest[axis]
        first[axis] = max(0, math.floor((middle - extent) / side))
        last[axis] = math.floor((middle + extent) / side)
    for i in range(first[0], min(last[0], many_x - 1) + 1):
        for j in range(first[1], min(last[1], many_y - 1) + 1):
            for n in range(begin[i * many_y + j], begin[i * many_y + j + 1]):
                x, y, z = places[n, 0] - start[0], places[n, 1] - start[1], places[n, 2] - start[2]
                if abs(x * normal[0] + y * normal[1] + z * normal[2]) > reach:
                    continue
                a = x * way[0] + y * way[1] + z * way[2]
                b = x * across[0] + y * across[1] + z * across[2]
                if b < -reach:
                    continue
                if math.sqrt(a * a + b * b) + math.sqrt((a - length) ** 2 + b * b) > DETOUR * length:
                    continue
                p = int((a - 0.5 * length + half) / fine)
                q = int((b + half) / fine)
                if groups[n] == own:
                    seen[p, q] = True
                    continue
                at = taken[p, q]
                if at < 0:
                    at = taken[p, q] = count
                    count += 1
                elif borders[rows[n]] < borders[row[at]] or (
                    borders[rows[n]] == borders[row[at]] and rows[n] > row[at]
                ):
                    continue
                u[at], v[at], row[at] = a, b, rows[n]
    others, kept = count > 0, 0
    for n in range(count):
        p, q = int((u[n] - 0.5 * length + half) / fine), int((v[n] + half) / fine)
        taken[p, q] = -1
        if not seen[p, q]:
            u[kept], v[kept], row[kept] = u[n], v[n], row[n]
            kept += 1
    seen[:] = False
    return kept, others


@njit(cache=True, nogil=True, error_model="numpy")
def _chain(u, v, last, slack):
    """Prim's tree over places (u, v) from (0, 0) until it reaches the place `last`.

    Of all ways there it has the one whose widest step is the least. For each place the one before it (-1: the start),
    and the width of the step between; the first and the last are shorter by `slack`, since what the gap's own pass saw
    around both ends is left out.
    """
    width, before = (
        np.maximum(np.sqrt(u[: last + 1] ** 2 + v[: last + 1] ** 2) - slack, 0.0),
        np.full(last + 1, -1, dtype=np.int64),
    )
    done = np.zeros(last + 1, dtype=np.bool_)
    while True:
        at = -1
        for n in range(last + 1):
            if not done[n] and (at < 0 or width[n] < width[at]):
                at = n
        done[at] = True
        if at == last:
            return before, width
        for n in range(last + 1):
            if not done[n]:
                away = math.sqrt((u[n] - u[at]) ** 2 + (v[n] - v[at]) ** 2)
                if n == last:
                    away = max(away - slack, 0.0)
                if away < width[n]:
                    width[n], before[n] = away, at


@njit(cache=True, nogil=True, error_model="numpy")
def find_crossed(columns, lasers, firsts, lasts, normals, reaches, middles, halves, crossed):
    """Write `crossed` (k,): whether rays go through each third of the steps from `firsts` to `lasts` (k, 3).

    `lasers` (n, 3) is where the ray to each point began. Points are asked within `halves` (k,) of `middles` (k, 3),
    axis by axis, and not far from the step. A ray goes through a step where it meets the band beside it, as wide as the
    radius on both sides along the normal of the cut.
    """
    places, begin, lowest, side, many_x, many_y = columns
    count, low, high = np.zeros(3, dtype=np.int64), np.empty(3), np.empty(3)
    for k in range(len(firsts)):
        way = lasts[k] - firsts[k]
        step = math.sqrt((way * way).sum())
        across = np.cross(normals[k], way) / step
        for axis in range(3):
            middle = 0.5 * (firsts[k, axis] + lasts[k, axis])
            low[axis] = max(middle - _NEAR * step, middles[k, axis] - halves[k])
            high[axis] = min(middle + _NEAR * step, middles[k, axis] + halves[k])
        i0, j0 = max(0, math.floor((low[0] - lowest[0]) / side)), max(0, math.floor((low[1] - lowest[1]) / side))
        i1, j1 = math.floor((high[0] - lowest[0]) / side), math.floor((high[1] - lowest[1]) / side)
        count[:] = 0
        for i in range(i0, min(i1, many_x - 1) + 1):
            for j in range(j0, min(j1, many_y - 1) + 1):
                for n in range(begin[i * many_y + j], begin[i * many_y + j + 1]):
                    x, y, z = places[n, 0], places[n, 1], places[n, 2]
                    if low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]:
                        at = _third(places[n], lasers[n], firsts[k], way, step, across, normals[k], reaches[k])
                        if at >= 0:
                            count[at] += 1
        crossed[k] = count.min() >= _RAYS


@njit(cache=True, nogil=True, error_model="numpy")
def _third(place, laser, first, way, step, across, normal, reach):
    """Through which third of a step the ray to a place goes: 0, 1 or 2; -1 for none."""
    a, b, c = place[0] - first[0], place[1] - first[1], place[2] - first[2]
    behind = a * across[0] + b * across[1] + c * across[2]
    p, q, r = laser[0] - place[0], laser[1] - place[1], laser[2] - place[2]
    towards = p * across[0] + q * across[1] + r * across[2]
    if abs(behind) < _BEHIND * step or behind * towards >= 0 or abs(towards) < abs(behind):
        return -1
    share = -behind / towards
    a, b, c = a + share * p, b + share * q, c + share * r
    if abs(a * normal[0] + b * normal[1] + c * normal[2]) > reach:
        return -1
    at = math.floor(3.0 * (a * way[0] + b * way[1] + c * way[2]) / (step * step))
    return at if 0 <= at < 3 else -1


def compile_cuts() -> None:
    """Run both kernels over two points, so that they are compiled or loaded from the cache."""
    places, start, end, along = (
        np.array([[0.0, 0, 0], [0, 0, -1]]),
        np.zeros((1, 3)),
        np.array([[0.0, 0, -1]]),
        np.eye(3),
    )
    columns = (places, np.array([0, 2]), np.zeros(2), 1.0, 1, 1)
    two, one, reach = np.array([0, 1]), np.zeros(1, np.int64), np.ones(1)
    found, crossed = np.zeros((1, STEPS, 2), np.int64), np.zeros(1, np.bool_)
    borders = np.zeros(2, np.bool_)
    find_steps(columns, two, two, borders, start, end, end, along[:1], one, reach, found, crossed)
    find_crossed(columns, places, start, end, along[:1], reach, start, reach, crossed)
