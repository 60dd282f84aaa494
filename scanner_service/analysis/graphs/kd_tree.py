"""A balanced k-d tree in plain arrays that kernels walk without objects; knows boxes of points, no graph.

Node 1 is the root, node i has the children 2i and 2i+1, and node m of level l holds the positions floor(m n / 2^l) to
floor((m+1) n / 2^l) of the points in tree order. So the tree is a permutation of the points and a table of boxes.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from drivers.scanline import Float64Array, read_only

Int32Array = npt.NDArray[np.int32]

LEAF_POINTS = 12
"""A leaf holds at most this many points."""


@dataclass(frozen=True, slots=True)
class KdTree:
    """Points in tree order and the boxes around them.

    `xyz` (n, 3) are the points in tree order, `row` (n,) the row that each had in the cloud. `box` (2 L, 6) holds
    smallest and largest x y z of every node, L = 2^`levels` being the number of leaves; row 0 is not used.
    """

    xyz: Float64Array
    row: Int32Array
    box: Float64Array
    levels: int

    def __len__(self) -> int:
        return len(self.xyz)


def build_kd_tree(points: Float64Array) -> KdTree:
    """The tree of points (n, 3), all finite and n >= 1; nodes are halved across their longest side."""
    n = len(points)
    levels = 0
    while n > LEAF_POINTS << levels:
        levels += 1
    xyz = np.array(points, dtype=np.float64, order="C")
    row = np.arange(n, dtype=np.int32)
    box = np.zeros((2 << levels, 6))
    _build(xyz, row, levels, box)
    for array in (xyz, row, box):
        read_only(array)
    return KdTree(xyz, row, box, levels)


@njit(cache=True, nogil=True)
def node_start(node: int, level: int, n: int) -> int:
    """First position of a node of that level; the first of the next node is its end."""
    return ((node - (1 << level)) * n) >> level


@njit(cache=True, nogil=True)
def leaf_of(position: int, levels: int, n: int) -> int:
    """The leaf that holds a position of the tree order."""
    return (1 << levels) + ((((position + 1) << levels) - 1) // n)


@njit(cache=True, nogil=True)
def box_distance_sq(box: Float64Array, node: int, x: float, y: float, z: float) -> float:
    """Squared distance from a place to the box of a node, 0 inside."""
    dx = max(box[node, 0] - x, x - box[node, 3], 0.0)
    dy = max(box[node, 1] - y, y - box[node, 4], 0.0)
    dz = max(box[node, 2] - z, z - box[node, 5], 0.0)
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def distance_sq(xyz: Float64Array, i: int, j: int) -> float:
    """Squared distance of two points: the one formula by which all graphs compare lengths."""
    dx, dy, dz = xyz[i, 0] - xyz[j, 0], xyz[i, 1] - xyz[j, 1], xyz[i, 2] - xyz[j, 2]
    return dx * dx + dy * dy + dz * dz


def squares_to(xyz: Float64Array, to: Int32Array) -> Float64Array:
    """Squared distance (n,) of each point (n, 3) to the one at the position `to` (n,)."""
    square = np.empty(len(xyz))
    _square(xyz, to, square)
    return square


@njit(cache=True, nogil=True)
def _square(xyz: Float64Array, to: Int32Array, square: Float64Array) -> None:
    for i in range(len(xyz)):
        square[i] = distance_sq(xyz, i, to[i])


@njit(cache=True, nogil=True)
def _build(xyz: Float64Array, row: Int32Array, levels: int, box: Float64Array) -> None:
    n = len(xyz)
    for level in range(levels + 1):
        for node in range(1 << level, 2 << level):
            start, stop = node_start(node, level, n), node_start(node + 1, level, n)
            _measure(xyz, start, stop, box[node])
            if level == levels:
                continue
            axis, side = 0, box[node, 3] - box[node, 0]
            for other in range(1, 3):
                if box[node, 3 + other] - box[node, other] > side:
                    axis, side = other, box[node, 3 + other] - box[node, other]
            _halve(xyz, row, start, stop, node_start(2 * node + 1, level + 1, n), axis)


@njit(cache=True, nogil=True)
def _measure(xyz: Float64Array, start: int, stop: int, sides: Float64Array) -> None:
    for axis in range(3):
        low = high = xyz[start, axis]
        for i in range(start + 1, stop):
            low, high = min(low, xyz[i, axis]), max(high, xyz[i, axis])
        sides[axis], sides[3 + axis] = low, high


@njit(cache=True, nogil=True)
def _halve(xyz: Float64Array, row: Int32Array, start: int, stop: int, middle: int, axis: int) -> None:
    """Order positions so that none before `middle` is larger along the axis than any from there on (Hoare's FIND)."""
    low, high = start, stop - 1
    while low < high:
        a, b, c = xyz[low, axis], xyz[(low + high) >> 1, axis], xyz[high, axis]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = low, high
        while i <= j:
            while xyz[i, axis] < pivot:
                i += 1
            while xyz[j, axis] > pivot:
                j -= 1
            if i <= j:
                for k in range(3):
                    xyz[i, k], xyz[j, k] = xyz[j, k], xyz[i, k]
                row[i], row[j] = row[j], row[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return
