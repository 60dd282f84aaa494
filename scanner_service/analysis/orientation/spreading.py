"""Spreading one normal's side over a forest; knows signs of links, no geometry."""

import numpy as np
from numba import njit

from drivers.scanline import BoolArray
from scanner_service.analysis.graphs.kd_tree import Int32Array
from scanner_service.analysis.graphs.spanning import group_of, join
from scanner_service.analysis.orientation.links import Int8Array


def patches(n: int, links: Int32Array, taken: BoolArray) -> Int32Array:
    """The patch (n,) of each vertex, named by its first one: what the links (m, 2) that are `taken` hold together."""
    patch = np.arange(n, dtype=np.int32)
    _join(links, taken, patch)
    return patch


@njit(cache=True, nogil=True)
def _join(links: Int32Array, taken: BoolArray, patch: Int32Array) -> None:
    for at in range(len(links)):
        if taken[at]:
            join(patch, links[at, 0], links[at, 1])
    for i in range(len(patch)):
        patch[i] = group_of(patch, i)


def spread(starts: Int32Array, links: Int32Array, sign: Int8Array, is_tree: BoolArray, side: Int8Array) -> None:
    """Give every vertex its side along those of the links (m, 2) that make up a forest, from the `starts`, one a tree.

    `side` (n,) holds 1 or -1 at the starts; the others are written.
    """
    _spread(starts.astype(np.int32), links, sign, is_tree, side)


@njit(cache=True, nogil=True)
def _spread(starts: Int32Array, links: Int32Array, sign: Int8Array, is_tree: BoolArray, side: Int8Array) -> None:
    n = len(side)
    begin = np.zeros(n + 2, dtype=np.int32)
    for at in range(len(links)):
        if is_tree[at]:
            begin[links[at, 0] + 2] += 1
            begin[links[at, 1] + 2] += 1
    for i in range(n + 1):
        begin[i + 1] += begin[i]
    at_vertex = np.empty(begin[n + 1], dtype=np.int32)
    for at in range(len(links)):
        if not is_tree[at]:
            continue
        for end in range(2):
            i = links[at, end]
            at_vertex[begin[i + 1]] = at
            begin[i + 1] += 1
    came_by = np.full(n, -1, dtype=np.int32)
    queue = np.empty(n, dtype=np.int32)
    first = 0
    last = len(starts)
    queue[:last] = starts
    while first < last:
        i = queue[first]
        first += 1
        for place in range(begin[i], begin[i + 1]):
            at = at_vertex[place]
            if at != came_by[i]:
                j = links[at, 0] + links[at, 1] - i
                came_by[j] = at
                side[j] = side[i] * sign[at]
                queue[last] = j
                last += 1
