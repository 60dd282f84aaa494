"""What a pass promised against what it brought, region by region; plans nothing."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.agreement import Agreement, agreement_of
from scanner_service.rescan.passes.known_surface import IntArray, KnownSurface, know_surface
from scanner_service.rescan.passes.motion import Motion
from scanner_service.rescan.passes.needs import HIDDEN_KINDS, UNSEEN, Evidence, failing_points
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.recommendation import RecommendedPass
from scanner_service.rescan.regions import RegionReport

_SAME = 0.75  # cells: surface this near to surface that was good before is not new
_BESIDE_MM = 2.0  # new good surface this near to a place of hidden space is what was promised there
_BEHIND_MM = 1.0  # ... and so is what lies behind a place of hidden space, on rays this near to the place's own
_THERE = 1.5  # cells: a place is good when new good surface that faces alike is this near
_NOBODY = -1
_NEVER_MM = 1e30


Interval = tuple[float, float]


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

    `asked_mm2` is the area that was asked for, edges of hidden space counted for less, before the chances of the kind
    came in; `reached_mm2` the good surface that was found for it.
    """

    evidence: Evidence
    asked_mm2: float
    reached_mm2: float

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {"evidence": self.evidence.name.lower(), "asked_mm2": self.asked_mm2, "reached_mm2": self.reached_mm2}


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a pass: region by region, and by the kind of evidence.

    `besides_mm2` is good surface that was found where nothing was promised. `missed_mm` (k, 3) are the places that the
    pass was to serve and did not, `empty_mm` (e, 3) those of them where hidden space was expected to begin with surface
    and none was found near. `agreement` says how well its points lie on what was known; None: not looked at.
    `doubt` is what the operator is told when they do not. `expected_mm2` is what was
    explored and not promised, and `found_mm2` what of that was found. `promised_between_mm2` and
    `expected_between_mm2` are the intervals in which they were to lie; None: of a time when none were told.
    """

    regions: tuple[RegionOutcome, ...]
    missed_mm: Float64Array
    kinds: tuple[KindOutcome, ...] = ()
    besides_mm2: float = 0.0
    agreement: Agreement | None = None
    doubt: str | None = None
    expected_mm2: float = 0.0
    found_mm2: float = 0.0
    empty_mm: Float64Array = field(default_factory=lambda: np.zeros((0, 3)))
    promised_between_mm2: Interval | None = None
    expected_between_mm2: Interval | None = None

    def __post_init__(self) -> None:
        read_only(self.missed_mm)
        read_only(self.empty_mm)

    @property
    def promised_mm2(self) -> float:
        """All that was promised."""
        return sum(one.promised_mm2 for one in self.regions)

    @property
    def reached_mm2(self) -> float:
        """All that meets the requirement now, did not before, and belongs to a place that was promised."""
        return sum(one.reached_mm2 for one in self.regions)

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "promised_mm2": self.promised_mm2,
            "promised_between_mm2": _listed(self.promised_between_mm2),
            "reached_mm2": self.reached_mm2,
            "expected_mm2": self.expected_mm2,
            "expected_between_mm2": _listed(self.expected_between_mm2),
            "found_mm2": self.found_mm2,
            "besides_mm2": self.besides_mm2,
            "agreement": self.agreement.to_dict() if self.agreement else None,
            "doubt": self.doubt,
            "regions": [one.to_dict() for one in self.regions],
            "kinds": [one.to_dict() for one in self.kinds],
        }

    @classmethod
    def from_dict(cls, kept: Mapping[str, Any]) -> "Outcome":
        """As `to_dict` told it, with the places of `missed_mm` and `empty_mm` where they are there too.

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
            KindOutcome(Evidence[str(one["evidence"]).upper()], float(one["asked_mm2"]), float(one["reached_mm2"]))
            for one in kept.get("kinds", ())
            if "reached_mm2" in one  # in older records stands something else, from which nothing is to be learned
        )
        missed, empty = (
            np.array(kept.get(name, ()), dtype=np.float64).reshape(-1, 3) for name in ("missed_mm", "empty_mm")
        )
        doubt = kept.get("doubt")
        return cls(
            regions,
            missed,
            kinds,
            besides_mm2=float(kept.get("besides_mm2", 0.0)),
            agreement=Agreement.from_dict(kept["agreement"]) if kept.get("agreement") else None,
            doubt=None if doubt is None else str(doubt),
            expected_mm2=float(kept.get("expected_mm2", 0.0)),
            found_mm2=float(kept.get("found_mm2", 0.0)),
            empty_mm=empty,
            promised_between_mm2=_interval(kept.get("promised_between_mm2")),
            expected_between_mm2=_interval(kept.get("expected_between_mm2")),
        )


