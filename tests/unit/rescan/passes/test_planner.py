"""From a judged map to passes: what they mend when they are carried out, and what is said to be out of reach."""

import dataclasses

import numpy as np
import pytest

from drivers.scanline import Pose
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes import planner
from scanner_service.rescan.passes.known_surface import know_surface
from scanner_service.rescan.passes.looks import look_of
from scanner_service.rescan.passes.marching import FREE, HIDDEN
from scanner_service.rescan.passes.needs import Evidence, failing_points
from scanner_service.rescan.passes.outcome import reckon
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from scanner_service.rescan.passes.serving import Serving
from scanner_service.rescan.passes.tried import TRIES, Tried
from simulators.parts import plate, step
from simulators.shapes import Sphere
from tests.unit.rescan.passes.posed_scans import (
    ALONG_SMALL_STEP,
    DENSITY,
    FROM_ABOVE,
    OPTICS,
    SMALL_STEP,
    Bench,
    free_reach,
    linear_reach,
)

WISHES = Wishes(DENSITY, max_passes=3)


@pytest.fixture(scope="module")
def coarse():
    """A step scanned too coarsely from above."""
    return Bench(SMALL_STEP).scan(FROM_ABOVE, *ALONG_SMALL_STEP, 0.7).judged()


@pytest.fixture(scope="module")
def coarse_plan(coarse):
    return plan_passes(*coarse, free_reach(), OPTICS, WISHES)


def carried_out(bench, one):
    before = bench.judged()
    bench.scan(one.motion, one.start_mm, one.end_mm, one.line_spacing_mm)
    return reckon(one, *before, *bench.judged(), OPTICS)


def test_a_plate_scanned_too_coarsely_is_mended_by_one_finer_pass_of_its_own_axis():
    bench = Bench(plate().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.7)
    plan = plan_passes(*bench.judged(), linear_reach(), OPTICS, WISHES)
    first = plan.passes[0]
    assert first.start_mm >= -2.0 and first.end_mm <= 62.0
    assert first.line_spacing_mm < 0.4
    outcome = carried_out(bench, first)
    assert outcome.reached_mm2 == pytest.approx(outcome.promised_mm2, rel=0.15)
    assert outcome.reached_mm2 > 0.9 * 40.0 * 40.0


def test_a_plate_scanned_well_needs_nothing():
    bench = Bench(plate().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.25)
    plan = plan_passes(*bench.judged(), linear_reach(), OPTICS, WISHES)
    assert sum(one.gain_mm2 for one in plan.passes) < 0.02 * 1600.0


def test_the_shadow_of_a_step_is_seen_from_another_side():
    bench = Bench(SMALL_STEP).scan(FROM_ABOVE, *ALONG_SMALL_STEP, 0.25)
    snapshot, report = bench.judged()
    assert any(region.reason.label == "shadow" for region in report.regions)
    shadows = dataclasses.replace(WISHES, serving=Serving(reasons=frozenset({Reason.SHADOW})))
    first = plan_passes(snapshot, report, free_reach(), OPTICS, shadows).passes[0]
    plan = plan_passes(snapshot, report, free_reach(), OPTICS, WISHES)
    towards = first.start_pose.rotation[:, 2]
    assert towards @ np.array([0.0, -1.0, 1.0]) > 0.7  # from before the step, where its wall is seen
    gained = sum(carried_out(bench, one).reached_mm2 for one in plan.passes)
    assert gained > 75.0  # the wall alone has 20 mm x 5 mm


def test_passes_are_told_in_plain_numbers_the_best_for_its_time_first(coarse_plan):
    plan = coarse_plan
    assert len(plan.passes) == 3
    told = plan.to_dict()
    assert [one["number"] for one in told["passes"]] == [1, 2, 3]
    for one in plan.passes:
        assert one.gain_mm2 > 0 and one.duration_s > 0
        assert sum(promise.gain_mm2 for promise in one.promises) == pytest.approx(float(one.place_mm2.sum()))
        assert all(promise.density_per_mm2 >= DENSITY for promise in one.promises)
        assert all(promise.largest_incidence_rad <= OPTICS.max_incidence_rad + 1e-9 for promise in one.promises)
        assert one.line_count == len(np.arange(one.start_mm, one.end_mm + 1e-9, one.line_spacing_mm))


