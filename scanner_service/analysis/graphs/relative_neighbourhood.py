"""The relative neighbourhood graph: points to which no third one is nearer than they are to each other."""

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.sparse import csr_array

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.graphs.gabriel import gabriel_links, point_between
from scanner_service.analysis.graphs.kd_tree import Int32Array
from scanner_service.analysis.graphs.places import find_places
from scanner_service.analysis.graphs.slices import in_slices


def relative_neighbourhood_graph(points_mm: npt.ArrayLike, *, threads: int = 1) -> csr_array:
    """The relative neighbourhood graph (RNG): {p, q} is an edge when no r has both |pr| < |pq| and |rq| < |pq|.

    Parameters
    ----------
    points_mm : (n, 3), finite, mm. Identical points share a place, where the first stands for all.

    Returns
    -------
    Symmetric sparse matrix (n, n) of edge lengths in mm; zeros that are stored are edges between identical points.

    Raises
    ------
    ValueError : no points, or some not finite.

    Notes
    -----
    G. T. Toussaint, *The relative neighbourhood graph of a finite planar set*, Pattern Recognition 12, 1980. Its edges
    are those of the Gabriel graph whose lune is empty, and it holds the Euclidean minimum spanning tree.
    """
    places = find_places(points_mm)
    tree = places.tree
    links = gabriel_links(places, threads)

    def choose(start: int, stop: int) -> BoolArray:
        kept = np.empty(stop - start, dtype=np.bool_)
        _choose(tree.xyz, tree.box, tree.levels, links[start:stop], kept)
        return kept

    chosen = in_slices(choose, len(links), threads)
    return places.matrix(links[np.concatenate(chosen)] if chosen else links)


@njit(cache=True, nogil=True)
def _choose(xyz: Float64Array, box: Float64Array, levels: int, links: Int32Array, kept: BoolArray) -> None:
    waiting = np.empty(levels + 2, dtype=np.int64)
    for at in range(len(links)):
        kept[at] = point_between(xyz, box, levels, links[at, 0], links[at, 1], True, waiting) < 0
