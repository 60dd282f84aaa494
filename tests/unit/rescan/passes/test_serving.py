"""Plans for named regions and reasons, for more than density, and for the nominal part; passes kept and read again."""

import base64
import dataclasses
import json

import numpy as np
import pytest

from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.kept_pass import keep_pass, kept_pass
from scanner_service.rescan.passes.motion import TurningMotion
from scanner_service.rescan.passes.needs import UNSEEN
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from scanner_service.rescan.passes.promises import FIRST_SPREADS
from scanner_service.rescan.passes.serving import Serving
from scanner_service.rescan.reference import ReferenceSurface, reference_coverage
from scanner_service.rescan.requirement import Requirement
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


@pytest.fixture(scope="module")
def coarse():
    """A step scanned too coarsely from above: sparse everywhere, with a shadow at its foot."""
    return Bench(SMALL_STEP).scan(FROM_ABOVE, *ALONG_SMALL_STEP, 0.6).judged()


def served_regions(plan):
    return {promise.region for one in plan.passes for promise in one.promises}


def test_named_reasons_alone_are_served(coarse):
    _, report = coarse
    reason_of = {region.number: region.reason for region in report.regions}
    assert {Reason.SPARSE, Reason.SHADOW} <= set(reason_of.values())
    everything = plan_passes(*coarse, free_reach(), OPTICS, Wishes(DENSITY, max_passes=4))
    assert UNSEEN in served_regions(everything)
    named = Serving(reasons=frozenset({Reason.SHADOW}))
    shadows = plan_passes(*coarse, free_reach(), OPTICS, Wishes(DENSITY, max_passes=4, serving=named))
    assert served_regions(shadows)
    assert {reason_of[number] for number in served_regions(shadows)} == {Reason.SHADOW}
    assert shadows.needed_mm2 < everything.needed_mm2


def test_a_named_region_alone_is_served(coarse):
    _, report = coarse
    largest = max(report.regions, key=lambda region: region.area_mm2)
    named = Serving(regions=frozenset({largest.number}))
    plan = plan_passes(*coarse, free_reach(), OPTICS, Wishes(DENSITY, max_passes=2, serving=named))
    assert served_regions(plan) == {largest.number}


def test_lines_lie_as_close_as_line_spacing_and_incidence_ask(coarse):
    snapshot, _ = coarse
    loose = plan_passes(*coarse, linear_reach(), OPTICS, Wishes(2.0, max_passes=1))
    fine = Requirement(density_per_mm2=2.0, line_spacing_mm=0.15)
    asked = plan_passes(*coarse, linear_reach(), OPTICS, Wishes(2.0, max_passes=1, requirement=fine))
    assert not loose.passes or loose.passes[0].line_spacing_mm > 0.15
    assert asked.passes[0].line_spacing_mm <= 0.15
    steep = Requirement(density_per_mm2=DENSITY, incidence_rad=np.radians(20.0))
    plan = plan_passes(*coarse, free_reach(), OPTICS, Wishes(DENSITY, max_passes=3, requirement=steep))
    assert plan.passes
    assert all(p.largest_incidence_rad <= np.radians(20.0) + 1e-9 for one in plan.passes for p in one.promises)
    assert len(snapshot)


