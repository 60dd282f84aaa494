"""From a judged map to recommended passes: what is wanted, what the rig can see of it, and in which order; pure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.scanline import Pose
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.behind import weighed
from scanner_service.rescan.passes.cover import Choice, Cover
from scanner_service.rescan.passes.known_surface import know_surface
from scanner_service.rescan.passes.looks import Look
from scanner_service.rescan.passes.needs import (
    FIRST_CHANCES,
    UNSEEN,
    Chances,
    Needs,
    Wanted,
    failing_points,
    find_needs,
)
from scanner_service.rescan.passes.nominal import missing_of
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.reach import Reach
from scanner_service.rescan.passes.recommendation import Plan, Promise, RecommendedPass
from scanner_service.rescan.passes.serving import EVERYTHING, Serving
from scanner_service.rescan.passes.tried import Tried
from scanner_service.rescan.passes.unreachable import in_vain, lost_regions, unreachable
from scanner_service.rescan.passes.visibility import look_around
from scanner_service.rescan.reference import ReferenceCoverage
from scanner_service.rescan.region import RescanRegion
from scanner_service.rescan.regions import RegionReport
from scanner_service.rescan.requirement import Requirement

MAX_NEEDS = 6_000
"""More places than this are thinned at random, each that is left standing for more area."""
_EVEN = 0.2  # so much of the mean worth is added to each: what is worth little is told as out of reach all the same


@dataclass(frozen=True, slots=True)
class Wishes:
    """What is asked of a plan: the density wanted, how many passes, and the least gain of one.

    `requirement` asks for more than a density: line spacing, chord error, incidence. `serving` names what is to be
    served; unseen surface only when nothing is named. `explore` reckons with surface where hidden space begins,
    outside of any region. `chances` are how much good surface each kind of evidence has proved to bring
    (`experience.chances_of`).
    """

    density_per_mm2: float
    max_passes: int = 6
    least_gain_mm2: float = 1.0
    explore: bool = True
    chances: Chances = FIRST_CHANCES
    cell_mm: float | None = None
    requirement: Requirement | None = None
    serving: Serving = EVERYTHING


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
    surface = know_surface(snapshot, fails, region, wishes.cell_mm, looks, optics, pieces)
    missing = None if reference is None else missing_of(reference, regions)
    wanted = Wanted.of(wishes.density_per_mm2, wishes.requirement)
    explore = wishes.explore and wishes.serving.is_everything
    needs = find_needs(snapshot, report, surface, wanted, wishes.chances, explore, regions, missing)
    if not wishes.serving.is_everything:
        named = [one.number for one in regions if wishes.serving.wants(one)]
        needs = needs.only(np.isin(needs.region, named))
    needs, given_up = (tried or Tried.nothing()).of(needs, surface.cell_mm)
    needs = _thinned(needs)
    sky = look_around(surface, needs.places_mm, needs.normals, optics.max_camera_rad)
    needs = weighed(surface, needs, sky, reach.may_light(sky.directions))
    cover = Cover(surface, needs, sky, reach, optics, wishes.least_gain_mm2)
    passes: list[RecommendedPass] = []
    while len(passes) < wishes.max_passes:
        choice = cover.next(standing)
        if choice is None:
            break
        one = _recommend(len(passes) + 1, choice, needs, reach, standing, wishes)
        passes.append(one)
        standing = one.end_pose
    lost = unreachable(needs, cover.reachable, cover.attitudes, sky, optics) + in_vain(given_up, needs)
    needed = float(needs.gain_mm2.sum() + given_up.gain_mm2.sum())
    asked = frozenset(np.unique(needs.region[cover.reachable]).tolist()) - {UNSEEN}
    return Plan(report.version, tuple(passes), lost, needed, asked, lost_regions(lost))


def _thinned(needs: Needs) -> Needs:
    """MAX_NEEDS of them, drawn by what each is worth, so that a draw stands for the same gain as all."""
    if len(needs) <= MAX_NEEDS:
        return needs
    worth = needs.gain_mm2 + _EVEN * float(needs.gain_mm2.mean())
    share = np.minimum(1.0, worth * (MAX_NEEDS / float(worth.sum())))
    for _ in range(4):  # what is sure to stay leaves room for more of the rest
        rest = share < 1.0
        room = MAX_NEEDS - float(np.count_nonzero(~rest))
        share[rest] = np.minimum(1.0, worth[rest] * (room / float(worth[rest].sum())))
    rng = np.random.default_rng(len(needs))  # the same needs give the same plan
    keep = np.diff(np.floor(np.cumsum(share) + rng.random()), prepend=0.0) > 0
    fewer = needs.only(keep)
    return fewer.changed(area_mm2=fewer.area_mm2 / share[keep])


def _recommend(
    number: int, choice: Choice, needs: Needs, reach: Reach, standing: Pose | None, wishes: Wishes
) -> RecommendedPass:
    stretch, prospect, served = choice.stretch, choice.prospect, choice.served
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
        places_mm=needs.places_mm[served],
        place_regions=needs.region[served].astype(np.float64),
        place_mm2=needs.gain_mm2[served],
        place_area_mm2=needs.area_mm2[served],
        place_evidence=needs.evidence[served].astype(np.float64),
        place_normals=needs.normals[served],
        turn=choice.attitude.turn,
        chances=wishes.chances,
    )
