"""From a judged map to recommended passes: what is wanted, what the rig can see of it, and in which order; pure."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array, Pose, read_only
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.cover import Choice, Cover
from scanner_service.rescan.passes.known_surface import know_surface
from scanner_service.rescan.passes.looks import Look
from scanner_service.rescan.passes.needs import Evidence, Needs, failing_points, find_needs
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.reach import Reach
from scanner_service.rescan.passes.recommendation import Plan, Promise, RecommendedPass, Unreachable
from scanner_service.rescan.passes.visibility import OpenSky, look_around
from scanner_service.rescan.regions import RegionReport

MAX_NEEDS = 4_000
"""More places than this are thinned at random, each that is left standing for more area."""
TRIES = 3
"""So often a place is promised before it is given up."""


@dataclass(frozen=True, slots=True)
class Tried:
    """Places (n, 3) that passes were to serve and did not: each try makes the next promise smaller."""

    places_mm: Float64Array

    def __post_init__(self) -> None:
        read_only(self.places_mm)

    @classmethod
    def nothing(cls) -> "Tried":
        """Before the first pass."""
        return cls(np.zeros((0, 3)))

    def and_also(self, places_mm: Float64Array) -> "Tried":
        """With the places of one more pass."""
        return Tried(np.concatenate([self.places_mm, places_mm]))

    def times(self, places_mm: Float64Array, within_mm: float) -> Float64Array:
        """(n,) how often each place was tried."""
        if not len(self.places_mm) or not len(places_mm):
            return np.zeros(len(places_mm))
        found = cKDTree(self.places_mm).query_ball_point(places_mm, within_mm, return_length=True)
        return np.asarray(found, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Wishes:
    """What is asked of a plan: the density wanted, how many passes, and the least gain of one.

    `explore` reckons with surface where hidden space begins, outside of any region. `chances` are how likely each kind
    of evidence has proved, `trust` is how much of what earlier passes promised was reached (`outcome.trust_of`).
    """

    density_per_mm2: float
    max_passes: int = 6
    least_gain_mm2: float = 2.0
    explore: bool = True
    chances: tuple[float, float, float, float] = (1.0, 1.0, 0.9, 1.0)
    cell_mm: float | None = None
    trust: float = 1.0


def plan_passes(
    snapshot: MapSnapshot,
    report: RegionReport,
    reach: Reach,
    optics: ScannerOptics,
    wishes: Wishes,
    standing: Pose | None = None,
    tried: Tried | None = None,
    looks: tuple[Look, ...] = (),
) -> Plan:
    """Recommend passes.

    Parameters
    ----------
    snapshot, report : the map and what is wrong with it.
    reach, optics : what the rig can do and the scanner can see.
    standing : part_from_sensor now; None leaves the way to the first pass out of its time.
    tried : what earlier passes promised in vain.
    looks : earlier passes whose poses are known.
    """
    fails, region = failing_points(report)
    surface = know_surface(snapshot, fails, region, wishes.cell_mm, looks, optics)
    chances = {kind: wishes.trust * chance for kind, chance in zip(Evidence, wishes.chances, strict=True)}
    needs = find_needs(snapshot, report, surface, wishes.density_per_mm2, chances, wishes.explore)
    needs, given_up = _without_vain(needs, tried or Tried.nothing(), surface.cell_mm)
    needs = _thinned(needs)
    sky = look_around(surface, needs.places_mm, needs.normals, optics.max_camera_rad)
    cover = Cover(surface, needs, sky, reach, optics)
    passes: list[RecommendedPass] = []
    while len(passes) < wishes.max_passes:
        choice = cover.next(standing)
        if choice is None or choice.stretch.gain_mm2 < wishes.least_gain_mm2:
            break
        one = _recommend(len(passes) + 1, choice, needs, reach, standing, wishes.trust)
        passes.append(one)
        standing = one.end_pose
    unreachable = _unreachable(needs, cover, sky, optics, reach) + _vain(given_up, needs)
    needed = float(needs.gain_mm2.sum() + given_up.gain_mm2.sum())
    return Plan(report.version, tuple(passes), unreachable, needed)


def _without_vain(needs: Needs, tried: Tried, cell_mm: float) -> tuple[Needs, Needs]:
    """The needs with smaller chances where passes were in vain, and those that are given up."""
    times = tried.times(needs.places_mm, 0.8 * cell_mm)
    given_up = times >= TRIES
    fields = {name: getattr(needs, name) for name in Needs.__slots__}
    fields["chance"] = needs.chance * 0.4**times
    lowered = Needs(**fields)
    return lowered.only(~given_up), needs.only(given_up)


def _thinned(needs: Needs) -> Needs:
    if len(needs) <= MAX_NEEDS:
        return needs
    rng = np.random.default_rng(len(needs))  # the same needs give the same plan
    keep = np.zeros(len(needs), dtype=np.bool_)
    keep[rng.permutation(len(needs))[:MAX_NEEDS]] = True
    fewer = needs.only(keep)
    fields = {name: getattr(fewer, name) for name in Needs.__slots__}
    fields["area_mm2"] = fewer.area_mm2 * (float(needs.area_mm2.sum()) / float(fewer.area_mm2.sum()))
    return Needs(**fields)


def _recommend(
    number: int, choice: Choice, needs: Needs, reach: Reach, standing: Pose | None, trust: float
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
        place_normals=needs.normals[served],
        turn=choice.attitude.turn,
        trust=trust,
    )


def _unreachable(
    needs: Needs, cover: Cover, sky: OpenSky, optics: ScannerOptics, reach: Reach
) -> tuple[Unreachable, ...]:
    """The needs that no attitude sees, by region and reason."""
    missing = ~cover.reachable
    if not missing.any():
        return ()
    why = np.full(len(needs), "no pass within the rig's limits reaches it with laser and camera", dtype=object)
    axes = [attitude.rotation for attitude in cover.attitudes]
    faced, lit = np.zeros(len(needs), dtype=np.bool_), np.zeros(len(needs), dtype=np.bool_)
    laser = optics.geometry.laser_mm / np.linalg.norm(optics.geometry.laser_mm)
    for rotation in axes:
        direction = rotation @ laser
        facing = needs.normals @ direction >= math.cos(optics.max_incidence_rad)
        faced |= facing
        lit |= facing & sky.along(direction)
    degrees = math.degrees(optics.max_incidence_rad)
    why[~faced] = f"the rig cannot face it within {degrees:.0f}° of its normal"
    why[faced & ~lit] = "the part itself hides it from the laser wherever the rig can stand"
    seen_by_laser = faced & lit
    why[seen_by_laser] = "where the laser reaches it, the part hides it from the camera or the rig ends"
    return _by_region(needs, missing, why)


def _vain(given_up: Needs, needs: Needs) -> tuple[Unreachable, ...]:
    why = np.full(len(given_up), f"{TRIES} passes that should have seen it brought no returns", dtype=object)
    return _by_region(given_up, np.ones(len(given_up), dtype=np.bool_), why)


def _by_region(
    needs: Needs, which: BoolArray, why: np.ndarray[tuple[int], np.dtype[np.object_]]
) -> tuple[Unreachable, ...]:
    found = []
    for region in np.unique(needs.region[which]):
        of_region = needs.region == region
        whole = float(needs.area_mm2[of_region].sum())
        for reason in sorted(set(why[which & of_region])):
            area = float(needs.area_mm2[which & of_region & (why == reason)].sum())
            found.append(Unreachable(int(region), area, area / whole, str(reason)))
    found.sort(key=lambda one: -one.area_mm2)
    return tuple(found)
