"""The Delaunay graph: who meets whom in the triangulation, also where all points lie in a plane or on a line."""

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.spatial import Delaunay, QhullError

from drivers.scanline import Float64Array
from scanner_service.analysis.graphs.kd_tree import Int32Array
from scanner_service.analysis.graphs.places import find_places
from scanner_service.analysis.graphs.shortest_links import shortest_links
from scanner_service.analysis.graphs.spanning_tree import SEED_NEIGHBOURS

WIDEST = 1e6
"""How much wider than its spacing a cloud may be: Qhull squares coordinates, and float64 holds 16 digits."""

FLAT = 1e-12
"""Points are coplanar, or collinear, when they leave the plane or line by less than this share of their extent."""


def delaunay_graph(points_mm: npt.ArrayLike) -> csr_array:
    """The Delaunay graph of a cloud: {p, q} is an edge of its Delaunay triangulation.

    Parameters
    ----------
    points_mm : (n, 3), finite, mm. Coplanar points are triangulated in their plane, collinear ones joined in a row, so
        1, 2, 3 points are no special case. Identical points share a place, where the first stands for all.

    Returns
    -------
    Symmetric sparse matrix (n, n) of edge lengths in mm; zeros that are stored are edges between identical points.

    Raises
    ------
    ValueError : no points, some not finite, or Qhull finds no triangulation within rounding.

    Notes
    -----
    Qhull (Barber, Dobkin and Huhdanpaa 1996) through scipy. Where five points or more lie on one sphere the
    triangulation is one of several; a point that Qhull cannot tell from another is joined to that one. Of a surface of
    n points the triangulation can have far more than n edges: it is the slowest and largest of the graphs.
    """
    places = find_places(points_mm)
    xyz = places.tree.xyz
    near = places.nearest(SEED_NEIGHBOURS)
    if len(xyz) > 1:
        spacing = float(np.median(np.sqrt(((xyz - xyz[near[:, 0]]) ** 2).sum(axis=1))))
        extent = float(np.ptp(xyz, axis=0).max())
        if extent > WIDEST * spacing:
            raise ValueError(
                f"the cloud is {extent:g} mm wide and its points lie {spacing:g} mm apart: too wide for Qhull's "
                "arithmetic; leave out a far outlier, or points that almost coincide"
            )
    links = _triangulate(xyz)
    if not _holds(links, shortest_links(places.tree, near), len(xyz)):
        raise ValueError(
            f"Qhull lost edges of these {len(xyz)} points to rounding: leave out points that almost coincide, or a far "
            "outlier"
        )
    return places.matrix(links)


def _holds(links: Int32Array, others: Int32Array, n: int) -> bool:
    """Whether all the others are among the links; the spanning tree must be, whatever the points."""
    key, wanted = (pairs.min(axis=1).astype(np.int64) * n + pairs.max(axis=1) for pairs in (links, others))
    return bool(np.isin(wanted, key).all())


def _triangulate(xyz: Float64Array) -> Int32Array:
    """(m, 2) rows that meet in a simplex."""
    centred = xyz - np.median(xyz, axis=0)
    axes = np.linalg.eigh(np.cov(centred.T))[1] if len(xyz) > 1 else np.eye(3)
    along = centred @ axes[:, ::-1]  # by falling spread
    extent = np.ptp(along, axis=0)
    rounding = FLAT * extent[0] + 16.0 * np.finfo(np.float64).eps * np.abs(xyz).max()
    dimensions = int((extent > rounding).sum())
    if dimensions == 0 or len(xyz) < 2:
        return np.empty((0, 2), dtype=np.int32)
    if dimensions == 1 or len(xyz) == 2:
        order = np.argsort(along[:, 0])
        return np.column_stack([order[:-1], order[1:]]).astype(np.int32)
    if len(xyz) == 3:
        dimensions = 2
    try:
        found = Delaunay(along[:, :dimensions] if dimensions == 2 else centred)
    except QhullError as error:
        reason = str(error).strip().splitlines()[0]
        raise ValueError(
            f"these {len(xyz)} points have no Delaunay triangulation within rounding ({reason}): "
            "remove points that almost coincide, or a far outlier"
        ) from error
    corners = found.simplices
    pairs = [corners[:, [a, b]] for a in range(corners.shape[1]) for b in range(a)]
    links = np.concatenate([*pairs, found.coplanar[:, [0, 2]]])
    key = np.unique(links.min(axis=1).astype(np.int64) * len(xyz) + links.max(axis=1))
    return np.column_stack(np.divmod(key, len(xyz))).astype(np.int32)