def _listed(interval: Interval | None) -> list[float] | None:
    return None if interval is None else list(interval)


def _interval(kept: Any) -> Interval | None:
    if kept is None:
        return None
    low, high = kept
    return float(low), float(high)


def reckon(
    done: RecommendedPass,
    before: MapSnapshot,
    before_report: RegionReport,
    after: MapSnapshot,
    after_report: RegionReport,
    optics: ScannerOptics,
    cell_mm: float | None = None,
) -> Outcome:
    """Compare the map before and after a pass.

    Good surface is a cell less than half of whose points fail, each side of a thin wall for itself. What is good after
    the pass and lies near no cell that was good before is reached where it belongs to a place that was to be served
    (`owners_of`), and is given to that place's region and kind of evidence; elsewhere it was found besides. A place
    that was measured before is reached when its own cell is good.
    """
    old = know_surface(before, *failing_points(before_report), cell_mm)
    new = know_surface(after, *failing_points(after_report), cell_mm)
    old_good, old_normals, _ = _good(old)
    places, normals, area_mm2 = _good(new)
    cell = new.cell_mm
    if len(old_good) and len(places):
        tree = cKDTree(_facing(old_good, old_normals, 0.5 * cell))
        near, _ = tree.query(_facing(places, normals, 0.5 * cell), distance_upper_bound=_SAME * cell)
        fresh = ~np.isfinite(near)  # what was good before was not asked for
        places, normals, area_mm2 = places[fresh], normals[fresh], area_mm2[fresh]
    missed = np.ones(len(done.places_mm), dtype=np.bool_)
    if len(missed) and len(places):
        tree = cKDTree(_facing(places, normals, 0.8 * cell))
        asked = _facing(done.places_mm, done.place_normals, 0.8 * cell)
        missed = ~np.isfinite(tree.query(asked, distance_upper_bound=_THERE * cell)[0])
    owner = owners_of(done, places, optics, _THERE * cell)
    is_owned = owner != _NOBODY
    reached = np.asarray(np.bincount(owner[is_owned], area_mm2[is_owned], len(missed)), dtype=np.float64)
    measured = done.place_evidence == Evidence.MEASURED
    good = _good_now(old, after, after_report, done.places_mm[measured])
    reached[measured] = np.where(good, done.place_area_mm2[measured], 0.0)
    missed[measured] &= ~good
    away, _ = _nearest(done.places_mm[reached > 0], done.places_mm, _BESIDE_MM)
    empty = missed & ~np.isfinite(away) & np.isin(done.place_evidence, HIDDEN_KINDS)
    told, promised, said, explores = done.told_mm2, done.is_promised, done.promised, done.explores
    regions = [
        RegionOutcome(int(region), float(told[mine].sum()), float(reached[mine].sum()))
        for region in np.unique(done.place_regions)
        if (mine := promised & (done.place_regions == region)).any()
    ]
    regions.sort(key=lambda one: -one.promised_mm2)
    agreement = agreement_of(old, after, np.setdiff1d(after.lines.pass_number, before.lines.pass_number))
    return Outcome(
        tuple(regions),
        done.places_mm[missed],
        _kinds(done, reached),
        besides_mm2=float(area_mm2[~is_owned].sum()),
        agreement=agreement,
        doubt=agreement.doubt(done.turn),
        expected_mm2=explores.mm2,
        found_mm2=float(reached[~promised].sum()),
        empty_mm=done.places_mm[empty],
        promised_between_mm2=(said.low_mm2, said.high_mm2),
        expected_between_mm2=(explores.low_mm2, explores.high_mm2),
    )


