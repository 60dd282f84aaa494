"""The surface as far as a map knows it: cells with a place and a normal, and what is solid, hidden or free around them.

Made from the map's own points: each point is surface, the way from it to its laser is free, and what lies behind it is
hidden unless another ray went through. Knows no regions' reasons and no rig.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.looks import Look, mark_empty
from scanner_service.rescan.passes.marching import (
    HIDDEN,
    SURFACE,
    carve,
    fill_pockets,
    gather,
    open_faces,
    outward,
    share_around,
)
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.solid import set_nominal
from scanner_service.rescan.reference import Pieces

IntArray = npt.NDArray[np.int64]
MAX_CELLS = 6_000_000
MAX_OPEN = 200_000
LEAST_CELL_MM = 0.35
_LINES_IN_A_CELL = 1.3  # so that a surface at the coarsest line spacing leaves no cell empty
_ONE_SIDED = 0.6  # length of the mean normal below which the normals of a cell point both ways
_FACING = 8.0  # hidden space that is thinner than this tells of no surface; a plane boundary gives 25
_TURNED = 0.6  # what is taken off a border's leaning towards the lasers: see `_behind_edges`
_SHADOWED = 0.8  # cosine to the lasers up to which a border is the side of a shadow, not one that faces them
_MARGIN_MM = 1.5  # how far beyond the outermost points hidden surface is reckoned with: the next pass sees further


@dataclass(frozen=True, slots=True)
class KnownSurface:
    """What is known of a part, in cells of side `cell_mm` from the corner `low_mm` (3,), part frame.

    `state` (i, j, k) is UNTOUCHED, FREE, HIDDEN or SURFACE as in `marching`, `row` (i, j, k) the row of a cell with
    points, -1 without. One row a cell with points:
    `points_mm`, `normals` (m, 3; unit, towards the laser), `area_mm2`, `count`, `failing_share` (m,) and `region` (m,),
    the number that failing points gave (0: none); `two_sided` (m,) where both sides of a thin wall were seen;
    `by_shadow` (m,) where most of the failing points lack nothing but what a shadow beside them hides.
    `frontier_mm`, `frontier_normals` (f, 3) and `frontier_mm2` (f,) are where hidden space begins: surface that no
    point has touched may be there. `frontier_solid` (f,) is the share of what is solid or hidden around, and
    `frontier_emptied` (f,) that of what passes have looked into in vain. `looks` are passes whose poses are known.
    """

    low_mm: Float64Array
    cell_mm: float
    state: npt.NDArray[np.uint8]
    row: npt.NDArray[np.int32]
    points_mm: Float64Array
    normals: Float64Array
    area_mm2: Float64Array
    count: IntArray
    failing_share: Float64Array
    region: IntArray
    two_sided: BoolArray
    frontier_mm: Float64Array
    frontier_normals: Float64Array
    frontier_mm2: Float64Array
    frontier_solid: Float64Array
    frontier_emptied: Float64Array
    by_shadow: BoolArray
    looks: tuple[Look, ...] = ()

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                read_only(value)

    def keys(self, places_mm: Float64Array) -> IntArray:
        """(n,) one number for the cell that each place (n, 3) lies in, clipped to the grid."""
        at = np.floor((places_mm - self.low_mm) / self.cell_mm).astype(np.int64)
        at = np.clip(at, 0, np.array(self.state.shape) - 1)
        return np.asarray(np.ravel_multi_index((at[:, 0], at[:, 1], at[:, 2]), self.state.shape), dtype=np.int64)


def know_surface(
    snapshot: MapSnapshot,
    fails: BoolArray,
    region: npt.NDArray[np.int32],
    cell_mm: float | None = None,
    looks: tuple[Look, ...] = (),
    optics: ScannerOptics | None = None,
    nominal: Pieces | None = None,
    by_shadow: BoolArray | None = None,
) -> KnownSurface:
    """The surface a map knows.

    Parameters
    ----------
    snapshot : the live map; points that are not counted are left out.
    fails : (n,) True for points that do not meet the requirement.
    region : (n,) number of the region of a failing point, 0 for none.
    cell_mm : side of a cell; None: wide enough for the map's line spacing and for at most MAX_CELLS cells.
    looks, optics : passes whose poses are known, and the scanner's: what they looked into in vain is not hidden.
    nominal : the nominal part, where there is one: what lies outside of it is not hidden, and its surface stands in the
        way.
    by_shadow : (n,) True for points that fail for a shadow beside them alone; None: nobody knows.
    """
    use = snapshot.neighbours > 0
    points = snapshot.points_mm
    if not use.any():
        return _nothing()
    mine = points[use]
    low, high = mine.min(axis=0), mine.max(axis=0)
    margin = _MARGIN_MM
    side = _cell_side(snapshot, low - margin, high + margin) if cell_mm is None else cell_mm
    low = low - margin
    shape = tuple(math.ceil(float(extent) / side) + 1 for extent in high + margin - low)
    index = np.full(shape, -1, dtype=np.int32)
    sums = np.zeros((min(int(use.sum()), int(np.prod(shape))), 10))
    bits = np.zeros(len(sums), dtype=np.uint64)
    first = np.zeros(len(points), dtype=np.bool_)
    lines = snapshot.lines
    count = gather(
        points, use, snapshot.line, lines.pass_number, snapshot.normals, fails, region, low, side, index, sums, first,
        bits,
    )  # fmt: skip
    sums = sums[:count]
    state = np.where(index >= 0, SURFACE, 0).astype(np.uint8)
    carve(state, low, side, np.flatnonzero(first), points, snapshot.line, lines.laser_mm, math.inf)
    fill_pockets(state, 3)
    places = sums[:, :3] / sums[:, 6:7]
    normals = _normals(sums[:, 3:6], state, low, side, places, lines.laser_mm)
    # so many cells does a plane of this slope cut through on a square of one cell
    area = side * side / np.maximum(np.abs(normals).sum(axis=1), 1.0)
    if nominal is not None:
        set_nominal(state, low, side, nominal)
    open_cells, gradient = _frontier(state)
    freed = state == HIDDEN
    if looks and optics is not None and mark_empty(state, low, side, looks, optics, open_cells, gradient):
        open_cells, gradient = _frontier(state)
    freed &= state != HIDDEN
    solid, emptied = np.zeros(len(open_cells)), np.zeros(len(open_cells))
    share_around(state >= HIDDEN, open_cells, solid)
    share_around(freed, open_cells, emptied)
    border, middle = low + (open_cells + 0.5) * side, np.asarray(lines.laser_mm.mean(axis=0))
    return KnownSurface(
        low_mm=low,
        cell_mm=side,
        state=state,
        row=index,
        points_mm=places,
        normals=normals,
        area_mm2=area,
        count=sums[:, 6].astype(np.int64),
        failing_share=sums[:, 7] / sums[:, 6],
        region=sums[:, 8].astype(np.int64),
        two_sided=np.linalg.norm(sums[:, 3:6], axis=1) < _ONE_SIDED * sums[:, 9],
        frontier_mm=border,
        frontier_normals=_behind_edges(border, gradient, middle),
        frontier_mm2=side * side / np.maximum(np.abs(gradient).max(axis=1, initial=0.5), 0.5),
        frontier_solid=solid,
        frontier_emptied=emptied,
        by_shadow=_mostly(by_shadow, fails, use, points, low, side, index, len(sums)),
        looks=looks,
    )


def _mostly(
    which: BoolArray | None,
    of: BoolArray,
    use: BoolArray,
    points_mm: Float64Array,
    low_mm: Float64Array,
    cell_mm: float,
    index: npt.NDArray[np.int32],
    cells: int,
) -> BoolArray:
    """(cells,) where more than half of some points, those `of` them that are used, are such."""
    if which is None:
        return np.zeros(cells, dtype=np.bool_)
    rows = np.flatnonzero(of & use)
    at = np.floor((points_mm[rows] - low_mm) / cell_mm).astype(np.int64)
    row = index[at[:, 0], at[:, 1], at[:, 2]]
    more: BoolArray = 2.0 * np.bincount(row, which[rows], cells) > np.bincount(row, minlength=cells)
    return more


def _frontier(state: npt.NDArray[np.uint8]) -> tuple[IntArray, Float64Array]:
    """Cells (f, 3) where hidden space begins, and where they face (f, 3); those that face nowhere are left out."""
    cells = np.empty((MAX_OPEN, 3), dtype=np.int64)
    cells = cells[: open_faces(state, cells)]
    gradient = np.zeros((len(cells), 3))
    outward(state, cells, gradient)
    length = np.linalg.norm(gradient, axis=1)
    sure = length > _FACING
    return cells[sure], gradient[sure] / length[sure, None]


def _behind_edges(border_mm: Float64Array, facing: Float64Array, lasers_mm: Float64Array) -> Float64Array:
    """How the surface behind a border of hidden space (f, 3) probably faces, when the border itself faces so (f, 3).

    The side of a shadow lies along the rays that pass its edge. Whatever surface begins at that edge was not seen by
    them: it is turned further away from the lasers, and is mostly a wall that stands up to them.
    """
    towards = _towards(border_mm, lasers_mm)
    cosine = np.einsum("ij,ij->i", facing, towards)
    leaning = np.where((cosine > 0) & (cosine < _SHADOWED), _TURNED * cosine, 0.0)
    turned = facing - leaning[:, None] * towards
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True), dtype=np.float64)


def _towards(places_mm: Float64Array, lasers_mm: Float64Array) -> Float64Array:
    way = lasers_mm - places_mm
    return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True), dtype=np.float64)


def _cell_side(snapshot: MapSnapshot, low: Float64Array, high: Float64Array) -> float:
    spacing = snapshot.lines.line_spacing_mm[~snapshot.lines.stationary]
    along = snapshot.lines.point_spacing_mm
    coarsest = max(
        float(np.median(spacing)) if len(spacing) else 0.0, float(np.nanmedian(along)) if len(along) else 0.0
    )
    by_lines = max(LEAST_CELL_MM, _LINES_IN_A_CELL * coarsest)
    volume_mm3 = float(np.prod(high - low))
    return max(by_lines, float((volume_mm3 / MAX_CELLS) ** (1.0 / 3.0)))


def _normals(
    sums: Float64Array,
    state: npt.NDArray[np.uint8],
    low: Float64Array,
    side: float,
    places: Float64Array,
    lasers: Float64Array,
) -> Float64Array:
    """Mean of the reliable normals of each cell; without one, away from what is solid around it."""
    normals = sums.copy()
    length = np.linalg.norm(normals, axis=1)
    without = np.flatnonzero(length < 1e-3)
    if len(without):
        gradient = np.zeros((len(without), 3))
        outward(state, np.floor((places[without] - low) / side).astype(np.int64), gradient)
        towards = _towards(places[without], lasers.mean(axis=0))
        size = np.linalg.norm(gradient, axis=1)
        normals[without] = np.where(size[:, None] > 1.0, gradient, towards)
        length[without] = np.linalg.norm(normals[without], axis=1)
    return np.asarray(normals / length[:, None], dtype=np.float64)


def _nothing() -> KnownSurface:
    none, flat = np.zeros((0, 3)), np.zeros(0)
    whole = np.zeros(0, dtype=np.int64)
    state, row = np.zeros((1, 1, 1), dtype=np.uint8), np.full((1, 1, 1), -1, dtype=np.int32)
    return KnownSurface(
        np.zeros(3), LEAST_CELL_MM, state, row, none, none.copy(), flat, whole, flat.copy(), whole.copy(),
        np.zeros(0, dtype=np.bool_), none.copy(), none.copy(), flat.copy(), flat.copy(), flat.copy(),
        np.zeros(0, dtype=np.bool_),
    )  # fmt: skip
