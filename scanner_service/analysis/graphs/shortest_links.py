"""The Euclidean minimum spanning tree over a k-d tree; knows groups of points and the nearest point of another group.

Boruvka's method on points. Every point knows its k nearest points; as long as one of them is in another group, the
nearest such is its shortest link. Where none is, the tree of boxes is searched, but only from points whose k-th
neighbour is nearer than the best link their group has found, and past every box that holds nothing but the own group.
The largest group need not search at all: the others' links reach it. After March, Ram and Gray, *Fast Euclidean
minimum spanning tree*, KDD 2010 (component boxes and bounds), without the second tree.
"""

import numpy as np
from numba import njit

from drivers.scanline import Float64Array
from scanner_service.analysis.graphs.kd_tree import (
    Int32Array,
    KdTree,
    box_distance_sq,
    distance_sq,
    leaf_of,
    node_start,
)
from scanner_service.analysis.graphs.spanning import group_of, join


def shortest_links(tree: KdTree, near: Int32Array) -> Int32Array:
    """(n - 1, 2) positions in tree order that the edges of the Euclidean minimum spanning tree join.

    `near` (n, k) are the k >= 1 nearest points of each. Links of equal length are ordered by the smaller, then by the
    larger of the two rows in the cloud, so the tree is unique.
    """
    n = len(tree)
    links = np.empty((max(n - 1, 0), 2), dtype=np.int32)
    if n > 1:
        _link_groups(tree.xyz, tree.row, tree.box, tree.levels, near, links)
    return links


@njit(cache=True, nogil=True)
def is_shorter(row: Int32Array, d: float, i: int, j: int, best: float, a: int, b: int) -> bool:
    """The order of links: by length, then by the smaller row, then by the larger; a < 0 stands for no link."""
    if d != best or a < 0:
        return d < best
    one, other = min(row[i], row[j]), min(row[a], row[b])
    if one != other:
        return one < other
    return max(row[i], row[j]) < max(row[a], row[b])


@njit(cache=True, nogil=True)
def _link_groups(
    xyz: Float64Array, row: Int32Array, box: Float64Array, levels: int, near: Int32Array, links: Int32Array
) -> None:
    n, count = near.shape
    group = np.arange(n).astype(np.int32)
    other = np.full(n, -1, dtype=np.int32)  # the nearest point of another group, where it is known
    passed = np.zeros(n, dtype=np.uint8)  # how many of the nearest points are known to be of the own group
    reach = np.zeros(n)  # no point of another group is nearer than this, squared
    best = np.empty(n)
    end = np.empty((n, 2), dtype=np.int32)
    size = np.empty(n, dtype=np.int32)
    box_group = np.empty(len(box), dtype=np.int32)
    waiting = np.empty(levels + 2, dtype=np.int64)
    made = 0
    while made < n - 1:
        best[:] = np.inf
        end[:] = -1
        size[:] = 0
        searches = 0
        for i in range(n):
            mine = group[i]
            size[mine] += 1
            if other[i] < 0 or group[other[i]] == mine:
                if other[i] >= 0:
                    reach[i] = max(reach[i], distance_sq(xyz, i, other[i]))
                    other[i] = -1
                while passed[i] < count and group[near[i, passed[i]]] == mine:
                    passed[i] += 1
                if passed[i] < count:
                    other[i] = near[i, passed[i]]
                else:
                    reach[i] = max(reach[i], distance_sq(xyz, i, near[i, count - 1]))
                    searches += 1
                    continue
            d = distance_sq(xyz, i, other[i])
            if is_shorter(row, d, i, other[i], best[mine], end[mine, 0], end[mine, 1]):
                best[mine], end[mine, 0], end[mine, 1] = d, i, other[i]
        largest = np.argmax(size)
        if searches > 0:
            _mark_boxes(group, levels, box_group)
            for i in range(n):
                mine = group[i]
                if other[i] < 0 and mine != largest and reach[i] <= best[mine]:
                    _search_outside(xyz, row, box, levels, group, box_group, i, best, end, reach, other, waiting)
        for i in range(n):
            if end[i, 0] >= 0 and i != largest and join(group, end[i, 0], end[i, 1]):
                links[made, 0], links[made, 1] = end[i, 0], end[i, 1]
                made += 1
        for i in range(n):
            group[i] = group_of(group, i)


@njit(cache=True, nogil=True)
def _mark_boxes(group: Int32Array, levels: int, box_group: Int32Array) -> None:
    """The one group of all points of a node, or -1 where there are several."""
    n = len(group)
    leaves = 1 << levels
    for leaf in range(leaves, 2 * leaves):
        start = node_start(leaf, levels, n)
        box_group[leaf] = group[start]
        for i in range(start + 1, node_start(leaf + 1, levels, n)):
            if group[i] != group[start]:
                box_group[leaf] = -1
                break
    for node in range(leaves - 1, 0, -1):
        one = box_group[2 * node]
        box_group[node] = one if one == box_group[2 * node + 1] else -1


@njit(cache=True, nogil=True)
def _search_outside(
    xyz: Float64Array,
    row: Int32Array,
    box: Float64Array,
    levels: int,
    group: Int32Array,
    box_group: Int32Array,
    i: int,
    best: Float64Array,
    end: Int32Array,
    reach: Float64Array,
    other: Int32Array,
    waiting: Int32Array,
) -> None:
    """Look for the nearest point of another group, no further away than the best link of the own one."""
    n, leaves, mine = len(xyz), 1 << levels, group[i]
    x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
    found = -1
    nearest = best[mine]
    node = leaf_of(i, levels, n) << 1  # so that the first one looked at is the own leaf
    while node > 1:
        waiting[0] = node ^ 1 if node < 2 * leaves else node >> 1
        held = 1
        node >>= 1
        while held > 0:
            held -= 1
            at = waiting[held]
            if box_group[at] == mine or box_distance_sq(box, at, x, y, z) > nearest:
                continue
            if at < leaves:
                left = 2 * at
                if box_distance_sq(box, left, x, y, z) > box_distance_sq(box, left + 1, x, y, z):
                    left += 1
                waiting[held], waiting[held + 1] = left ^ 1, left
                held += 2
                continue
            for j in range(node_start(at, levels, n), node_start(at + 1, levels, n)):
                if group[j] == mine:
                    continue
                d = distance_sq(xyz, i, j)
                if d < nearest or (d == nearest and (found < 0 or row[j] < row[found])):
                    nearest, found = d, j
    if found < 0:
        reach[i] = max(reach[i], best[mine])
        return
    other[i] = found
    reach[i] = max(reach[i], nearest)
    if is_shorter(row, nearest, i, found, best[mine], end[mine, 0], end[mine, 1]):
        best[mine], end[mine, 0], end[mine, 1] = nearest, i, found
