"""From a cloud as it comes to distinct places in a k-d tree, and back from links to a sparse matrix; knows no graph."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.sparse import csr_array

from drivers.scanline import Float64Array
from scanner_service.analysis.graphs.kd_tree import Int32Array, KdTree, build_kd_tree, distance_sq
from scanner_service.analysis.graphs.nearest import nearest_points

LARGEST = 1e60
"""Coordinates beyond are refused: products of their squares would not be finite."""


@dataclass(frozen=True, slots=True)
class Places:
    """The distinct places of a cloud of `count` points.

    Points with the very same coordinates share a place, where the first of them stands for all. `tree` holds one
    point a place, its `row` being the row in the cloud; `twin` and `twin_of` (t,) are the rows of the others and of
    the one that stands for them.
    """

    count: int
    tree: KdTree
    twin: Int32Array
    twin_of: Int32Array

    def nearest(self, count: int, threads: int = 1) -> Int32Array:
        """(p, k) positions of the nearest other places, the nearest first; k is `count`, or all there are."""
        return nearest_points(self.tree, min(count, len(self.tree) - 1), threads)

    def matrix(self, links: Int32Array) -> csr_array:
        """The graph with these links (m, 2), each once, and one of length 0 from each twin to its first.

        Symmetric (n, n), in the rows of the cloud; the value is the length. Zeros are stored: they are edges too.
        """
        edges = len(links) + len(self.twin)
        start = np.zeros(self.count + 1, dtype=np.int32)
        column = np.empty(2 * edges, dtype=np.int32)
        length = np.empty(2 * edges)
        _fill(self.tree.xyz, self.tree.row, links, self.twin, self.twin_of, start, column, length)
        return csr_array((length, column, start), shape=(self.count, self.count))


def find_places(points_mm: npt.ArrayLike) -> Places:
    """The distinct places of a cloud (n, 3).

    Raises
    ------
    ValueError : no points, another shape, or coordinates that are not finite (or beyond 1e60).
    """
    points = check_points(points_mm)
    first = np.empty(len(points), dtype=np.int32)
    _find_first(points, first)
    is_twin = first != np.arange(len(points))
    twin = np.flatnonzero(is_twin).astype(np.int32)
    distinct = np.flatnonzero(~is_twin).astype(np.int32)
    tree = build_kd_tree(points if not len(twin) else points[distinct])
    if len(twin):
        tree = KdTree(tree.xyz, distinct[tree.row], tree.box, tree.levels)
    return Places(len(points), tree, twin, first[twin])


def check_points(points_mm: npt.ArrayLike) -> Float64Array:
    """The cloud as an array (n, 3) of float64, with -0 as 0.

    Raises
    ------
    ValueError : as `find_places`.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points must have the shape (n, 3), not {points.shape}")
    if not len(points):
        raise ValueError("the cloud holds no points, so there is no graph")
    with np.errstate(invalid="ignore"):
        usable = (np.abs(points) <= LARGEST).all(axis=1)
    if not usable.all():
        raise ValueError(
            f"{int((~usable).sum())} of {len(points)} points are not finite (or beyond {LARGEST:g} mm): "
            "leave them out first"
        )
    return points + 0.0


@njit(cache=True, nogil=True)
def _find_first(points: Float64Array, first: Int32Array) -> None:
    """For every row the first row with the very same coordinates, by a hash table with open addresses."""
    n = len(points)
    size = 8
    while size < 2 * n:
        size *= 2
    table = np.full(size, -1, dtype=np.int32)
    bits = points.view(np.uint64)
    for i in range(n):
        state = np.uint64(0)
        for axis in range(3):
            state = (state ^ bits[i, axis]) + np.uint64(0x9E3779B97F4A7C15)
            state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            state ^= state >> np.uint64(31)
        at = np.int64(state & np.uint64(size - 1))
        while table[at] >= 0:
            j = table[at]
            if points[i, 0] == points[j, 0] and points[i, 1] == points[j, 1] and points[i, 2] == points[j, 2]:
                break
            at = (at + 1) & (size - 1)
        if table[at] < 0:
            table[at] = i
        first[i] = table[at]


@njit(cache=True, nogil=True)
def _fill(
    xyz: Float64Array,
    row: Int32Array,
    links: Int32Array,
    twin: Int32Array,
    twin_of: Int32Array,
    start: Int32Array,
    column: Int32Array,
    length: Float64Array,
) -> None:
    """Compressed rows with columns in their order: edges are dealt out by one end, and then by the other."""
    n, m = len(start) - 1, len(links)
    for at in range(m + len(twin)):
        for end in range(2):
            start[_end(row, links, twin, twin_of, at, end) + 1] += 1
    for i in range(n):
        start[i + 1] += start[i]
    free = start[:n].copy()
    dealt = np.empty(len(column), dtype=np.int32)  # twice the edge, and which end is here
    for at in range(m + len(twin)):
        for end in range(2):
            i = _end(row, links, twin, twin_of, at, end)
            dealt[free[i]] = 2 * at + end
            free[i] += 1
    free[:] = start[:n]
    for j in range(n):
        for place in range(start[j], start[j + 1]):
            at, end = dealt[place] >> 1, dealt[place] & 1
            i = _end(row, links, twin, twin_of, at, 1 - end)
            column[free[i]] = j
            length[free[i]] = math.sqrt(distance_sq(xyz, links[at, 0], links[at, 1])) if at < m else 0.0
            free[i] += 1


@njit(cache=True, nogil=True)
def _end(row: Int32Array, links: Int32Array, twin: Int32Array, twin_of: Int32Array, at: int, end: int) -> int:
    """The row of the cloud at one end of an edge: links come first, then twins."""
    if at < len(links):
        return row[links[at, end]]
    return twin[at - len(links)] if end == 0 else twin_of[at - len(links)]
