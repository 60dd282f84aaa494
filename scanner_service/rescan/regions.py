"""Rescan regions: connected patches of surface worth another pass, each with its reason; knows no poses."""

from dataclasses import dataclass, replace

import numpy as np

from drivers.scanline import BoolArray, Float64Array, SensorGeometry, read_only
from scanner_service.analysis.snapshot import MapSnapshot, UInt8Array
from scanner_service.rescan.gaps import GapKind, Gaps, gap_lengths_mm
from scanner_service.rescan.judgement import REMEDIES, Judgement, Reason
from scanner_service.rescan.kept import Kept
from scanner_service.rescan.patches import UPRIGHT, Unfolded, patches
from scanner_service.rescan.points import PointVerdicts
from scanner_service.rescan.region import RescanRegion, mean_normal, priority_of, succession
from scanner_service.rescan.requirement import Requirement
from scanner_service.rescan.ribbons import Ribbon, shadow_ribbons
from scanner_service.rescan.stations import IntArray
from scanner_service.rescan.strips import Spacings, Strips

_SHARED = 1.0 / 3.0  # share of a ribbon's upper or lower ends that makes it part of a flank
_FOOT = 4.0  # radii: how long the foot of a flank may be that has no gaps of its own

__all__ = ["RegionFinder", "RegionReport", "RescanRegion", "SmallPatches", "find_regions"]


@dataclass(frozen=True, slots=True)
class SmallPatches:
    """Patches of one reason too small to be listed: how many, their points, their area."""

    count: int
    point_count: int
    area_mm2: float


@dataclass(frozen=True, slots=True)
class RegionReport:
    """The regions of a map, by falling priority, and the verdict on every point (arrays of n rows).

    `rescan` marks the points of regions; `reason` is the point's own verdict, which may be other than NONE outside of
    any region (a patch smaller than the requirement asks). `counts` are points by verdict: `ok`, each reason,
    `unsettled`, `not_counted`, `requirement_unknown`, and `outside_interest` where there is a region of interest; they
    add up to n. `small_patches` are, by reason, the patches that are too small to be regions; the area of those with
    fewer points than a region is taken from the nominal spacings. `judgement`, `spacings` and `gaps` are what the
    report was made from.
    """

    version: int
    regions: tuple[RescanRegion, ...]
    rescan: BoolArray
    reason: UInt8Array
    counts: dict[str, int]
    small_patches: dict[str, SmallPatches]
    judgement: Judgement
    spacings: Spacings
    gaps: Gaps

    @property
    def gap_mm2(self) -> float:
        """Area of all shadows, those of the small patches included."""
        small = self.small_patches.get(Reason.SHADOW.label)
        listed = sum(region.area_mm2 for region in self.regions if region.reason is Reason.SHADOW)
        return listed + (small.area_mm2 if small else 0.0)

    def to_dict(self) -> dict[str, object]:
        """For JSON: the regions, the counts and what was too small to be a region."""
        return {
            "version": self.version,
            "counts": dict(self.counts),
            "small_patches": {
                reason: {"count": small.count, "point_count": small.point_count, "area_mm2": small.area_mm2}
                for reason, small in self.small_patches.items()
            },
            "regions": [region.to_dict() for region in self.regions],
        }


