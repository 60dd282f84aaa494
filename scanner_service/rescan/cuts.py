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
_KNOWN = 0.2  # radii: so near to the plane through a point of the gap's own pass a point shows nothing new
_BACKWARD = 0.3  # sine: a wide step goes back by at most so much along the surface at its ends
_ACROSS = 0.5  # a surface whose normal leans out of the cut by more than that has no direction in it
_THIN = 0.35  # steps: of points closer than that one will do
_SIDE = 256  # cells across a cut
_MOST = 512  # points of a cut; with more they are thinned again
_SLACK_MM = 1e-6  # by which columns are looked for around a window
_BEHIND = 0.1  # of a step: a ray goes through it when its return lies so far behind, and ...
_NEAR = 3.0  # steps: returns further from the middle of one are not asked
_RAYS = 2  # ... so many through each third of it are no strays


@njit(cache=True, nogil=True, error_model="numpy")
def find_steps(columns, rows, groups, normals, borders, starts, ends, ways, planes, own, reaches, found, alone):
    """The steps over nothing of the chain from each start to its end, the widest first.

    `rows` (n,), `groups` (n,) and `normals` (n, 3) are the points' rows, passes and normals, `borders` whether a row of
    the map may be where surface ends, `planes` (k, 3) the normals of the cuts, `own` (k,) the gaps' passes, `reaches`
    (k,) their radii. Written are `found` (k, STEPS, 2), the rows at both ends of each step, -1 where there are fewer,
    and `alone` (k,), True where no other pass has a point in the cut that shows anything new. On entry `found` holds
    the rows of the start and the end; where a gap is alone it still does.
    """
    taken, latest = np.full((_SIDE, _SIDE), -1, dtype=np.int64), np.full((_SIDE, _SIDE), -1, dtype=np.int64)
    own_points = (np.empty((len(rows), 6)), latest, np.empty(len(rows), dtype=np.int64))
    others_points = (np.empty(len(rows), dtype=np.int64), np.empty((len(rows), 2)))
    place, row = np.empty((_SIDE * _SIDE, 4)), np.empty(_SIDE * _SIDE, dtype=np.int64)
    for k in range(len(starts)):
        length = math.sqrt(((ends[k] - starts[k]) ** 2).sum())
        cut = (starts[k], length, ways[k], np.cross(planes[k], ways[k]), planes[k], reaches[k])
        many, others = _gather(columns, groups, normals, cut, own[k], own_points, others_points)
        fine = max(_THIN * min(_TOUCHING * reaches[k], _SHARE * length), 1.01 * DETOUR * length / _SIDE)
        while True:
            count = _thinned(
                columns[0], rows, normals, borders, cut, own_points, others_points, others, fine, taken, place, row
            )
            if count <= _MOST:
                break
            fine *= 1.5
        _clear(own_points, many, cut)
        alone[k] = count == 0
        if alone[k]:
            continue
        first, last = found[k, 0]
        place[count, 0], place[count, 1], row[count] = length, 0.0, last
        place[count, 2:] = 0.0
        before, width = _chain(place, row, count, reaches[k])
        enough = max(min(_TOUCHING * reaches[k], _SHARE * length), fine / _THIN)  # thinned points are further apart
        _widest(before, width, row, count, borders, first, enough, found[k])


@njit(cache=True, nogil=True, error_model="numpy")
def _widest(before, width, row, last, borders, first, enough, found):
    """Write the rows at both ends of the widest steps of a chain that are wider than `enough` and have a border."""
    found[:] = -1
    for n in range(STEPS):
        widest, here = -1, last
        while here >= 0:
            one = row[before[here]] if before[here] >= 0 else first
            if (
                width[here] > enough
                and (borders[one] or borders[row[here]])
                and (widest < 0 or width[here] > width[widest])
            ):
                widest = here
            here = before[here]
        if widest < 0:
            break
        found[n, 0] = row[before[widest]] if before[widest] >= 0 else first
        found[n, 1] = row[widest]
        width[widest] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _in_cut(place, cut):
    """How far along a gap and across it a point lies, and whether it lies in the cut.

    Points for which the way by them is longer than DETOUR times the gap are not in it, an ellipse around it; nor are
    those on the side that the gap does not hide.
    """
    start, length, way, across, plane, reach = cut
    x, y, z = place[0] - start[0], place[1] - start[1], place[2] - start[2]
    if abs(x * plane[0] + y * plane[1] + z * plane[2]) > reach:
        return 0.0, 0.0, False
    a = x * way[0] + y * way[1] + z * way[2]
    b = x * across[0] + y * across[1] + z * across[2]
    if b < -reach:
        return a, b, False
    return a, b, math.sqrt(a * a + b * b) + math.sqrt((a - length) ** 2 + b * b) <= DETOUR * length


@njit(cache=True, nogil=True, error_model="numpy")
def _cell(a, b, length, side):
    """The cell of a cut that a place lies in."""
    return int((a + 0.5 * (DETOUR - 1.0) * length) / side), int((b + 0.5 * DETOUR * length) / side)


