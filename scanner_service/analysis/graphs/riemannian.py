"""The Riemannian graph: the Euclidean minimum spanning tree and the k nearest neighbours together."""

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.sparse import csr_array

from scanner_service.analysis.graphs.kd_tree import Int32Array
from scanner_service.analysis.graphs.places import find_places
from scanner_service.analysis.graphs.shortest_links import shortest_links

NEIGHBOURS = 8
"""Nearest neighbours of each point in the graph, unless stated."""


def riemannian_graph(points_mm: npt.ArrayLike, neighbours: int = NEIGHBOURS, *, threads: int = 1) -> csr_array:
    """The Riemannian graph of a cloud: {p, q} is an edge of the EMST, or q is among the k nearest points of p.

    Parameters
    ----------
    points_mm : (n, 3), finite, mm.
    neighbours : k, other points only; fewer where the cloud has not so many. Identical points count as one.

    Returns
    -------
    Symmetric sparse matrix (n, n) of edge lengths in mm; connected. Zeros that are stored are edges between identical
    points.

    Raises
    ------
    ValueError : no points, some not finite, or k < 1.

    Notes
    -----
    H. Hoppe, T. DeRose, T. Duchamp, J. McDonald and W. Stuetzle, *Surface reconstruction from unorganized points*,
    SIGGRAPH 1992: the tree keeps the graph connected, the neighbours make it dense along the surface.
    """
    check_neighbours(neighbours)
    places = find_places(points_mm)
    near = places.nearest(neighbours, threads)
    return places.matrix(riemannian_links(shortest_links(places.tree, near), near))


def check_neighbours(neighbours: int) -> None:
    """Refuse a number of neighbours below 1.

    Raises
    ------
    ValueError : it is.
    """
    if neighbours < 1:
        raise ValueError(f"each point needs 1 neighbour or more in the graph, not {neighbours}")


def riemannian_links(tree_links: Int32Array, near: Int32Array) -> Int32Array:
    """(m, 2) positions that an edge joins, each edge once: the tree's links (n - 1, 2) and those to `near` (n, k).

    A neighbour link stands where its first end has the other as neighbour; where both have each other, it stands with
    the smaller position. Tree links that are neighbour links too are not repeated.
    """
    links = np.empty((near.size + len(tree_links), 2), dtype=np.int32)
    return links[: _collect(tree_links, near, links)]


@njit(cache=True, nogil=True)
def _collect(tree_links: Int32Array, near: Int32Array, links: Int32Array) -> int:
    n, count = near.shape
    made = 0
    for i in range(n):
        for place in range(count):
            j = near[i, place]
            if i < j or not _has(near, j, i):
                links[made, 0], links[made, 1] = i, j
                made += 1
    for at in range(len(tree_links)):
        i, j = tree_links[at, 0], tree_links[at, 1]
        if not (_has(near, i, j) or _has(near, j, i)):
            links[made, 0], links[made, 1] = i, j
            made += 1
    return made


@njit(cache=True, nogil=True)
def _has(near: Int32Array, i: int, j: int) -> bool:
    for place in range(near.shape[1]):  # noqa: SIM110 - a kernel
        if near[i, place] == j:
            return True
    return False
