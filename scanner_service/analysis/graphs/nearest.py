"""The k nearest points of every point of a k-d tree; knows distances and how ties are broken, no graph."""

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
from scanner_service.analysis.graphs.slices import in_slices


def nearest_points(tree: KdTree, count: int, threads: int = 1) -> Int32Array:
    """(n, count) positions in tree order of the nearest other points of each point, the nearest first.

    `count` is at most n - 1. Of points equally far the one with the smaller row in the cloud comes first.
    """
    near = np.empty((len(tree), count), dtype=np.int32)

    def search(start: int, stop: int) -> None:
        _search(tree.xyz, tree.row, tree.box, tree.levels, start, stop, near)

    in_slices(search, len(tree), threads)
    return near


@njit(cache=True, nogil=True)
def _search(
    xyz: Float64Array, row: Int32Array, box: Float64Array, levels: int, start: int, stop: int, near: Int32Array
) -> None:
    """The nearest points of those at the positions `start` to `stop` - 1."""
    n, count = len(xyz), near.shape[1]
    square = np.empty(count)
    waiting = np.empty(levels + 2, dtype=np.int64)
    leaves = 1 << levels
    for i in range(start, stop):
        square[:] = np.inf
        near[i] = -1
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        node = leaf_of(i, levels, n)
        _offer_leaf(xyz, row, node, levels, i, square, near)
        while node > 1:
            waiting[0] = node ^ 1
            held = 1
            node >>= 1
            while held > 0:
                held -= 1
                other = waiting[held]
                if box_distance_sq(box, other, x, y, z) > square[count - 1]:
                    continue
                if other >= leaves:
                    _offer_leaf(xyz, row, other, levels, i, square, near)
                    continue
                left = 2 * other
                if box_distance_sq(box, left, x, y, z) > box_distance_sq(box, left + 1, x, y, z):
                    left += 1
                waiting[held], waiting[held + 1] = left ^ 1, left  # the nearer child is looked at first
                held += 2


@njit(cache=True, nogil=True)
def _offer_leaf(
    xyz: Float64Array, row: Int32Array, leaf: int, levels: int, i: int, square: Float64Array, near: Int32Array
) -> None:
    """Take up what a leaf holds nearer to point i than the last of its list."""
    n, count = len(xyz), len(square)
    for j in range(node_start(leaf, levels, n), node_start(leaf + 1, levels, n)):
        d = distance_sq(xyz, i, j)
        if d > square[count - 1] or j == i:
            continue
        if d == square[count - 1] and near[i, count - 1] >= 0 and row[j] > row[near[i, count - 1]]:
            continue
        at = count - 1
        while at > 0 and (d < square[at - 1] or (d == square[at - 1] and row[j] < row[near[i, at - 1]])):
            square[at], near[i, at] = square[at - 1], near[i, at - 1]
            at -= 1
        square[at], near[i, at] = d, j