def test_no_place_is_promised_twice_and_none_for_others_by_whichever_places_passes_were_chosen(monkeypatch):
    bench = Bench(step().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.7)
    judged = bench.judged()
    monkeypatch.setattr(planner, "MAX_NEEDS", 150)
    plan = plan_passes(*judged, free_reach(), OPTICS, Wishes(DENSITY, max_passes=5))
    places = np.concatenate([one.places_mm for one in plan.passes])
    assert len(places) > 600 and len(np.unique(places, axis=0)) == len(places)
    cell_mm = know_surface(judged[0], *failing_points(judged[1])).cell_mm
    areas = np.concatenate([one.place_area_mm2[one.place_evidence != Evidence.FLOOR] for one in plan.passes])
    assert areas.max() <= 2.0 * cell_mm**2 + 1e-9  # each stands for its own cell
    monkeypatch.setattr(planner, "MAX_SERVED", 100)
    few = plan_passes(*judged, free_reach(), OPTICS, Wishes(DENSITY, max_passes=1)).passes[0]
    assert few.promises == plan.passes[0].promises and len(few.places_mm) == 100
    assert few.place_mm2.sum() == pytest.approx(plan.passes[0].place_mm2.sum())


def test_what_a_fixed_axis_cannot_see_is_unreachable_and_turning_the_part_helps():
    judged = Bench(SMALL_STEP).scan(FROM_ABOVE, *ALONG_SMALL_STEP, 0.25).judged()
    fixed = plan_passes(*judged, linear_reach(), OPTICS, WISHES)
    (shadow,) = judged[1].regions
    lost = [one for one in fixed.unreachable if one.region == shadow.number]
    assert lost and all(one.area_mm2 == pytest.approx(one.share * shadow.area_mm2) for one in lost)
    turned = plan_passes(*judged, linear_reach(part_may_turn=True), OPTICS, WISHES)
    assert sum(one.area_mm2 for one in fixed.unreachable) > sum(one.area_mm2 for one in turned.unreachable)
    assert all(one.why for one in fixed.unreachable)
    assert any(one.turn is not None and not one.turn.is_none for one in turned.passes)
    assert any(one["turn_part"] for one in turned.to_dict()["passes"])


def test_what_was_promised_in_vain_is_given_up_so_that_a_loop_ends():
    bench = Bench(Sphere((0.0, 15.0, 0.0), 6.0)).scan(FROM_ABOVE, 8.0, 22.0, 0.3)
    judged = bench.judged()
    tried = Tried.nothing()
    promised = []
    for _ in range(TRIES + 2):
        plan = plan_passes(*judged, linear_reach(), OPTICS, Wishes(DENSITY, max_passes=1), None, tried)
        promised.append(plan.promised_mm2)
        if not plan.passes:
            break
        tried = tried.and_also(plan.passes[0].places_mm)
    shares = {one.region: 0.0 for one in plan.unreachable}
    for one in plan.unreachable:
        shares[one.region] += one.share
    assert "brought no returns" in "".join(one.why for one in plan.unreachable)
    assert len(shares) < len(plan.unreachable) and max(shares.values()) <= 1.0 + 1e-9  # of several reasons together
    assert promised[-1] < promised[0]


def test_the_same_map_gives_the_same_plan(coarse_plan):
    again = Bench(SMALL_STEP).scan(FROM_ABOVE, *ALONG_SMALL_STEP, 0.7).judged()
    assert plan_passes(*again, free_reach(), OPTICS, WISHES).to_dict() == coarse_plan.to_dict()


def test_an_empty_map_has_no_passes():
    bench = Bench(plate().surface).scan(FROM_ABOVE, 200.0, 201.0, 0.5)
    plan = plan_passes(*bench.judged(), free_reach(), OPTICS, WISHES)
    assert (plan.passes, plan.needed_mm2) == ((), 0.0)


def test_hidden_space_into_which_a_pass_looked_in_vain_is_free():
    bench = Bench(plate().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.4)
    a = np.radians(45.0)
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    side = type(FROM_ABOVE)(Pose(turn, np.zeros(3)), np.array([0.0, 1.0, 0.0]))
    bench.scan(side, -1.0, 41.0, 0.4)  # from +x: beyond the far edge it hides what the first pass saw through
    snapshot, _ = bench.judged()
    none = np.zeros(len(snapshot), dtype=bool)
    blind = know_surface(snapshot, none, none.astype(np.int32))
    looks = tuple(
        look_of(snapshot, number, motion, -1.0, 41.0, OPTICS.rays) for number, motion in ((0, FROM_ABOVE), (1, side))
    )
    seeing = know_surface(snapshot, none, none.astype(np.int32), None, looks, OPTICS)
    freed = (blind.state == HIDDEN) & (seeing.state == FREE)
    assert freed.any()
    cells = seeing.low_mm + (np.argwhere(freed) + 0.5) * seeing.cell_mm
    inside = (
        (np.abs(cells[:, 0]) < 19.0) & (cells[:, 1] > 1) & (cells[:, 1] < 39) & (cells[:, 2] > -5) & (cells[:, 2] < -1)
    )
    assert inside.mean() < 0.02  # the inside of the plate is not emptied
