"""From a judged map to recommended passes: what is wanted, what the rig can see of it, and in which order; pure."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from drivers.scanline import BoolArray, Pose
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.behind import weighed, weighed_like
from scanner_service.rescan.passes.cover import Choice, Cover
from scanner_service.rescan.passes.gain import MARGIN, SERVED, Prospect, prospect_of
from scanner_service.rescan.passes.known_surface import know_surface
from scanner_service.rescan.passes.looks import Look
from scanner_service.rescan.passes.needs import UNSEEN, Needs, Wanted, failing_points, find_needs
from scanner_service.rescan.passes.nominal import missing_of
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.promises import NO_EXPERIENCE, Experience
from scanner_service.rescan.passes.reach import Reach
from scanner_service.rescan.passes.recommendation import Plan, Promise, RecommendedPass
from scanner_service.rescan.passes.serving import EVERYTHING, Serving
from scanner_service.rescan.passes.stretch import Stretch
from scanner_service.rescan.passes.tried import Tried
from scanner_service.rescan.passes.unreachable import lost_regions, unreachable
from scanner_service.rescan.passes.visibility import APART_RAD, look_around
from scanner_service.rescan.reference import ReferenceCoverage
from scanner_service.rescan.region import RescanRegion
from scanner_service.rescan.regions import RegionReport
from scanner_service.rescan.requirement import Requirement

MAX_NEEDS = 6_000
"""Passes are chosen by so many places; of more these are drawn, each that is left standing for more area. What the
chosen pass serves and promises is then worked out for all of them."""
MAX_SERVED = 12_000
"""... and of what it serves so many places are kept for the reckoning afterwards."""
_EVEN = 0.2  # so much of the mean worth is added to each: what is worth little is told as out of reach all the same


@dataclass(frozen=True, slots=True)
class Wishes:
    """What is asked of a plan: the density wanted, how many passes, and the least gain of one.

    `requirement` asks for more than a density: line spacing, chord error, incidence. `serving` names what is to be
    served; unseen surface only when nothing is named. `explore` reckons with surface where hidden space begins,
    outside of any region. `learned` is how much good surface each kind of evidence has proved to bring
    (`experience.experience_of`). `tops_up`: steep surface asks only for the points that it lacks, from
    somewhat steeper rays too; a plan that finds nothing otherwise does so by itself.
    """

    density_per_mm2: float
    max_passes: int = 6
    least_gain_mm2: float = 1.0
    explore: bool = True
    learned: Experience = NO_EXPERIENCE
    cell_mm: float | None = None
    requirement: Requirement | None = None
    serving: Serving = EVERYTHING
    tops_up: bool = False


def plan_passes(
    snapshot: MapSnapshot,
    report: RegionReport,
    reach: Reach,
    optics: ScannerOptics,
    wishes: Wishes,
    standing: Pose | None = None,
    tried: Tried | None = None,
    looks: tuple[Look, ...] = (),
    regions: Sequence[RescanRegion] | None = None,
    reference: ReferenceCoverage | None = None,
) -> Plan:
    """Recommend passes.

    Parameters
    ----------
    snapshot, report : the map and what is wrong with it.
    reach, optics : what the rig can do and the scanner can see.
    standing : part_from_sensor now; None leaves the way to the first pass out of its time.
    tried : what earlier passes promised in vain.
    looks : earlier passes whose poses are known.
    regions : the regions of the report as they are followed through the session; None: as they are in the report.
    reference : coverage of the nominal part, where there is one: what no point has touched is known then, not guessed.
    """
    regions = report.regions if regions is None else regions
    fails, region = failing_points(report, regions)
    pieces = None if reference is None else reference.pieces
    by_shadow = report.judgement.reason == Reason.SHADOW
    surface = know_surface(snapshot, fails, region, wishes.cell_mm, looks, optics, pieces, by_shadow)
    missing = None if reference is None else missing_of(reference, regions)
    wanted = replace(Wanted.of(wishes.density_per_mm2, wishes.requirement), tops_up=wishes.tops_up)
    needs = find_needs(snapshot, report, surface, wanted, wishes.learned.chances, wishes.explore, regions, missing)
    if not wishes.serving.is_everything:
        named = [one.number for one in regions if wishes.serving.wants(one)]
        needs = needs.only(np.isin(needs.region, named))
    every, given_up = (tried or Tried.nothing()).of(needs, surface.cell_mm)
    drawn = _thinned(every, MAX_NEEDS)
    may_stand = partial(reach.may_light, wider_rad=optics.camera_aside_rad + APART_RAD)
    sky = look_around(surface, drawn.places_mm, drawn.normals, optics.max_camera_rad, may_stand)
    needs = weighed(surface, drawn, sky, reach.may_light(sky.directions))
    every = needs if drawn is every else weighed_like(every, drawn, needs)
    cover = Cover(surface, needs, sky, reach, optics, wishes.least_gain_mm2)
    passes: list[RecommendedPass] = []
    left = np.ones(len(every), dtype=np.bool_)
    while len(passes) < wishes.max_passes:
        choice = cover.next(standing)
        if choice is None:
            break
        prospect = prospect_of(surface, every, choice.motion, optics) if every is not needs else choice.prospect
        served = left & _served_by(choice.stretch, prospect)
        if not served.any():  # by all places there is nothing of what it was chosen for
            continue
        left &= ~served
        one = _recommend(len(passes) + 1, choice, every, prospect, served, reach, standing, wishes)
        passes.append(one)
        standing = one.end_pose
    if not (passes or wishes.tops_up) and (report.reason == Reason.STEEP).any():
        last = replace(wishes, tops_up=True)
        return plan_passes(snapshot, report, reach, optics, last, standing, tried, looks, regions, reference)
    lost = unreachable(needs, cover.reachable, cover.attitudes, sky, optics, given_up, regions)
    needed = float(needs.gain_mm2.sum() + given_up.gain_mm2.sum())
    asked = frozenset(np.unique(needs.region[cover.reachable]).tolist()) - {UNSEEN}
    return Plan(report.version, tuple(passes), lost, needed, asked, lost_regions(lost))


def _served_by(stretch: Stretch, prospect: Prospect) -> BoolArray:
    """(n,) what a pass serves; its margin is for choosing: what gets enough with less of it is a gain as well."""
    return stretch.serves(prospect.position_mm, MARGIN / SERVED * prospect.coarsest_mm)


def _thinned(needs: Needs, most: int) -> Needs:
    """At most so many of them, drawn by what each is worth, and standing together for the gain of all."""
    if len(needs) <= most:
        return needs
    worth = needs.gain_mm2 + _EVEN * float(needs.gain_mm2.mean())
    if not worth.any():  # nothing is to be had anywhere
        worth = np.ones(len(needs))
    share = np.minimum(1.0, worth * (most / float(worth.sum())))
    for _ in range(4):  # what is sure to stay leaves room for more of the rest
        rest = share < 1.0
        if not worth[rest].any():
            break
        room = most - float(np.count_nonzero(~rest))
        share[rest] = np.minimum(1.0, worth[rest] * (room / float(worth[rest].sum())))
    rng = np.random.default_rng(len(needs))  # the same needs give the same plan
    keep = np.diff(np.floor(np.cumsum(share) + rng.random()), prepend=0.0) > 0
    fewer = needs.only(keep)
    fewer = fewer.changed(area_mm2=fewer.area_mm2 / share[keep])
    drawn_mm2 = float(fewer.gain_mm2.sum())
    if drawn_mm2 <= 0.0:
        return fewer
    return fewer.changed(area_mm2=fewer.area_mm2 * (float(needs.gain_mm2.sum()) / drawn_mm2))


def _recommend(
    number: int,
    choice: Choice,
    needs: Needs,
    prospect: Prospect,
    served: BoolArray,
    reach: Reach,
    standing: Pose | None,
    wishes: Wishes,
) -> RecommendedPass:
    stretch = choice.stretch
    spacing = stretch.line_spacing_mm
    promises = []
    for region in np.unique(needs.region[served]):
        mine = served & (needs.region == region)
        incidence = prospect.incidence_rad[mine]
        promises.append(
            Promise(
                int(region),
                float(needs.gain_mm2[mine].sum()),
                float(np.median(prospect.per_line_mm[mine])) / spacing,
                float(np.median(incidence)),
                float(incidence.max()),
            )
        )
    promises.sort(key=lambda promise: -promise.gain_mm2)
    start = choice.motion.part_from_sensor(stretch.start_mm)
    kept = _thinned(needs.only(served), MAX_SERVED)
    return RecommendedPass(
        number=number,
        motion=choice.motion,
        start_mm=stretch.start_mm,
        end_mm=stretch.end_mm,
        line_spacing_mm=spacing,
        line_rate_hz=reach.line_rate_hz(spacing),
        duration_s=reach.seconds(stretch.end_mm - stretch.start_mm, spacing),
        approach_s=reach.seconds_between(standing, start, choice.attitude.turn),
        promises=tuple(promises),
        places_mm=kept.places_mm,
        place_regions=kept.region.astype(np.float64),
        place_mm2=kept.gain_mm2,
        place_area_mm2=kept.area_mm2,
        place_evidence=kept.evidence.astype(np.float64),
        place_normals=kept.normals,
        place_tried=kept.tried,
        turn=choice.attitude.turn,
        learned=wishes.learned,
    )