@njit(cache=True, nogil=True, error_model="numpy")
def _wide(cut):
    """Side of the cells that the points of a gap's own pass are found by."""
    return max(cut[5], 1.01 * DETOUR * cut[1] / _SIDE)


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(columns, groups, normals, cut, own, own_points, others_points):
    """The points in a cut: how many of the gap's own pass there are, and how many of others.

    Written of its own are places and normals (n, 6), the last one in each wide cell, and the one before each there
    (n,); of others which they are (m,), and how far along the gap and across it (m, 2).
    """
    mine, latest, earlier = own_points
    theirs, at = others_points
    places, begin, lowest, side, many_x, many_y = columns
    start, length, way, across, plane, reach = cut
    half, rest = 0.5 * DETOUR * length, 0.5 * math.sqrt(DETOUR * DETOUR - 1.0) * length
    first, last = np.empty(2, dtype=np.int64), np.empty(2, dtype=np.int64)
    for axis in range(2):
        extent = math.sqrt((half * way[axis]) ** 2 + (rest * across[axis]) ** 2) + reach * abs(plane[axis]) + _SLACK_MM
        middle = start[axis] + 0.5 * length * way[axis] - lowest[axis]
        first[axis] = max(0, math.floor((middle - extent) / side))
        last[axis] = math.floor((middle + extent) / side)
    many, others = 0, 0
    for i in range(first[0], min(last[0], many_x - 1) + 1):
        for j in range(first[1], min(last[1], many_y - 1) + 1):
            for n in range(begin[i * many_y + j], begin[i * many_y + j + 1]):
                a, b, inside = _in_cut(places[n], cut)
                if not inside:
                    continue
                if groups[n] != own:
                    theirs[others], at[others, 0], at[others, 1] = n, a, b
                    others += 1
                    continue
                mine[many, :3], mine[many, 3:] = places[n], normals[n]
                p, q = _cell(a, b, length, _wide(cut))
                earlier[many], latest[p, q] = latest[p, q], many
                many += 1
    return many, others


@njit(cache=True, nogil=True, error_model="numpy")
def _clear(own_points, count, cut):
    """Empty the cells that hold the points of a gap's own pass."""
    mine, latest, _ = own_points
    for n in range(count):
        a, b, _ = _in_cut(mine[n], cut)
        latest[_cell(a, b, cut[1], _wide(cut))] = -1


@njit(cache=True, nogil=True, error_model="numpy")
def _is_known(place, a, b, cut, own_points):
    """Whether a point lies on the plane of one that the gap's own pass has, within its radius."""
    mine, latest, earlier = own_points
    p, q = _cell(a, b, cut[1], _wide(cut))
    reach = cut[5]
    for i in range(max(p - 1, 0), min(p + 2, _SIDE)):
        for j in range(max(q - 1, 0), min(q + 2, _SIDE)):
            n = latest[i, j]
            while n >= 0:
                x, y, z = place[0] - mine[n, 0], place[1] - mine[n, 1], place[2] - mine[n, 2]
                off = abs(x * mine[n, 3] + y * mine[n, 4] + z * mine[n, 5])
                if off <= _KNOWN * reach and x * x + y * y + z * z <= reach * reach:
                    return True
                n = earlier[n]
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _thinned(places, rows, normals, borders, cut, own_points, others_points, others, fine, taken, place, row):
    """The points of other passes that show something new, one a cell of side `fine`: how many.

    What the gap's own pass has seen is not hidden from it: points on its surface are left out. Of those in a cell one
    at a border stands for all, then the one of the lowest row. Written are `place`, how far along the gap and across
    it and which way its surface goes on, and `row`; `taken` is all -1 before and after.
    """
    theirs, at = others_points
    count = 0
    for m in range(others):
        n, a, b = theirs[m], at[m, 0], at[m, 1]
        p, q = _cell(a, b, cut[1], fine)
        one = taken[p, q]
        if one >= 0 and (
            borders[rows[n]] < borders[row[one]] or (borders[rows[n]] == borders[row[one]] and rows[n] > row[one])
        ):
            continue
        if _is_known(places[n], a, b, cut, own_points):
            continue
        if one < 0:
            one = taken[p, q] = count
            count += 1
        place[one, 0], place[one, 1], row[one] = a, b, rows[n]
        _lay_down(place[one], normals[n], cut)
    for n in range(count):
        taken[_cell(place[n, 0], place[n, 1], cut[1], fine)] = -1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _lay_down(place, normal, cut):
    """Write which way the surface goes on in the cut, with its free side on that of the rays; nowhere if across it."""
    along, across = (normal * cut[2]).sum(), (normal * cut[3]).sum()
    size = math.sqrt(along * along + across * across)
    if size > _ACROSS:
        place[2], place[3] = -across / size, along / size
    else:
        place[2], place[3] = 0.0, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _chain(place, row, last, reach):
    """Prim's tree over places (n, 4) from the start of a gap until it reaches the place `last`.

    Of all ways there it has the one whose widest step is the least; of equal ones that to or from the lower row. For
    each place the one before it (-1: the start), and the width of the step between; the first and the last are shorter
    by the radius, since what the gap's own pass saw around both ends is left out. A surface has a free side: no step
    wider than touching neighbourhoods goes backward along the surface at its ends, through the body to its other side.
    """
    width, before = np.empty(last + 1), np.full(last + 1, -1, dtype=np.int64)
    for n in range(last + 1):
        away = math.sqrt(place[n, 0] ** 2 + place[n, 1] ** 2)
        width[n] = max(away - reach, 0.0)
        if away > _TOUCHING * reach and _goes_back(place[n], place[n, 0], place[n, 1], away):
            width[n] = math.inf
    done = np.zeros(last + 1, dtype=np.bool_)
    while True:
        at = -1
        for n in range(last + 1):
            if not done[n] and (at < 0 or width[n] < width[at] or (width[n] == width[at] and row[n] < row[at])):
                at = n
        done[at] = True
        if at == last:
            return before, width
        for n in range(last + 1):
            if not done[n]:
                u, v = place[n, 0] - place[at, 0], place[n, 1] - place[at, 1]
                away = math.sqrt(u * u + v * v)
                if away > _TOUCHING * reach and (_goes_back(place[at], u, v, away) or _goes_back(place[n], u, v, away)):
                    continue
                if n == last:
                    away = max(away - reach, 0.0)
                if away < width[n] or (away == width[n] and before[n] >= 0 and row[at] < row[before[n]]):
                    width[n], before[n] = away, at