class RegionFinder:
    """Finds regions of one map again and again while it grows; arguments as `find_regions` has them.

    What it finds is what `find_regions` would find: what is said of points is renewed where the map has changed, and a
    patch is outlined again only when it is another.
    """

    def __init__(
        self,
        requirement: Requirement | None = None,
        geometry: SensorGeometry | None = None,
        noise_mm: float | None = None,
        towards_sensor: Float64Array | None = None,
    ) -> None:
        if noise_mm is None and geometry is not None and geometry.noise_mm > 0:
            noise_mm = geometry.noise_mm
        self._requirement = requirement or Requirement()
        self._noise_mm = noise_mm
        self._points = PointVerdicts(self._requirement, geometry, noise_mm, towards_sensor)
        self._kept: Kept[RescanRegion] = Kept()
        self.renewed: IntArray = np.zeros(0, dtype=np.int64)  # rows that were measured and judged again at last

    def find(self, snapshot: MapSnapshot, changed: IntArray | None = None) -> RegionReport:
        """Find what is worth another pass.

        Parameters
        ----------
        snapshot : the live map; only its settled points are judged.
        changed : (k,) rows of it that are new or other than when regions were found last; None: any may be.
        """
        points = self._points.renew(snapshot, changed)
        self.renewed = points.rows
        self._kept.new_round()
        requirement, strips = self._requirement, points.strips
        ribbons = shadow_ribbons(snapshot, requirement, strips, points.gaps)
        ribbons, gaps, judgement = _flanks_completed(snapshot, ribbons, strips, points.gaps, points.judgement)
        drafts = _shadow_regions(ribbons, gaps, judgement)
        small: list[tuple[Reason, int, float]] = []
        unfolded = Unfolded(snapshot.line, points.stations, points.frames, points.fan, strips.line_spacing_mm)
        for reason in Reason:
            if reason not in (Reason.NONE, Reason.SHADOW):
                large, few = patches(
                    snapshot, requirement, strips, gaps, judgement, unfolded, self._kept, reason, self._noise_mm
                )
                drafts += large
                small += [(reason, len(rows), _nominal_area(strips, rows)) for rows in few]
        listed = []
        least = requirement.least_area_mm2(float(np.median(strips.reach_mm)) if len(snapshot) else 0.0)
        for draft in drafts:
            if draft.point_count >= requirement.region_points and draft.area_mm2 >= least:
                listed.append(draft)
            else:
                small.append((draft.reason, draft.point_count, draft.area_mm2))
        listed.sort(key=lambda draft: (-draft.priority, *draft.centroid_mm.tolist()))
        regions = tuple(replace(draft, number=number) for number, draft in enumerate(listed, start=1))
        rescan = np.zeros(len(snapshot), dtype=bool)
        for region in regions:
            rescan[region.point_rows] = True
        read_only(rescan)
        return RegionReport(
            version=snapshot.version,
            regions=regions,
            rescan=rescan,
            reason=judgement.reason,
            counts=_counts(snapshot, judgement, requirement),
            small_patches=_by_reason(small),
            judgement=judgement,
            spacings=Spacings(**{name: getattr(strips, name).copy() for name in Spacings.__slots__}),
            gaps=gaps,
        )


def find_regions(
    snapshot: MapSnapshot,
    requirement: Requirement | None = None,
    geometry: SensorGeometry | None = None,
    noise_mm: float | None = None,
    towards_sensor: Float64Array | None = None,
) -> RegionReport:
    """Find what is worth another pass, in a map that is looked at once.

    Parameters
    ----------
    snapshot : the live map; only its settled points are judged.
    requirement : the target; None for the defaults.
    geometry : the scanner's optics; without it nothing is called `out_of_range`.
    noise_mm : the sensor's noise (one standard deviation); None takes the geometry's where it is above 0, and without
        either nothing is called `noisy`.
    towards_sensor : (3,) unit direction of the sensor's z in the part frame; None: taken from the fan's middle ray.
    """
    return RegionFinder(requirement, geometry, noise_mm, towards_sensor).find(snapshot)


def _counts(snapshot: MapSnapshot, judgement: Judgement, requirement: Requirement) -> dict[str, int]:
    """Points by verdict; they add up to the points of the snapshot."""
    judged, counted = judgement.judged, snapshot.neighbours > 0
    counts = {"ok": int((judged & (judgement.reason == Reason.NONE)).sum())}
    for reason in Reason:
        if reason is not Reason.NONE:
            counts[reason.label] = int((judgement.reason == reason).sum())
    counts["unsettled"] = int((counted & ~snapshot.settled).sum())
    counts["not_counted"] = int((~counted).sum())
    left = counted & snapshot.settled & ~judged
    if requirement.interest is not None:
        outside = left & ~requirement.interest.holds(snapshot.points_mm)
        counts["outside_interest"] = int(outside.sum())
        left &= ~outside
    counts["requirement_unknown"] = int(left.sum())
    return counts


def _by_reason(small: list[tuple[Reason, int, float]]) -> dict[str, SmallPatches]:
    """Small patches (reason, points, area) added up by reason, in the order of the reasons."""
    found: dict[str, SmallPatches] = {}
    for reason in Reason:
        mine = [(points, area_mm2) for why, points, area_mm2 in small if why is reason]
        if mine:
            found[reason.label] = SmallPatches(len(mine), sum(m[0] for m in mine), float(sum(m[1] for m in mine)))
    return found


