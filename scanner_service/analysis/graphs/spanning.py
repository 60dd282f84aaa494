"""Minimum spanning forests after Boruvka; knows edges, weights and groups of vertices, no points.

O. Boruvka 1926: each group of vertices takes its lightest edge to another group, until there is none. Edges of equal
weight are told apart by their number, so the order is total, the forest is unique and no circle can close.
"""

import numpy as np
import numpy.typing as npt
from numba import njit

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.graphs.kd_tree import Int32Array

Float32Array = npt.NDArray[np.float32]


@njit(cache=True, nogil=True)
def group_of(parent: Int32Array, i: int) -> int:
    """The vertex that stands for the group of vertex i; shortens the way there."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def join(parent: Int32Array, i: int, j: int) -> bool:
    """Make one group of two; False when they are one already."""
    one, other = group_of(parent, i), group_of(parent, j)
    if one == other:
        return False
    parent[max(one, other)] = min(one, other)
    return True


def minimum_spanning_forest(
    n: int, tail: Int32Array, head: Int32Array, weight: Float64Array | Float32Array
) -> tuple[BoolArray, Int32Array]:
    """Which of the edges (m,) are in the minimum spanning forest of n vertices, and the group (n,) of each vertex.

    A group bears the number of its first vertex. Of edges with equal weight the earlier one is the lighter; no weight
    may be NaN.
    """
    taken = np.zeros(len(tail), dtype=np.bool_)
    group = np.arange(n, dtype=np.int32)
    _boruvka(tail, head, weight, taken, group)
    return taken, group


@njit(cache=True, nogil=True)
def _boruvka(
    tail: Int32Array, head: Int32Array, weight: Float64Array | Float32Array, taken: BoolArray, group: Int32Array
) -> None:
    n = len(group)
    lightest = np.empty(n, dtype=np.int32)
    living = np.arange(len(tail), dtype=np.int32)
    count = len(tail)
    while count > 0:
        lightest[:] = -1
        kept = 0
        for at in range(count):
            edge = living[at]
            one, other = group[tail[edge]], group[head[edge]]
            if one == other:
                continue
            living[kept] = edge
            kept += 1
            if lightest[one] < 0 or weight[edge] < weight[lightest[one]]:
                lightest[one] = edge
            if lightest[other] < 0 or weight[edge] < weight[lightest[other]]:
                lightest[other] = edge
        count = kept
        for i in range(n):
            edge = lightest[i]
            if edge >= 0 and join(group, tail[edge], head[edge]):
                taken[edge] = True
        for i in range(n):
            group[i] = group_of(group, i)
