"""Orientation of normals over the Riemannian graph; knows the steps of the method, and says where it guessed."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.graphs.kd_tree import Int32Array, squares_to
from scanner_service.analysis.graphs.places import LARGEST, Places, find_places
from scanner_service.analysis.graphs.riemannian import NEIGHBOURS, check_neighbours, riemannian_links
from scanner_service.analysis.graphs.shortest_links import shortest_links
from scanner_service.analysis.graphs.spanning import Float32Array, minimum_spanning_forest
from scanner_service.analysis.orientation.evidence import Evidence, enclosed, weigh_components
from scanner_service.analysis.orientation.links import CLEAR, Int8Array, LinkKind, judge_links
from scanner_service.analysis.orientation.result import ComponentTable, Doubt, Orientation
from scanner_service.analysis.orientation.rows import Int64Array, first_places, turn_rows, unit_rows, weigh_links
from scanner_service.analysis.orientation.spreading import patches, spread

GAP_FACTOR = 5.0
"""A link is a gap when it is longer than this many times the reach of its k nearest neighbours, at the denser end."""

LEAST_POINTS = 20
"""A component of fewer points tells nothing about its outside."""

OPEN = 0.1
"""Above this share of uncompensated area a surface counts as open."""

FULL = 0.1
"""Below this fullness the enclosed volume does not tell inside from outside."""

CONTRADICTING = 0.01
"""Above this share of contradicting links nothing is sure."""

_NO_VOLUME = np.uint8(Doubt.SMALL | Doubt.OPEN | Doubt.CONTRADICTION)
_SIDE_UNKNOWN = _NO_VOLUME | np.uint8(Doubt.FLAT | Doubt.ENCLOSED)


def orient_normals(
    points_mm: npt.ArrayLike,
    normals: npt.ArrayLike,
    *,
    neighbours: int = NEIGHBOURS,
    gap_factor: float = GAP_FACTOR,
    plain: bool = False,
    threads: int = 1,
) -> Orientation:
    """Turn normals to one side of the surface, component by component, and say how sure that is.

    Parameters
    ----------
    points_mm : (n, 3) mm. Points that are not finite are left out.
    normals : (n, 3) of any length and sign. NaN or 0 means that a point has none; it is left out.
    neighbours : k of the Riemannian graph.
    gap_factor : links longer than this many times the smaller of the reaches of the k nearest neighbours at their ends
        join nothing; what they would join are separate components.
    plain : the method as Hoppe has it: one component, every link judged by n·m alone, the start alone decides.

    Returns
    -------
    Orientation of n rows. A component starts at its point with the largest z, whose normal is given +z. Where the
    component is closed, the volume that it encloses must be positive; where it is not, all is turned.

    Raises
    ------
    ValueError : shapes that do not fit, no point with a normal, k < 1, or a gap factor that is not positive.

    Notes
    -----
    Riemannian graph, costs 1 - |n·m| and spreading along their minimum spanning tree: Hoppe et al. 1992. Links that may
    leap between sheets come last (`links`), so a point is unsure only where no other way leads to it.
    """
    check_neighbours(neighbours)
    if not gap_factor > 0:
        raise ValueError(f"the gap factor must be greater than 0, not {gap_factor}")
    points, given, rows, left_out = _take_part(points_mm, normals)
    places = find_places(points if len(rows) == len(points) else points[rows])
    xyz, row = places.tree.xyz, rows[places.tree.row]
    unit = unit_rows(given, row)
    web = _weave(places, unit, neighbours, np.inf if plain else gap_factor, plain, threads)
    component, starts, sure = _components(web, xyz[:, 2], row, plain)
    side = np.ones(len(row), dtype=np.int8)
    side[starts] = np.where(unit[starts, 2] < 0.0, -1, 1)
    spread(starts, web.links, web.sign, web.is_tree, side)
    links, disagreeing = weigh_links(web.links, web.kind, web.sign, side, component, len(starts), sure)
    area = web.area
    del web
    unit *= side[:, None]
    evidence = weigh_components(xyz, unit, area, component, len(starts))
    sure_points = np.bincount(component, sure, len(starts)).astype(np.int64)
    doubt = _doubt(evidence, links, disagreeing, sure_points)
    turned = (doubt & _NO_VOLUME == 0) & (evidence.fullness < 0.0) & (not plain)
    side = np.where(turned[component], -side, side).astype(np.int8)
    doubt[enclosed(xyz, unit, area, component, doubt & _SIDE_UNKNOWN == 0)] |= np.uint8(Doubt.ENCLOSED)
    outside_known = doubt & _SIDE_UNKNOWN == 0
    components = ComponentTable(
        points=evidence.points,
        sure_points=sure_points,
        start_row=row[starts].astype(np.int64),
        confidence=0.5 + 0.5 * outside_known * sure_points / evidence.points,
        openness=evidence.openness,
        fullness=np.where(turned, -evidence.fullness, evidence.fullness),
        turned=turned,
        links=links,
        disagreeing=disagreeing,
        doubt=doubt,
    )
    sure &= outside_known[component]
    return _to_rows(given, places, rows, side, component, sure, components, left_out)


def _take_part(
    points_mm: npt.ArrayLike, normals: npt.ArrayLike
) -> tuple[Float64Array, Float64Array, Int32Array, dict[str, int]]:
    """Points and normals as arrays, the rows that have both, and how many have not, by reason."""
    points, given = np.asarray(points_mm, dtype=np.float64), np.asarray(normals, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or given.shape != points.shape:
        raise ValueError(f"points and normals must both have the shape (n, 3), not {points.shape} and {given.shape}")
    with np.errstate(invalid="ignore"):
        is_place = (points <= LARGEST).all(axis=1) & (points >= -LARGEST).all(axis=1)
    is_normal = np.isfinite(given).all(axis=1) & given.any(axis=1)
    left_out = {"not_finite": int((~is_place).sum()), "no_normal": int((is_place & ~is_normal).sum())}
    rows = np.flatnonzero(is_place & is_normal).astype(np.int32)
    if not len(rows):
        raise ValueError(
            f"none of {len(points)} points has both a place and a normal, so there is nothing to orient: "
            "estimate normals first, perhaps with a larger radius"
        )
    return points, given, rows, left_out


@dataclass(frozen=True, slots=True)
class _Web:
    """The Riemannian graph: links (m, 2), what they say, which make up the minimum spanning forest of their costs.

    `area` (n,) is the share of the surface that a point stands for, mm²: that of its reach over k. `group`
    (n,) numbers the trees.
    """

    links: Int32Array
    kind: npt.NDArray[np.uint8]
    sign: Int8Array
    is_tree: BoolArray
    group: Int32Array
    area: Float64Array


def _weave(places: Places, unit: Float32Array, neighbours: int, gap_factor: float, plain: bool, threads: int) -> _Web:
    """Riemannian graph, cost of each link, and the minimum spanning forest of those that are no gap."""
    xyz = places.tree.xyz
    near = places.nearest(neighbours, threads)
    if near.shape[1]:
        reach_sq = squares_to(xyz, near[:, -1])
        links = riemannian_links(shortest_links(places.tree, near), near)
    else:
        reach_sq = np.ones(len(xyz))
        links = np.empty((0, 2), dtype=np.int32)
    del near
    weight, kind, sign = judge_links(xyz, unit, links, reach_sq, gap_factor, plain, threads)
    joins = kind != LinkKind.GAP
    if not joins.all():
        links, weight, kind, sign = links[joins], weight[joins], kind[joins], sign[joins]
    del joins
    is_tree, group = minimum_spanning_forest(len(xyz), links[:, 0], links[:, 1], weight)
    return _Web(links, kind, sign, is_tree, group, (np.pi / neighbours) * reach_sq)


def _components(
    web: _Web, z_mm: Float64Array, row: Int32Array, plain: bool
) -> tuple[Int32Array, Int32Array, BoolArray]:
    """The component (n,) of each place, by falling number of places, the start (C,) of each, and who is sure (n,).

    Sure is the largest patch of a component that no doubtful link holds together. The start is the point of the
    largest z in it; in the plain method, in the component.
    """
    n = len(row)
    patch = patches(n, web.links, web.is_tree & (web.kind <= LinkKind.CREASE))
    largest, start = first_places(web.group, patch, z_mm, row)
    trees = np.flatnonzero(start >= 0)
    first = first_places(web.group, web.group, z_mm, row)[1][trees] if plain else start[trees]
    size = np.bincount(web.group, minlength=n)[trees]
    by_size = np.lexsort((row[first], -size))
    rank = np.full(n, -1, dtype=np.int32)
    rank[trees[by_size]] = np.arange(len(trees))
    sure: BoolArray = patch == largest[web.group]
    return rank[web.group], first[by_size], sure


def _doubt(
    evidence: Evidence, links: Int64Array, disagreeing: Int64Array, sure_points: Int64Array
) -> npt.NDArray[np.uint8]:
    """Why each component, or a part of it, is a guess."""
    small = evidence.points < LEAST_POINTS
    is_open = ~small & (evidence.openness > OPEN)
    flat = ~small & ~is_open & (np.abs(evidence.fullness) < FULL)
    contradicts = disagreeing > CONTRADICTING * links
    doubt = np.zeros(len(small), dtype=np.uint8)
    for why, where in (
        (Doubt.SMALL, small),
        (Doubt.OPEN, is_open),
        (Doubt.FLAT, flat),
        (Doubt.LINKS, ~small & (sure_points < evidence.points)),
        (Doubt.CONTRADICTION, contradicts),
    ):
        doubt[where] |= np.uint8(why)
    return doubt


def _to_rows(
    given: Float64Array,
    places: Places,
    rows: Int32Array,
    side: Int8Array,
    component: Int32Array,
    sure: BoolArray,
    components: ComponentTable,
    left_out: dict[str, int],
) -> Orientation:
    """From places in tree order to the rows of the cloud; a twin is turned like the point that stands for it."""
    row = rows[places.tree.row]
    sign = np.zeros(len(given), dtype=np.int8)
    of = np.full(len(given), -1, dtype=np.int32)
    is_sure = np.zeros(len(given), dtype=np.bool_)
    sign[row], of[row], is_sure[row] = side, component, sure
    twin, first = rows[places.twin], rows[places.twin_of]
    if len(twin):
        along = (unit_rows(given, twin) * unit_rows(given, first)).sum(axis=1)
        sign[twin] = np.where(along < 0.0, -1, 1) * sign[first]
        of[twin] = of[first]
        is_sure[twin] = is_sure[first] & (np.abs(along) >= CLEAR)
    return Orientation(turn_rows(given, sign), of, is_sure, components, left_out)
