"""What is still wanted of a surface: places whose scanning would be a gain, and what each belongs to; knows no rig."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.gaps import GapKind
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.hidden_by import hidden_by
from scanner_service.rescan.passes.known_surface import IntArray, KnownSurface
from scanner_service.rescan.passes.marching import FREE
from scanner_service.rescan.passes.nominal import Missing
from scanner_service.rescan.region import RescanRegion
from scanner_service.rescan.regions import RegionReport
from scanner_service.rescan.requirement import Requirement

_OTHER_SIDE = -0.5  # cosine between normals beyond which two places are the two sides of a wall
_THROUGH = 2.8  # cells: how thick a wall may be of which one side is told by the other
_AROUND = 24
_BARE = 0.25  # a region is rarely a square around its middle
_FAR_MM = 4.0  # further than this from known surface hidden space is an empty shadow more often
_BESIDE = 1.3  # so much more is found beside known surface than there
_EMPTIED = 0.05  # share of emptied cells around from which on hidden space is a rest
_SURE = 0.6  # share of solid cells around from which on a rest is taken to begin with surface ...
_RARE = 0.4  # ... and up to which it rarely does: an edge of a shadow, or a thin rest
_LEAST_SURE = 0.2
_REST_MM = 6.0  # a rest this far from known surface is half as likely as one that touches it
_ANOTHER = 0.7  # a noisy place is looked at from at most this share of the angle at which it was noisy
_HEAD_ON_RAD = math.radians(20.0)  # ... and nearer to the normal than this no direction is better
_OUTNUMBER = 1.25
_LEAST_LACKING = 0.25  # share of the density asked for that a steep place lacks at least, when its points fail
UNSEEN = 0
"""The region number of surface that no point has touched, and that no region has found."""


class Evidence(IntEnum):
    """Why a place is believed to be surface."""

    MEASURED = 0  # there are points, but they do not meet the requirement
    FLOOR = 1  # behind a jump in range the far surface goes on
    FRONTIER = 2  # hidden space begins here, beside known surface
    REFERENCE = 3  # the nominal part says so
    BEYOND = 4  # hidden space goes on beyond the outermost points
    FAR = 5  # hidden space begins here, far from all that is known
    REST = 6  # hidden space that is left beside what passes have looked into in vain


HIDDEN_KINDS = (Evidence.FRONTIER, Evidence.BEYOND, Evidence.FAR, Evidence.REST)
"""Hidden space is taken to begin with surface."""

Chances = tuple[float, ...]
"""Good surface for each mm² that is believed in, by `Evidence`; of hidden space before edges are counted for less."""
FIRST_CHANCES: Chances = (1.0, 0.75, 1.2, 0.9, 1.0, 1.0, 2.0)
"""... before a pass has shown it."""


@dataclass(frozen=True, slots=True)
class Needs:
    """Places (n, 3) to be scanned, part frame, with unit normals (n, 3) and the area (n,) each stands for.

    `region` (n,) is the number of the region they belong to (UNSEEN: none), `evidence` (n,) why they are believed in,
    `chance` (n,) how likely they are what they seem, `tried` (n,) where passes were in vain. What a pass must bring
    there: `density_per_mm2` (n,), lines at most `spacing_mm` (n,) apart on the surface, and rays at most
    `incidence_rad` (n,) from the normal. `thin` (n,) is surface with too few points because it was seen too steeply:
    `density_per_mm2` is what it lacks, and rays somewhat steeper than elsewhere will do (`ScannerOptics.limit_rad`).
    """

    places_mm: Float64Array
    normals: Float64Array
    area_mm2: Float64Array
    region: IntArray
    evidence: IntArray
    density_per_mm2: Float64Array
    chance: Float64Array
    spacing_mm: Float64Array
    incidence_rad: Float64Array
    thin: BoolArray
    tried: BoolArray

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

    @classmethod
    def plain(
        cls, places_mm: Float64Array, normals: Float64Array, area_mm2: Float64Array, density_per_mm2: float = 1.0
    ) -> "Needs":
        """Surface of no region that asks for a density and nothing else."""
        n = len(area_mm2)
        none = np.zeros(n, dtype=np.int64)
        density, chance = np.full(n, density_per_mm2), np.ones(n)
        far, wide = np.full(n, np.inf), np.full(n, 0.5 * np.pi)
        thin, fresh = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
        return cls(places_mm, normals, area_mm2, none, none.copy(), density, chance, far, wide, thin, fresh)

    def changed(self, **columns: npt.NDArray[Any]) -> "Needs":
        """With other values in some columns."""
        return Needs(**{name: columns.get(name, getattr(self, name)) for name in self.__slots__})

    def only(self, keep: BoolArray) -> "Needs":
        """Some of them."""
        return Needs(*(getattr(self, name)[keep] for name in self.__slots__))


def failing_points(
    report: RegionReport, regions: Sequence[RescanRegion] | None = None
) -> tuple[BoolArray, npt.NDArray[np.int32]]:
    """(n,) which points fail, and the number of the region each belongs to (0: none).

    `regions` are those of the report as they are followed; None: as they are in the report.
    """
    region = np.zeros(len(report.reason), dtype=np.int32)
    for listed in report.regions if regions is None else regions:
        region[listed.point_rows[listed.point_rows < len(region)]] = listed.number
    return report.judgement.fails, region


@dataclass(frozen=True, slots=True)
class Wanted:
    """What surface must get: a density, and where it is asked for a line spacing on it and an incidence.

    `by_judgement`: where points were judged, the line spacing that the judgement allows there counts (chord error).
    `tops_up`: steep surface asks only for the points that it lacks, from somewhat steeper rays too.
    """

    density_per_mm2: float
    line_spacing_mm: float = math.inf
    incidence_rad: float = 0.5 * math.pi
    by_judgement: bool = False
    tops_up: bool = False

    @classmethod
    def of(cls, density_per_mm2: float, requirement: Requirement | None) -> "Wanted":
        """What a requirement asks for, at a density that is known already."""
        if requirement is None:
            return cls(density_per_mm2)
        spacing, incidence = requirement.line_spacing_mm, requirement.incidence_rad
        return cls(
            density_per_mm2,
            math.inf if spacing is None else spacing,
            0.5 * math.pi if incidence is None else incidence,
            spacing is not None or requirement.chord_error_mm is not None,
        )


def find_needs(
    snapshot: MapSnapshot,
    report: RegionReport,
    surface: KnownSurface,
    wanted: Wanted,
    chances: Chances = FIRST_CHANCES,
    explore: bool = True,
    regions: Sequence[RescanRegion] | None = None,
    missing: Missing | None = None,
) -> Needs:
    """Collect what is wanted.

    Parameters
    ----------
    wanted : what a pass must bring to a place to be a gain.
    chances : how likely each kind of evidence has proved.
    explore : whether surface is reckoned with where hidden space begins, outside of any region.
    regions : the regions as they are followed; None: as they are in the report.
    missing : surface of the nominal part that no point has touched; with it nothing is guessed.
    """
    regions = report.regions if regions is None else regions
    parts = [_measured(surface), _floors(snapshot, report, surface, regions)]
    if missing is not None:
        parts.append(_missing(missing))
    elif explore:
        parts += [_frontier(surface), _backs(surface)]
    places, normals, area, region, evidence, sure = (np.concatenate(column) for column in zip(*parts, strict=True))
    loose = np.flatnonzero(np.isin(evidence, HIDDEN_KINDS))
    region[loose] = hidden_by(regions, places[loose], surface.cell_mm)
    keep = _apart(surface, places, normals, evidence)
    found = tuple(column[keep] for column in (places, normals, area, region, evidence, sure))
    bare = _bare(regions, set(found[3].tolist()))
    places, normals, area, region, evidence, sure = (
        np.concatenate(pair) for pair in zip(found, bare, strict=True)
    )  # fmt: skip
    n = len(area)
    chance = np.array(chances)[evidence] * sure
    needs = Needs(
        places, normals, area, region, evidence, np.full(n, wanted.density_per_mm2), chance,
        np.full(n, wanted.line_spacing_mm), np.full(n, wanted.incidence_rad), np.zeros(n, dtype=np.bool_),
        np.zeros(n, dtype=np.bool_),
    )  # fmt: skip
    return _as_judged(snapshot, report, surface, needs, wanted)


Columns = tuple[Float64Array, Float64Array, Float64Array, IntArray, IntArray, Float64Array]
"""Places, normals, area, region, evidence, and how much more or less each is believed in than its kind."""


def _measured(surface: KnownSurface) -> Columns:
    """Cells most of whose points fail."""
    rows = np.flatnonzero(surface.failing_share >= 0.5)
    kind = np.full(len(rows), Evidence.MEASURED, dtype=np.int64)
    return (
        surface.points_mm[rows],
        surface.normals[rows],
        surface.area_mm2[rows],
        surface.region[rows],
        kind,
        np.ones(len(rows)),
    )


def _floors(
    snapshot: MapSnapshot, report: RegionReport, surface: KnownSurface, regions: Sequence[RescanRegion]
) -> Columns:
    """Along each shadow the far surface goes on to below the near end: from `low` within its plane to under `high`."""
    gaps = report.gaps
    rows = np.flatnonzero(np.isin(gaps.kind, (GapKind.SHADOW, GapKind.FLANK)))
    high, low = gaps.high[rows], gaps.low[rows]
    # of a shadow seen in part the lower end is another pass's: its own ray guesses right more often than the gap's
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
    region = failing_points(report, regions)[1].astype(np.int64)
    number = np.maximum(region[high], region[low])[which]
    keys, first = np.unique(surface.keys(places), return_index=True)
    taken = surface.state.reshape(-1)[keys] == 3
    first = first[~taken]
    across = np.abs(normal[which[first]])
    area = surface.cell_mm**2 / np.maximum(across.sum(axis=1), 1.0)
    kind = np.full(len(first), Evidence.FLOOR, dtype=np.int64)
    return places[first], normal[which[first]], area, number[first], kind, np.ones(len(first))


def _frontier(surface: KnownSurface) -> Columns:
    """Where hidden space begins.

    Rests are rarely surface where they are thin, at their edges, and away from known surface.
    """
    n = len(surface.frontier_mm2)
    sure = 1.0 / np.maximum(np.abs(surface.frontier_normals).sum(axis=1), 1.0)  # edges of it face askew
    kind = np.full(n, Evidence.FRONTIER, dtype=np.int64)
    if len(surface.points_mm):
        away = np.asarray(cKDTree(surface.points_mm).query(surface.frontier_mm)[0])
        kind[away > _FAR_MM] = Evidence.FAR
        low, high = surface.points_mm.min(axis=0), surface.points_mm.max(axis=0)
        off = np.maximum(low - surface.frontier_mm, surface.frontier_mm - high).max(axis=1)
        kind[off > 0.5 * surface.cell_mm] = Evidence.BEYOND
        kind[surface.frontier_emptied > _EMPTIED] = Evidence.REST
        beside, rest = kind == Evidence.FRONTIER, kind == Evidence.REST
        sure[beside] *= _BESIDE - (_BESIDE - 1.0) * np.minimum(away[beside] / _FAR_MM, 1.0)
        solid = (surface.frontier_solid[rest] - _RARE) / (_SURE - _RARE)
        sure[rest] *= np.clip(solid, _LEAST_SURE, 1.0) / (1.0 + (away[rest] / _REST_MM) ** 2)
    none = np.full(n, UNSEEN, dtype=np.int64)
    return surface.frontier_mm, surface.frontier_normals, surface.frontier_mm2, none, kind, sure


def _backs(surface: KnownSurface) -> Columns:
    """The other side of walls thinner than a cell: seen from one side only, and known to be free behind."""
    rows = np.flatnonzero(~surface.two_sided & (surface.failing_share < 0.5))
    alone = np.ones(len(rows), dtype=np.bool_)
    for cells in (2.0, _THROUGH):
        behind = surface.points_mm[rows] - cells * surface.cell_mm * surface.normals[rows]
        alone &= surface.state.reshape(-1)[surface.keys(behind)] == FREE
    rows = rows[alone]
    kind = np.full(len(rows), Evidence.FRONTIER, dtype=np.int64)
    none = np.full(len(rows), UNSEEN, dtype=np.int64)
    return surface.points_mm[rows], -surface.normals[rows], surface.area_mm2[rows], none, kind, np.ones(len(rows))


def _missing(missing: Missing) -> Columns:
    """Surface of the nominal part that no point has touched."""
    kind = np.full(len(missing.area_mm2), Evidence.REFERENCE, dtype=np.int64)
    return missing.places_mm, missing.normals, missing.area_mm2, missing.region, kind, np.ones(len(missing.area_mm2))


def _bare(regions: Sequence[RescanRegion], served: set[int]) -> Columns:
    """Regions of whose surface nothing else tells, each as one place, so that none is left without a word."""
    bare = [
        region
        for region in regions
        if region.number not in served
        and region.reason is not Reason.ISOLATED
        and region.area_mm2 > 0
        and np.isfinite(region.normal).all()
        and np.isfinite(region.centroid_mm).all()
    ]
    return (
        np.array([region.centroid_mm for region in bare]).reshape(-1, 3),
        np.array([region.normal for region in bare]).reshape(-1, 3),
        np.array([region.area_mm2 for region in bare], dtype=np.float64),
        np.array([region.number for region in bare], dtype=np.int64),
        np.full(len(bare), Evidence.FLOOR, dtype=np.int64),
        np.full(len(bare), _BARE),
    )


def _as_judged(
    snapshot: MapSnapshot, report: RegionReport, surface: KnownSurface, needs: Needs, wanted: Wanted
) -> Needs:
    """What each measured place asks for by the verdict on its own points: line spacing by chord, another direction.

    Steep surface is met by many passes a little: where it is topped up, only what is lacking is asked for.
    """
    measured = np.flatnonzero(needs.evidence == Evidence.MEASURED)
    noisy, steep = report.reason == Reason.NOISY, (report.reason == Reason.STEEP) & wanted.tops_up
    if not len(measured) or not (wanted.by_judgement or noisy.any() or steep.any()):
        return needs
    spacing, incidence, density = (
        column.copy() for column in (needs.spacing_mm, needs.incidence_rad, needs.density_per_mm2)
    )
    order = np.argsort(surface.keys(needs.places_mm[measured]), kind="stable")
    keys = surface.keys(needs.places_mm[measured])[order]
    rows = np.flatnonzero(report.judgement.fails)
    at = np.searchsorted(keys, surface.keys(snapshot.points_mm[rows]))
    at = np.minimum(at, len(keys) - 1)
    mine = keys[at] == surface.keys(snapshot.points_mm[rows])
    rows, need = rows[mine], measured[order][at[mine]]
    if wanted.by_judgement:
        np.fmin.at(spacing, need, report.judgement.allowed_mm[rows])
    at_steep, steep_rows = need[steep[rows]], rows[steep[rows]]
    n_steep = np.bincount(at_steep, minlength=len(needs))
    there = np.bincount(at_steep, snapshot.side_density_per_mm2[steep_rows], len(needs)) / np.maximum(n_steep, 1)
    lacking = np.maximum(density - there, _LEAST_LACKING * density)
    thin = (2 * n_steep > np.bincount(need, minlength=len(needs))) & (there < density)
    density[thin] = lacking[thin]
    loud = noisy[rows]
    ray = snapshot.lines.laser_mm[snapshot.line[rows[loud]]] - snapshot.points_mm[rows[loud]]
    cosine = np.abs(np.einsum("ij,ij->i", ray, snapshot.normals[rows[loud]])) / np.linalg.norm(ray, axis=1)
    seen_at = np.where(np.isfinite(cosine), np.arccos(np.minimum(cosine, 1.0)), 0.0)
    np.fmin.at(incidence, need[loud], np.maximum(_ANOTHER * seen_at, _HEAD_ON_RAD))
    # the old points stay: good ones must outnumber them
    count = np.bincount(need[loud], minlength=len(needs)).astype(np.float64)
    density = np.maximum(density, _OUTNUMBER * count / np.maximum(needs.area_mm2, 1e-9))
    return needs.changed(spacing_mm=spacing, incidence_rad=incidence, density_per_mm2=density, thin=thin)


def _apart(surface: KnownSurface, places: Float64Array, normals: Float64Array, evidence: IntArray) -> BoolArray:
    """False for guesses that stand on what is known already: measured surface, free space, or a better guess."""
    keep = np.ones(len(places), dtype=np.bool_)
    guessed = np.flatnonzero(evidence != Evidence.MEASURED)
    if len(guessed) and len(surface.points_mm):
        bound = _THROUGH * surface.cell_mm
        found = cKDTree(surface.points_mm).query(places[guessed], k=_AROUND, distance_upper_bound=bound)
        away, which = np.asarray(found[0]), np.asarray(found[1])
        met = np.minimum(which, len(surface.points_mm) - 1)
        facing = np.einsum("ikj,ij->ik", surface.normals[met], normals[guessed])
        is_near = away[:, 0] <= 1.2 * surface.cell_mm
        other_side = (facing[:, 0] < _OTHER_SIDE) & ~surface.two_sided[met[:, 0]]
        # the other side of a thin wall may be measured in the cells behind those of this one
        seen = (np.isfinite(away) & (facing > -_OTHER_SIDE)).any(axis=1)
        keep[guessed] = ~is_near | (other_side & ~seen)
    keep[_in_the_air(surface, places, normals) & (evidence == Evidence.FLOOR)] = False
    floors = np.flatnonzero((evidence == Evidence.FLOOR) & keep)
    frontier = np.flatnonzero(np.isin(evidence, HIDDEN_KINDS) & keep)
    if len(floors) and len(frontier):
        near, _ = cKDTree(places[floors]).query(places[frontier], distance_upper_bound=surface.cell_mm)
        keep[frontier] = ~np.isfinite(near)
    return keep


def _in_the_air(surface: KnownSurface, places: Float64Array, normals: Float64Array) -> BoolArray:
    """(n,) True for places that rays went through, and a cell below them too."""
    state = surface.state.reshape(-1)
    below = places - surface.cell_mm * normals
    return np.asarray((state[surface.keys(places)] == FREE) & (state[surface.keys(below)] == FREE))
