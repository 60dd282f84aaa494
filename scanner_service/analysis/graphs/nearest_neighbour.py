"""The nearest-neighbour graph: every point with the one nearest to it."""

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from scanner_service.analysis.graphs.kd_tree import Int32Array
from scanner_service.analysis.graphs.places import Places, find_places


def nearest_neighbour_graph(points_mm: npt.ArrayLike, *, threads: int = 1) -> csr_array:
    """The nearest-neighbour graph (NNG) of a cloud: {p, q} is an edge when q is the nearest other point of p.

    Parameters
    ----------
    points_mm : (n, 3), finite, mm. Of points equally far the earlier row is the nearer; of identical points the first
        is the nearest of all others.

    Returns
    -------
    Symmetric sparse matrix (n, n) of edge lengths in mm; zeros that are stored are edges of length 0.

    Raises
    ------
    ValueError : no points, or some not finite.

    Notes
    -----
    A forest, and part of the Euclidean minimum spanning tree. F. P. Preparata and M. I. Shamos, *Computational
    Geometry*, 1985.
    """
    places = find_places(points_mm)
    return places.matrix(nearest_links(places, places.nearest(1, threads)))


def nearest_links(places: Places, near: Int32Array) -> Int32Array:
    """(m, 2) positions, each edge once: each place with its nearest.

    A place that several points share has its nearest within itself.
    """
    if not near.shape[1]:
        return np.empty((0, 2), dtype=np.int32)
    place = np.arange(len(near), dtype=np.int32)
    to = near[:, 0]
    is_shared = np.isin(places.tree.row, places.twin_of) if len(places.twin) else np.zeros(len(near), dtype=np.bool_)
    is_second = (near[to, 0] == place) & (to < place) & ~is_shared[to]  # the other end has named this edge
    kept = ~is_shared & ~is_second
    return np.column_stack([place[kept], to[kept]])
