"""Hidden space belongs to the shadow that hides it, so that a shadow that is named is served by what lies behind it."""

import numpy as np

from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.hidden_by import hidden_by
from scanner_service.rescan.passes.known_surface import know_surface
from scanner_service.rescan.passes.needs import HIDDEN_KINDS, Wanted, failing_points, find_needs
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from scanner_service.rescan.passes.serving import Serving
from simulators.shapes import Difference, box
from tests.unit.rescan.passes.posed_scans import DENSITY, FROM_ABOVE, OPTICS, Bench, free_reach

POCKETS = Difference(
    box((-16.0, -2.0, -12.0), (16.0, 26.0, 0.0)),
    box((-12.0, 7.0, -5.0), (-3.0, 17.0, 1.0)),
    box((3.0, 7.0, -5.0), (12.0, 17.0, 1.0)),
)


def in_pocket(places_mm: np.ndarray, side: int, wider_mm: float = 0.0) -> np.ndarray:
    """(n,) whether places lie in the pocket on one side, below its rim, or so far beyond its walls and floor."""
    x, y, z = side * places_mm[:, 0], places_mm[:, 1], places_mm[:, 2]
    inside = (x > 3.0 - wider_mm) & (x < 12.0 + wider_mm) & (y > 7.0 - wider_mm) & (y < 17.0 + wider_mm)
    return inside & (z < -0.5 + wider_mm)


def shadows(report, side: int) -> list:
    """The shadows listed in one pocket."""
    return [one for one in report.regions if one.reason is Reason.SHADOW and side * one.centroid_mm[0] > 0]


def test_what_a_shadow_hides_is_its_own_and_nobody_elses() -> None:
    snapshot, report = Bench(POCKETS).scan(FROM_ABOVE, 0.0, 24.0, 0.35).judged()
    surface = know_surface(snapshot, *failing_points(report))
    number = hidden_by(report.regions, surface.frontier_mm, surface.cell_mm)
    for side in (-1, 1):
        mine = {one.number for one in shadows(report, side)}
        assert mine
        of_mine = np.isin(number, list(mine))
        assert of_mine.sum() > 20
        assert (side * surface.frontier_mm[of_mine, 0] > 0).all()
    assert (hidden_by(report.regions, surface.frontier_mm + 50.0, surface.cell_mm) == 0).all()
    assert (hidden_by((), surface.frontier_mm, surface.cell_mm) == 0).all()
    needs = find_needs(snapshot, report, surface, Wanted(DENSITY))
    hidden = np.isin(needs.evidence, HIDDEN_KINDS)
    assert (needs.region[hidden] > 0).any() and (needs.region[hidden] == 0).any()


def test_a_pass_for_the_shadows_of_one_pocket_looks_into_that_pocket() -> None:
    bench, reach = Bench(POCKETS), free_reach()
    snapshot, report = bench.scan(FROM_ABOVE, 0.0, 24.0, 0.35).judged()
    before = snapshot.points_mm[snapshot.neighbours > 0]
    named = frozenset(one.number for one in shadows(report, 1))
    plan = plan_passes(snapshot, report, reach, OPTICS, Wishes(DENSITY, max_passes=1, serving=Serving(named)))
    (one,) = plan.passes
    assert {promise.region for promise in one.promises} <= named
    assert in_pocket(one.places_mm, 1, wider_mm=1.0).mean() > 0.9
    bench.scan(one.motion, one.start_mm, one.end_mm, one.line_spacing_mm)
    after = bench.judged()[0].points_mm
    left, right = (int(in_pocket(after, side).sum() - in_pocket(before, side).sum()) for side in (-1, 1))
    assert right > 4 * left and right > 1000
