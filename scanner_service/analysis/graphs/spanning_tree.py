"""The Euclidean minimum spanning tree of a cloud."""

import numpy.typing as npt
from scipy.sparse import csr_array

from scanner_service.analysis.graphs.places import find_places
from scanner_service.analysis.graphs.shortest_links import shortest_links

SEED_NEIGHBOURS = 8
"""Nearest points that are known before the search begins; any number gives the same tree."""


def euclidean_spanning_tree(points_mm: npt.ArrayLike, *, threads: int = 1) -> csr_array:
    """The Euclidean minimum spanning tree (EMST): the tree through all points with the least sum of lengths.

    Parameters
    ----------
    points_mm : (n, 3), finite, mm. Edges of equal length are ordered by their rows, so the tree is unique.

    Returns
    -------
    Symmetric sparse matrix (n, n) of edge lengths in mm, with n - 1 edges; zeros that are stored are edges between
    identical points.

    Raises
    ------
    ValueError : no points, or some not finite.

    Notes
    -----
    Exact: Boruvka's method over a k-d tree (`shortest_links`).
    """
    places = find_places(points_mm)
    return places.matrix(shortest_links(places.tree, places.nearest(SEED_NEIGHBOURS, threads)))
