"""The Gabriel graph: points whose ball, the one with both on its poles, is empty; needs no triangulation."""

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.sparse import csr_array

from drivers.scanline import Float64Array
from scanner_service.analysis.graphs.kd_tree import (
    Int32Array,
    box_distance_sq,
    distance_sq,
    node_start,
)
from scanner_service.analysis.graphs.places import Places, find_places
from scanner_service.analysis.graphs.slices import in_slices

_FIRST_BARRIERS = 16
_BARRIERS = 64
_MARGIN = 1e-12


def gabriel_graph(points_mm: npt.ArrayLike, *, threads: int = 1) -> csr_array:
    """The Gabriel graph of a cloud: {p, q} is an edge when no point lies within the ball with diameter pq.

    Parameters
    ----------
    points_mm : (n, 3), finite, mm. A point r is within the ball when |pr|² + |rq|² < |pq|²; points on its surface do
        not count. Identical points share a place, where the first stands for all.

    Returns
    -------
    Symmetric sparse matrix (n, n) of edge lengths in mm; zeros that are stored are edges between identical points.

    Raises
    ------
    ValueError : no points, or some not finite.

    Notes
    -----
    K. R. Gabriel and R. R. Sokal, *A new statistical approach to geographic variation analysis*, Systematic Zoology
    18, 1969. A part of the Delaunay graph; it has a part in every degenerate case too, since nothing is triangulated:
    beyond a point q, seen from p, there is no neighbour of p behind the plane through q across pq.
    """
    places = find_places(points_mm)
    return places.matrix(gabriel_links(places, threads))


def gabriel_links(places: Places, threads: int = 1) -> Int32Array:
    """(m, 2) positions in tree order that the edges of the Gabriel graph join."""
    tree = places.tree
    if len(tree) < 2:
        return np.empty((0, 2), dtype=np.int32)
    near = places.nearest(_FIRST_BARRIERS, threads)

    def search(start: int, stop: int) -> Int32Array:
        links: Int32Array = _search(tree.xyz, tree.box, tree.levels, near, start, stop)
        return links

    return np.concatenate(in_slices(search, len(tree), threads))


@njit(cache=True, nogil=True)
def _search(xyz: Float64Array, box: Float64Array, levels: int, near: Int32Array, start: int, stop: int) -> Int32Array:
    """Links of the points from `start` to `stop` - 1 to points of a larger position."""
    n, leaves = len(xyz), 1 << levels
    links = np.empty((8 * (stop - start) + 8, 2), dtype=np.int32)
    made = 0
    barrier = np.empty(_BARRIERS, dtype=np.int32)
    waiting = np.empty(levels + 2, dtype=np.int64)
    more = np.empty(levels + 2, dtype=np.int64)
    for i in range(start, stop):
        barriers = newest = near.shape[1]
        barrier[:barriers] = near[i]
        waiting[0] = 1
        held = 1
        while held > 0:
            held -= 1
            node = waiting[held]
            if _is_behind(xyz, box, node, i, barrier, barriers):
                continue
            if node < leaves:
                left = 2 * node
                x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
                if box_distance_sq(box, left, x, y, z) > box_distance_sq(box, left + 1, x, y, z):
                    left += 1
                waiting[held], waiting[held + 1] = left ^ 1, left
                held += 2
                continue
            for j in range(node_start(node, levels, n), node_start(node + 1, levels, n)):
                if j == i or _is_hidden(xyz, i, j, barrier, barriers):
                    continue
                between = point_between(xyz, box, levels, i, j, False, more)
                if barriers < _BARRIERS:
                    barriers += 1
                    newest = barriers - 1
                else:
                    newest = newest + 1 if newest + 1 < _BARRIERS else _FIRST_BARRIERS
                barrier[newest] = between if between >= 0 else j
                if between >= 0 or j < i:
                    continue
                if made == len(links):
                    larger = np.empty((2 * made, 2), dtype=np.int32)
                    larger[:made] = links
                    links = larger
                links[made, 0], links[made, 1] = i, j
                made += 1
    return links[:made].copy()


@njit(cache=True, nogil=True)
def _is_hidden(xyz: Float64Array, i: int, j: int, barrier: Int32Array, barriers: int) -> bool:
    """Whether one of the barriers lies within the ball between i and j."""
    length = distance_sq(xyz, i, j)
    for at in range(barriers):
        k = barrier[at]
        if k != j and distance_sq(xyz, i, k) + distance_sq(xyz, k, j) < length:
            barrier[at], barrier[at >> 1] = barrier[at >> 1], k  # what has hidden one point will hide the next
            return True
    return False


@njit(cache=True, nogil=True)
def _is_behind(xyz: Float64Array, box: Float64Array, node: int, i: int, barrier: Int32Array, barriers: int) -> bool:
    """Whether all of a node's box lies, beyond any rounding, behind the plane of one of the barriers."""
    far = 0.0
    for axis in range(3):
        side = max(xyz[i, axis] - box[node, axis], box[node, 3 + axis] - xyz[i, axis])
        far += side * side
    for at in range(barriers):
        k = barrier[at]
        behind = 0.0
        for axis in range(3):
            along = xyz[k, axis] - xyz[i, axis]
            nearest = box[node, axis] if along > 0.0 else box[node, 3 + axis]
            behind += along * (nearest - xyz[k, axis])
        if behind > _MARGIN * far:
            return True
    return False


@njit(cache=True, nogil=True)
def point_between(
    xyz: Float64Array, box: Float64Array, levels: int, i: int, j: int, is_lune: bool, waiting: npt.NDArray[np.int64]
) -> int:
    """A point in the lune of i and j (nearer to both than they are to each other), or in their ball; -1 if none.

    The ball is a part of the lune, so boxes outside the lune are passed over in both cases. `waiting` is room for
    levels + 2 nodes.
    """
    n, leaves = len(xyz), 1 << levels
    length = distance_sq(xyz, i, j)
    limit = length * (1.0 + _MARGIN)
    x, y, z = 0.5 * (xyz[i, 0] + xyz[j, 0]), 0.5 * (xyz[i, 1] + xyz[j, 1]), 0.5 * (xyz[i, 2] + xyz[j, 2])
    waiting[0] = 1
    held = 1
    while held > 0:
        held -= 1
        node = waiting[held]
        if (
            box_distance_sq(box, node, xyz[i, 0], xyz[i, 1], xyz[i, 2]) > limit
            or box_distance_sq(box, node, xyz[j, 0], xyz[j, 1], xyz[j, 2]) > limit
        ):
            continue
        if node < leaves:
            left = 2 * node
            if box_distance_sq(box, left, x, y, z) > box_distance_sq(box, left + 1, x, y, z):
                left += 1
            waiting[held], waiting[held + 1] = left ^ 1, left
            held += 2
            continue
        for k in range(node_start(node, levels, n), node_start(node + 1, levels, n)):
            if k in (i, j):
                continue
            one, other = distance_sq(xyz, i, k), distance_sq(xyz, k, j)
            if is_lune:
                if one < length and other < length:
                    return k
            elif one + other < length:
                return k
    return -1
