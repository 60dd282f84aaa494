"""What a pass promised against what it brought, region by region; plans nothing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array, read_only
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.known_surface import KnownSurface, know_surface
from scanner_service.rescan.passes.needs import UNSEEN, failing_points
from scanner_service.rescan.passes.recommendation import RecommendedPass
from scanner_service.rescan.regions import RegionReport

_RECENT = 3
_TRUST = (0.5, 1.6)
_LEAST_MM2 = 20.0  # smaller promises say little
_SAME = 0.75  # cells: surface this near to surface that was good before is not new
_BESIDE = 4.0  # cells: new good surface this far from every place served belongs to no region


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
class Outcome:
    """What became of a pass: region by region, and `missed_mm` (k, 3), the places it was to serve and did not."""

    regions: tuple[RegionOutcome, ...]
    missed_mm: Float64Array

    def __post_init__(self) -> None:
        read_only(self.missed_mm)

    @property
    def promised_mm2(self) -> float:
        """All that was promised."""
        return sum(one.promised_mm2 for one in self.regions)

    @property
    def reached_mm2(self) -> float:
        """All that meets the requirement now and did not before."""
        return sum(one.reached_mm2 for one in self.regions)

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "promised_mm2": self.promised_mm2,
            "reached_mm2": self.reached_mm2,
            "regions": [one.to_dict() for one in self.regions],
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
        return cls(regions, np.array(kept.get("missed_mm", ()), dtype=np.float64).reshape(-1, 3))


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
    the pass and lies near no cell that was good before is reached; it is given to the region of the
    nearest place that was to be served.
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
    owner = np.full(len(new_good), UNSEEN, dtype=np.int64)
    missed = np.ones(len(done.places_mm), dtype=np.bool_)
    if len(done.places_mm) and len(new_good):
        away, which = cKDTree(done.places_mm).query(new_good)
        owner = np.where(away <= _BESIDE * cell, done.place_regions[np.minimum(which, len(missed) - 1)], UNSEEN)
        tree = cKDTree(_facing(new_good, new_normals, 0.8 * cell))
        near, _ = tree.query(_facing(done.places_mm, done.place_normals, 0.8 * cell), distance_upper_bound=1.2 * cell)
        missed = ~np.isfinite(near)
    regions = []
    for region in np.unique(np.concatenate([done.place_regions, owner[fresh]])):
        promised = float(done.place_mm2[done.place_regions == region].sum())
        regions.append(RegionOutcome(int(region), promised, float(new_mm2[fresh & (owner == region)].sum())))
    regions.sort(key=lambda one: -one.promised_mm2)
    return Outcome(tuple(regions), done.places_mm[missed])


def trust_of(earlier: Sequence[tuple[float, float, float]]) -> float:
    """How much of what passes promise is reached: by how much the next promises are multiplied.

    Parameters
    ----------
    earlier : the area promised and reached by each earlier pass, and the trust that was in its promise.

    Notes
    -----
    The median of the last few, so that one pass in vain does not spoil it, within bounds.
    """
    ratios = [reached * trust / promised for promised, reached, trust in earlier if promised > _LEAST_MM2]
    if not ratios:
        return 1.0
    return float(np.clip(np.median(ratios[-_RECENT:]), *_TRUST))


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