@njit(cache=True, nogil=True, error_model="numpy")
def _goes_back(place, u, v, away):
    """Whether a step (u, v) goes backward along the surface at a place."""
    return place[2] * u + place[3] * v < -_BACKWARD * away


@njit(cache=True, nogil=True, error_model="numpy")
def find_crossed(columns, lines, lasers, firsts, lasts, planes, reaches, middles, halves, crossed):
    """Write `crossed` (k,): whether rays go through each third of the steps from `firsts` to `lasts` (k, 3).

    `lines` (n,) are the points' lines, `lasers` (lines, 3) where their rays began. Points are asked within `halves`
    (k,) of `middles` (k, 3), axis by axis, and not far from the step. A ray goes through a step where it meets the
    band beside it, as wide as the radius on both sides along the normal of the cut.
    """
    places, begin, lowest, side, many_x, many_y = columns
    count, low, high = np.zeros(3, dtype=np.int64), np.empty(3), np.empty(3)
    for k in range(len(firsts)):
        way = lasts[k] - firsts[k]
        step = math.sqrt((way * way).sum())
        across = np.cross(planes[k], way) / step
        for axis in range(3):
            middle = 0.5 * (firsts[k, axis] + lasts[k, axis])
            low[axis] = max(middle - _NEAR * step, middles[k, axis] - halves[k])
            high[axis] = min(middle + _NEAR * step, middles[k, axis] + halves[k])
        i0, j0 = max(0, math.floor((low[0] - lowest[0]) / side)), max(0, math.floor((low[1] - lowest[1]) / side))
        i1, j1 = math.floor((high[0] - lowest[0]) / side), math.floor((high[1] - lowest[1]) / side)
        j1 = min(j1, many_y - 1)
        count[:] = 0
        for i in range(i0, min(i1, many_x - 1) + 1):
            if j0 <= j1 and count.min() < _RAYS:
                from_, to = begin[i * many_y + j0], begin[i * many_y + j1 + 1]  # columns along y stand together
                _count_through(
                    places[from_:to], lines[from_:to], lasers, low, high, firsts[k], way, across, planes[k],
                    reaches[k], count,
                )  # fmt: skip
        crossed[k] = count.min() >= _RAYS


@njit(cache=True, nogil=True, error_model="numpy")
def _count_through(places, lines, lasers, low, high, first, way, across, plane, reach, count):
    """Count the rays to places between `low` and `high` that go through each third of a step."""
    square = way[0] ** 2 + way[1] ** 2 + way[2] ** 2
    for n in range(len(places)):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        if not (low[0] <= x <= high[0] and low[1] <= y <= high[1] and low[2] <= z <= high[2]):
            continue
        a, b, c = x - first[0], y - first[1], z - first[2]
        behind = a * across[0] + b * across[1] + c * across[2]
        if behind * behind < _BEHIND * _BEHIND * square:
            continue
        line = lines[n]
        p, q, r = lasers[line, 0] - x, lasers[line, 1] - y, lasers[line, 2] - z
        towards = p * across[0] + q * across[1] + r * across[2]
        if behind * towards >= 0 or abs(towards) < abs(behind):
            continue
        share = -behind / towards
        a, b, c = a + share * p, b + share * q, c + share * r
        if abs(a * plane[0] + b * plane[1] + c * plane[2]) > reach:
            continue
        third = math.floor(3.0 * (a * way[0] + b * way[1] + c * way[2]) / square)
        if 0 <= third < 3:
            count[third] += 1


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
    find_steps(columns, two, two, places, borders, start, end, end, along[:1], one, reach, found, crossed)
    find_crossed(columns, two.astype(np.int32), places, start, end, along[:1], reach, start, reach, crossed)