def _nominal_area(strips: Strips, rows: IntArray) -> float:
    """Area that points stand for by the spacings of their scanlines."""
    return float((strips.line_spacing_mm[rows] * strips.nominal_point_spacing_mm[rows]).sum())


def _flanks_completed(
    snapshot: MapSnapshot, ribbons: list[Ribbon], strips: Strips, gaps: Gaps, judgement: Judgement
) -> tuple[list[Ribbon], Gaps, Judgement]:
    """The ribbons that are shadows in their own right, gaps and verdicts with the others given to the flanks beside.

    The foot of a flank is often too upright for returns. A ribbon straight below or above the points of a flank, a
    third of whose upper or lower ends are such points, and not much longer than the flank's own gaps, is a part of that
    flank. Its other ends, where they have a plane of their own, are sound.
    """
    steep = judgement.reason == Reason.STEEP
    flank = gaps.of_kind(GapKind.FLANK)
    steep[gaps.high[flank]] = steep[gaps.low[flank]] = True
    steep &= judgement.judged
    span = np.zeros(len(snapshot))
    for end in (gaps.high, gaps.low):
        np.maximum.at(span, end[flank], gap_lengths_mm(snapshot, gaps, flank))
    kind, reason = gaps.kind.copy(), judgement.reason.copy()
    of_flank = np.where(judgement.grazing | ~snapshot.reliable, Reason.STEEP, Reason.NONE)
    shadows = []
    for ribbon in ribbons:
        high, low = gaps.high[ribbon.gaps], gaps.low[ribbon.gaps]
        reach = float(np.median(strips.reach_mm[high]))
        beside = span[np.concatenate([high, low])]
        longest = max(2.0 * float(np.median(beside[beside > 0])) if (beside > 0).any() else 0.0, _FOOT * reach)
        upright = ribbon.overhang_mm <= UPRIGHT * reach
        upright &= _half_is_within(gap_lengths_mm(snapshot, gaps, ribbon.gaps)) <= longest
        if upright and max(float(steep[high].mean()), float(steep[low].mean())) > _SHARED:
            kind[ribbon.gaps] = GapKind.FLANK
            ends = np.concatenate([high, low])
            ends = ends[reason[ends] == Reason.SHADOW]
            reason[ends] = of_flank[ends]
        else:
            shadows.append(ribbon)
    for ribbon in shadows:  # ends that a shadow shares with a flank
        ends = np.concatenate([gaps.high[ribbon.gaps], gaps.low[ribbon.gaps]])
        ends = ends[judgement.reason[ends] == Reason.SHADOW]
        reason[ends] = Reason.SHADOW
    return shadows, replace(gaps, kind=kind), replace(judgement, reason=reason)


def _half_is_within(lengths_mm: Float64Array) -> float:
    """Length of the gap that holds the middle of all laid end to end: a long gap weighs as much as many short ones."""
    rising = np.sort(lengths_mm)
    total = np.cumsum(rising)
    return float(rising[np.searchsorted(total, 0.5 * total[-1])])


def _shadow_regions(ribbons: list[Ribbon], gaps: Gaps, judgement: Judgement) -> list[RescanRegion]:
    """Surface that no ray reached, as regions without a number, however small."""
    regions = []
    for ribbon in ribbons:
        rows = np.unique(np.concatenate([gaps.high[ribbon.gaps], gaps.low[ribbon.gaps]])).astype(np.int64)
        rows = rows[judgement.judged[rows]]
        if not len(rows):
            continue
        regions.append(
            RescanRegion(
                number=0,
                reason=Reason.SHADOW,
                outline_mm=ribbon.loops,
                area_mm2=ribbon.area_mm2,
                centroid_mm=ribbon.centroid_mm,
                normal=mean_normal(ribbon.normals),
                measured_per_mm2=0.0,
                required_per_mm2=float(np.median(judgement.required_per_mm2[rows])),
                counting_error_per_mm2=0.0,
                priority=priority_of(1.0, ribbon.area_mm2),
                point_count=len(rows),
                remedy=REMEDIES[Reason.SHADOW],
                point_rows=rows,
                confidence=succession(len(ribbon.gaps), len(ribbon.gaps)),
                line_spacing_mm=float(np.median(judgement.allowed_mm[rows])),
            )
        )
    return regions
