"""What is still wanted of a surface: places whose scanning would be a gain, and what each belongs to; knows no rig."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.gaps import GapKind
from scanner_service.rescan.passes.known_surface import IntArray, KnownSurface
from scanner_service.rescan.passes.marching import FREE
from scanner_service.rescan.regions import RegionReport

_OTHER_SIDE = -0.5  # cosine between normals beyond which two places are the two sides of a wall
UNSEEN = 0
"""The region number of surface that no point has touched, and that no region has found."""


class Evidence(IntEnum):
    """Why a place is believed to be surface."""

    MEASURED = 0  # there are points, but they do not meet the requirement
    FLOOR = 1  # behind a jump in range the far surface goes on
    FRONTIER = 2  # hidden space begins here
    REFERENCE = 3  # the nominal part says so


@dataclass(frozen=True, slots=True)
class Needs:
    """Places (n, 3) to be scanned, part frame, with unit normals (n, 3) and the area (n,) each stands for.

    `region` (n,) is the number of the region they belong to (UNSEEN: none), `evidence` (n,) why they are believed in,
    `density_per_mm2` (n,) what a pass must bring there, `chance` (n,) how likely they are what they seem.
    """

    places_mm: Float64Array
    normals: Float64Array
    area_mm2: Float64Array
    region: IntArray
    evidence: IntArray
    density_per_mm2: Float64Array
    chance: Float64Array

    def __post_init__(self) -> None:
        for name in self.__slots__:
            read_only(getattr(self, name))

    def __len__(self) -> int:
        return len(self.area_mm2)

    @property
    def gain_mm2(self) -> Float64Array:
        """(n,) area that may be counted on."""
        gain: Float64Array = self.area_mm2 * self.chance
        return gain

    def only(self, keep: BoolArray) -> "Needs":
        """Some of them."""
        return Needs(*(getattr(self, name)[keep] for name in self.__slots__))


def failing_points(report: RegionReport) -> tuple[BoolArray, npt.NDArray[np.int32]]:
    """(n,) which points fail, and the number of the region each belongs to (0: none)."""
    region = np.zeros(len(report.reason), dtype=np.int32)
    for listed in report.regions:
        region[listed.point_rows] = listed.number
    return report.judgement.fails, region


def find_needs(
    snapshot: MapSnapshot,
    report: RegionReport,
    surface: KnownSurface,
    required_per_mm2: float,
    chances: dict[Evidence, float] | None = None,
    explore: bool = True,
) -> Needs:
    """Collect what is wanted.

    Parameters
    ----------
    required_per_mm2 : density that a pass must bring to a place to be a gain.
    chances : how likely each kind of evidence has proved; 1 for what is not named.
    explore : whether surface is reckoned with where hidden space begins, outside of any region.
    """
    parts = [_measured(surface), _floors(snapshot, report, surface)]
    if explore:
        parts += [_frontier(surface), _backs(surface)]
    places, normals, area, region, evidence = (np.concatenate(column) for column in zip(*parts, strict=True))
    keep = _apart(surface, places, normals, evidence)
    chance = np.array([(chances or {}).get(kind, 1.0) for kind in Evidence])[evidence]
    needs = Needs(places, normals, area, region, evidence, np.full(len(area), required_per_mm2), chance)
    return needs.only(keep)


Columns = tuple[Float64Array, Float64Array, Float64Array, IntArray, IntArray]


def _measured(surface: KnownSurface) -> Columns:
    """Cells most of whose points fail."""
    rows = np.flatnonzero(surface.failing_share >= 0.5)
    kind = np.full(len(rows), Evidence.MEASURED, dtype=np.int64)
    return surface.points_mm[rows], surface.normals[rows], surface.area_mm2[rows], surface.region[rows], kind


def _floors(snapshot: MapSnapshot, report: RegionReport, surface: KnownSurface) -> Columns:
    """Along each shadow the far surface goes on to below the near end: from `low` within its plane to under `high`."""
    gaps = report.gaps
    rows = np.flatnonzero(np.isin(gaps.kind, (GapKind.SHADOW, GapKind.FLANK)))
    high, low = gaps.high[rows], gaps.low[rows]
    ray = snapshot.points_mm[low] - snapshot.lines.laser_mm[snapshot.line[low]]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True) if len(ray) else 1.0
    normal = np.where(np.isfinite(snapshot.normals[low]), snapshot.normals[low], -ray)
    start, end = snapshot.points_mm[low], snapshot.points_mm[high]
    slope = np.einsum("ij,ij->i", ray, normal)
    usable = np.abs(slope) > 0.3
    fall = np.einsum("ij,ij->i", start - end, normal) / np.where(usable, slope, 1.0)
    foot = end + fall[:, None] * ray
    length = np.linalg.norm(foot - start, axis=1)
    usable &= (length > surface.cell_mm) & (fall > 0) & (length < 2.0 * np.linalg.norm(end - start, axis=1))
    steps = np.arange(0.5, max(1.0, float(length[usable].max(initial=0.0)) / surface.cell_mm))
    share = steps[None, :] * surface.cell_mm / np.maximum(length[:, None], 1e-9)
    which, step = np.nonzero(usable[:, None] & (share < 1.0))
    places = start[which] + share[which, step][:, None] * (foot - start)[which]
    region = np.zeros(len(snapshot), dtype=np.int64)
    for listed in report.regions:
        region[listed.point_rows] = listed.number
    number = np.maximum(region[high], region[low])[which]
    keys, first = np.unique(surface.keys(places), return_index=True)
    taken = surface.state.reshape(-1)[keys] == 3
    first = first[~taken]
    across = np.abs(normal[which[first]])
    area = surface.cell_mm**2 / np.maximum(across.sum(axis=1), 1.0)
    kind = np.full(len(first), Evidence.FLOOR, dtype=np.int64)
    return places[first], normal[which[first]], area, number[first], kind


def _frontier(surface: KnownSurface) -> Columns:
    """Where hidden space begins; it belongs to no region."""
    n = len(surface.frontier_mm2)
    kind = np.full(n, Evidence.FRONTIER, dtype=np.int64)
    none = np.full(n, UNSEEN, dtype=np.int64)
    return surface.frontier_mm, surface.frontier_normals, surface.frontier_mm2, none, kind


def _backs(surface: KnownSurface) -> Columns:
    """The other side of walls thinner than a cell: seen from one side only, and known to be free behind."""
    rows = np.flatnonzero(~surface.two_sided & (surface.failing_share < 0.5))
    alone = np.ones(len(rows), dtype=np.bool_)
    for cells in (2.0, 2.8):
        behind = surface.points_mm[rows] - cells * surface.cell_mm * surface.normals[rows]
        alone &= surface.state.reshape(-1)[surface.keys(behind)] == FREE
    rows = rows[alone]
    kind = np.full(len(rows), Evidence.FRONTIER, dtype=np.int64)
    none = np.full(len(rows), UNSEEN, dtype=np.int64)
    return surface.points_mm[rows], -surface.normals[rows], surface.area_mm2[rows], none, kind


def _apart(surface: KnownSurface, places: Float64Array, normals: Float64Array, evidence: IntArray) -> BoolArray:
    """False for guesses that stand on what is known already: measured surface, or a better guess."""
    keep = np.ones(len(places), dtype=np.bool_)
    guessed = np.flatnonzero(evidence != Evidence.MEASURED)
    if len(guessed) and len(surface.points_mm):
        near, which = cKDTree(surface.points_mm).query(places[guessed], distance_upper_bound=1.2 * surface.cell_mm)
        met = np.minimum(which, len(surface.points_mm) - 1)
        facing = np.einsum("ij,ij->i", surface.normals[met], normals[guessed])
        keep[guessed] = ~np.isfinite(near) | ((facing < _OTHER_SIDE) & ~surface.two_sided[met])
    floors = np.flatnonzero((evidence == Evidence.FLOOR) & keep)
    frontier = np.flatnonzero((evidence == Evidence.FRONTIER) & keep)
    if len(floors) and len(frontier):
        near, _ = cKDTree(places[floors]).query(places[frontier], distance_upper_bound=surface.cell_mm)
        keep[frontier] = ~np.isfinite(near)
    return keep