def _good_now(old: KnownSurface, after: MapSnapshot, after_report: RegionReport, places_mm: Float64Array) -> BoolArray:
    """(n,) whether less than half of the points in the cell of each place, as it was before, fail after the pass."""
    keys, cell_of = np.unique(old.keys(places_mm), return_inverse=True)
    if not len(keys):
        return np.zeros(len(places_mm), dtype=np.bool_)
    use = np.flatnonzero(after.neighbours > 0)
    near = (after.points_mm[use] >= places_mm.min(axis=0) - old.cell_mm).all(axis=1)
    near &= (after.points_mm[use] <= places_mm.max(axis=0) + old.cell_mm).all(axis=1)
    use = use[near]
    at = np.searchsorted(keys, old.keys(after.points_mm[use]))
    at = np.minimum(at, len(keys) - 1)
    mine = keys[at] == old.keys(after.points_mm[use])
    fails = after_report.judgement.fails[use[mine]]
    points, failing = np.bincount(at[mine], minlength=len(keys)), np.bincount(at[mine], fails, len(keys))
    good: BoolArray = (points > 0) & (failing < 0.5 * points)
    return good[cell_of]


def owners_of(done: RecommendedPass, places_mm: Float64Array, optics: ScannerOptics, within_mm: float) -> IntArray:
    """(n,) the row of the served place that each new place (n, 3) belongs to; -1: of none.

    It is the nearest one `within_mm`. Else, of the border of hidden space, the one that its own ray of the pass went
    through before, or the nearest one within 2 mm: nobody knows how far behind the border the surface lies.
    """
    owner = np.full(len(places_mm), _NOBODY, dtype=np.int64)
    if not (len(places_mm) and len(done.places_mm)):
        return owner
    near, which = _nearest(done.places_mm, places_mm, within_mm)
    owner[np.isfinite(near)] = which[np.isfinite(near)]
    hidden = np.flatnonzero(np.isin(done.place_evidence, HIDDEN_KINDS))
    left = np.flatnonzero(owner == _NOBODY)
    if not (len(hidden) and len(left)):
        return owner
    border, border_z = _rays(done.motion, done.places_mm[hidden], optics)
    found, found_z = _rays(done.motion, places_mm[left], optics)
    aside, ray = _nearest(border, found, _BEHIND_MM)
    behind = np.isfinite(aside)
    behind[behind] = found_z[behind] < border_z[ray[behind]]
    owner[left[behind]] = hidden[ray[behind]]
    left = left[~behind]
    near, which = _nearest(done.places_mm[hidden], places_mm[left], _BESIDE_MM)
    owner[left[np.isfinite(near)]] = hidden[which[np.isfinite(near)]]
    return owner


def _nearest(of_mm: Float64Array, places_mm: Float64Array, within_mm: float) -> tuple[Float64Array, IntArray]:
    """Distance (n,), inf beyond `within_mm`, and row (n,) of the nearest of some places for each of others."""
    away, which = cKDTree(of_mm).query(places_mm, distance_upper_bound=within_mm)
    return np.asarray(away, dtype=np.float64), np.asarray(which, dtype=np.int64)


def _rays(motion: Motion, places_mm: Float64Array, optics: ScannerOptics) -> tuple[Float64Array, Float64Array]:
    """The ray (n, 2) on which a pass meets each place, by its position and where it passes z = 0; the depth (n,)."""
    sights = motion.sights(places_mm, optics)
    across = 0.5 * optics.field_of_view_mm * optics.across(sights.local_mm)
    rays = np.nan_to_num(np.column_stack([sights.position_mm, across]), nan=_NEVER_MM)
    return rays, sights.local_mm[:, 2]


def _kinds(done: RecommendedPass, reached_mm2: Float64Array) -> tuple[KindOutcome, ...]:
    """By kind of evidence, what was asked for before the chances of that kind came in, and what was reached."""
    found = []
    for kind in Evidence:
        mine = done.place_evidence == kind
        if mine.any():
            asked = float(done.place_mm2[mine].sum()) / done.learned.chances[kind]
            found.append(KindOutcome(kind, asked, float(reached_mm2[mine].sum())))
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