def box_corners(low, high):
    """Twelve triangles of a box, wound counter-clockwise seen from outside."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    quads = [
        [(x0, y0, z0), (x0, y1, z0), (x1, y1, z0), (x1, y0, z0)],
        [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)],
        [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)],
        [(x0, y1, z0), (x0, y1, z1), (x1, y1, z1), (x1, y1, z0)],
        [(x0, y0, z0), (x0, y0, z1), (x0, y1, z1), (x0, y1, z0)],
        [(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)],
    ]
    return np.array([[q[a], q[b], q[c]] for q in quads for a, b, c in ((0, 1, 2), (0, 2, 3))], dtype=np.float64)


def test_missing_nominal_surface_is_served_and_nothing_else_is_guessed():
    from simulators.shapes import box

    low, high = (-10.0, 10.0, -6.0), (10.0, 30.0, 0.0)
    snapshot, report = Bench(box(low, high)).scan(FROM_ABOVE, 9.0, 20.0, 0.25).judged()  # the first half of its top
    nominal = ReferenceSurface.of(box_corners(low, high))
    requirement = Requirement(density_per_mm2=DENSITY)
    coverage = reference_coverage(nominal, snapshot, report, requirement)
    numbered = tuple(
        dataclasses.replace(region, number=number)
        for number, region in enumerate((*report.regions, *coverage.untouched), start=1)
    )
    plan = plan_passes(
        snapshot, report, free_reach(), OPTICS, Wishes(DENSITY, max_passes=2), regions=numbered, reference=coverage
    )
    untouched = {region.number for region in numbered if region.reason is Reason.UNTOUCHED}
    assert served_regions(plan) & untouched
    first = plan.passes[0]
    off = np.maximum(np.array(low) - first.places_mm, first.places_mm - np.array(high)).max(axis=1)
    assert np.abs(off).max() < 1.0  # every place lies on the nominal part
    assert first.gain_mm2 > 150.0  # the other half of its top
    below = [one for one in plan.unreachable if "face" in one.why]
    assert sum(one.area_mm2 for one in below) > 350.0  # nobody looks at the underside


def test_a_kept_pass_is_the_pass_that_was_kept(coarse):
    one = plan_passes(*coarse, linear_reach(part_may_turn=True), OPTICS, Wishes(DENSITY, max_passes=1)).passes[0]
    again = kept_pass(json.loads(json.dumps(keep_pass(one), allow_nan=False)))
    told, expected = again.to_dict(), one.to_dict()
    sums = [name for name in told if name.startswith(("promised", "explores", "gain"))]  # seven digits are kept
    assert len(sums) == 6
    for name in sums:
        assert told.pop(name) == pytest.approx(expected.pop(name), rel=1e-5, abs=1e-4)
    regions = [{one.pop("region"): one.pop("gain_mm2") for one in told["serves"]} for told in (told, expected)]
    assert regions[0] == pytest.approx(regions[1], rel=1e-5)
    assert told == expected
    assert again.places_mm == pytest.approx(one.places_mm, abs=1e-4)
    assert again.place_mm2.sum() == pytest.approx(one.place_mm2.sum(), rel=1e-5)
    before = kept_pass(keep_pass(one) | {"turn": [0.5, 0.0]})  # of a time when the point that stays was not kept
    assert before.turn is not None and (before.turn.about_vertical_rad, before.turn.about_mm) == (0.5, None)
    turning = dataclasses.replace(one, motion=TurningMotion(one.motion.at_zero, np.array([0.0, 0.0, 1.0]), 20.0))
    motion = kept_pass(keep_pass(turning)).motion
    assert isinstance(motion, TurningMotion) and motion.radius_mm == 20.0


@pytest.mark.parametrize("without", [(), ("spreads",), ("spreads", "brings"), ("spreads", "brings", "columns")])
def test_a_pass_of_an_older_record_opens_with_what_nobody_kept_then_as_it_is_at_first(coarse, without):
    one = plan_passes(*coarse, linear_reach(), OPTICS, Wishes(DENSITY, max_passes=1)).passes[0]
    half = np.arange(len(one.places_mm)) % 2 == 0
    one = dataclasses.replace(one, place_tried=half, place_mm2=one.place_mm2 * np.where(half, 0.2, 1.0))
    kept = {name: value for name, value in keep_pass(one).items() if name not in without}
    if "columns" in without:  # then what was tried was told from how little was left of it
        rows = np.frombuffer(base64.b64decode(kept["places"]), dtype="<f4").reshape(-1, 11)[:, :10]
        kept["places"] = base64.b64encode(rows.tobytes()).decode()
    again = kept_pass(kept)
    assert again.place_tried.tolist() == half.tolist()
    assert again.learned.spreads == FIRST_SPREADS
    if "brings" in without:  # what was counted on was what was told
        assert again.told_mm2 == pytest.approx(again.place_mm2)
    else:
        assert again.promised.mm2 == pytest.approx(one.promised.mm2, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("places", "AAAA"),
        ("places", "?"),
        ("motion", {"at_zero": None}),
        ("promises", [[1]]),
        ("columns", 7),
        ("columns", 0),
        ("spreads", [0.1] * 9),
        ("brings", [0.1] * 9),
        ("turn", [0.1, 0.2, 3.0]),
    ],
)
def test_what_was_not_kept_so_is_refused(coarse, name, value):
    one = plan_passes(*coarse, linear_reach(), OPTICS, Wishes(DENSITY, max_passes=1)).passes[0]
    with pytest.raises((ValueError, TypeError, KeyError)):
        kept_pass(keep_pass(one) | {name: value})
