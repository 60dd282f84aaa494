"""What a pass promised against what it brought, region by region; plans nothing."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.known_surface import KnownSurface, know_surface
from scanner_service.rescan.passes.needs import UNSEEN, Evidence, failing_points
from scanner_service.rescan.passes.recommendation import RecommendedPass
from scanner_service.rescan.regions import RegionReport

_SAME = 0.75  # cells: surface this near to surface that was good before is not new
_BESIDE_MM = 2.0  # new good surface further than this from every place served was promised by nobody
_THERE = 1.5  # cells: a place is good when new good surface that faces alike is this near
_NOBODY = -1


@dataclass(frozen=True, slots=True)
class RegionOutcome:
    """Promised and reached area of one region (UNSEEN: surface outside of any)."""

    region: int
    promised_mm2: float
    reached_mm2: float

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        region = None if self.region == UNSEEN else self.region
        return {"region": region, "promised_mm2": self.promised_mm2, "reached_mm2": self.reached_mm2}


@dataclass(frozen=True, slots=True)
class KindOutcome:
    """What became of the places of one kind of evidence.

    `asked_mm2` is the area that was asked for, edges of hidden space counted for less; `kept_mm2` the whole area of the
    places that are good now.
    """

    evidence: Evidence
    asked_mm2: float
    kept_mm2: float

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {"evidence": self.evidence.name.lower(), "asked_mm2": self.asked_mm2, "kept_mm2": self.kept_mm2}


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a pass: region by region, and by the kind of evidence.

    `kept_mm2` is the area, as it was foretold, of the places that are good now; `besides_mm2` is good surface that was
    found where nothing was promised. `missed_mm` (k, 3) are the places that the pass was to serve and did not.
    """

    regions: tuple[RegionOutcome, ...]
    missed_mm: Float64Array
    kinds: tuple[KindOutcome, ...] = ()
    kept_mm2: float = 0.0
    besides_mm2: float = 0.0

    def __post_init__(self) -> None:
        read_only(self.missed_mm)

    @property
    def promised_mm2(self) -> float:
        """All that was promised."""
        return sum(one.promised_mm2 for one in self.regions)

    @property
    def reached_mm2(self) -> float:
        """All that meets the requirement now, did not before, and lies where something was promised."""
        return sum(one.reached_mm2 for one in self.regions)

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "promised_mm2": self.promised_mm2,
            "reached_mm2": self.reached_mm2,
            "besides_mm2": self.besides_mm2,
            "kept_mm2": self.kept_mm2,
            "regions": [one.to_dict() for one in self.regions],
            "kinds": [one.to_dict() for one in self.kinds],
        }

    @classmethod
    def from_dict(cls, kept: Mapping[str, Any]) -> "Outcome":
        """As `to_dict` told it, with the places of `missed_mm` where they are there too.

        Raises
        ------
        KeyError, TypeError, ValueError : it was not told so.
        """
        regions = tuple(
            RegionOutcome(
                UNSEEN if one["region"] is None else int(one["region"]),
                float(one["promised_mm2"]),
                float(one["reached_mm2"]),
            )
            for one in kept["regions"]
        )
        kinds = tuple(
            KindOutcome(Evidence[str(one["evidence"]).upper()], float(one["asked_mm2"]), float(one["kept_mm2"]))
            for one in kept.get("kinds", ())
        )
        missed = np.array(kept.get("missed_mm", ()), dtype=np.float64).reshape(-1, 3)
        return cls(regions, missed, kinds, float(kept.get("kept_mm2", 0.0)), float(kept.get("besides_mm2", 0.0)))


def reckon(
    done: RecommendedPass,
    before: MapSnapshot,
    before_report: RegionReport,
    after: MapSnapshot,
    after_report: RegionReport,
    cell_mm: float | None = None,
) -> Outcome:
    """Compare the map before and after a pass.

    Good surface is a cell less than half of whose points fail, each side of a thin wall for itself. What is good after
    the pass and lies near no cell that was good before is reached where it lies beside a place that was to be served,
    and is given to the region of the nearest of these; elsewhere it was found besides.
    """
    old = know_surface(before, *failing_points(before_report), cell_mm)
    new = know_surface(after, *failing_points(after_report), cell_mm)
    old_good, old_normals, _ = _good(old)
    new_good, new_normals, new_mm2 = _good(new)
    fresh = np.ones(len(new_good), dtype=np.bool_)
    cell = new.cell_mm
    if len(old_good) and len(new_good):
        tree = cKDTree(_facing(old_good, old_normals, 0.5 * cell))
        near, _ = tree.query(_facing(new_good, new_normals, 0.5 * cell), distance_upper_bound=_SAME * cell)
        fresh = ~np.isfinite(near)
    owner = np.full(len(new_good), _NOBODY, dtype=np.int64)
    missed = np.ones(len(done.places_mm), dtype=np.bool_)
    if len(done.places_mm) and len(new_good):
        away, which = cKDTree(done.places_mm).query(new_good)
        owner = np.where(away <= _BESIDE_MM, done.place_regions[np.minimum(which, len(missed) - 1)], _NOBODY)
        if fresh.any():  # what was good before was not asked for
            tree = cKDTree(_facing(new_good[fresh], new_normals[fresh], 0.8 * cell))
            places = _facing(done.places_mm, done.place_normals, 0.8 * cell)
            missed = ~np.isfinite(tree.query(places, distance_upper_bound=_THERE * cell)[0])
    regions = []
    for region in np.unique(done.place_regions):
        promised = float(done.place_mm2[done.place_regions == region].sum())
        regions.append(RegionOutcome(int(region), promised, float(new_mm2[fresh & (owner == region)].sum())))
    regions.sort(key=lambda one: -one.promised_mm2)
    besides = float(new_mm2[fresh & (owner == _NOBODY)].sum())
    kept_mm2 = float(done.place_area_mm2[~missed].sum())
    return Outcome(tuple(regions), done.places_mm[missed], _kinds(done, ~missed), kept_mm2, besides)


def _kinds(done: RecommendedPass, kept: BoolArray) -> tuple[KindOutcome, ...]:
    """By kind of evidence, what was asked for before the chances of that kind came in, and the area that is good."""
    found = []
    for kind in Evidence:
        mine = done.place_evidence == kind
        if mine.any():
            asked = done.place_mm2 / (done.trust * done.chances[kind])
            found.append(KindOutcome(kind, float(asked[mine].sum()), float(done.place_area_mm2[mine & kept].sum())))
    return tuple(found)


def _good(surface: KnownSurface) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Places, normals and areas of the cells that meet the requirement; a wall seen from both sides counts twice."""
    good = surface.failing_share < 0.5
    both = good & surface.two_sided
    places = np.concatenate([surface.points_mm[good], surface.points_mm[both]])
    normals = np.concatenate([surface.normals[good], -surface.normals[both]])
    return places, normals, np.concatenate([surface.area_mm2[good], surface.area_mm2[both]])


def _facing(places_mm: Float64Array, normals: Float64Array, weight_mm: float) -> Float64Array:
    """(n, 6) places and normals as one place, so that the two sides of a wall are twice the weight apart."""
    return np.hstack([places_mm, weight_mm * normals])
