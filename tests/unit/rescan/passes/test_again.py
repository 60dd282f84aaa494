"""A second look from where a pass has looked already: it mends what was too coarse, and no shadow."""

import dataclasses

import numpy as np
import pytest

from drivers.scanline import Pose
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.again import looked_at_alike
from scanner_service.rescan.passes.known_surface import know_surface
from scanner_service.rescan.passes.looks import Look, look_of
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.needs import Evidence, Needs, failing_points
from scanner_service.rescan.passes.outcome import reckon
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from simulators.parts import PARTS
from simulators.shapes import Union, box
from tests.unit.rescan.passes.posed_scans import DENSITY, FROM_ABOVE, OPTICS, Bench, linear_reach


def known(judged, *looks):
    snapshot, report = judged
    by_shadow = report.judgement.reason == Reason.SHADOW
    return know_surface(snapshot, *failing_points(report), None, looks, OPTICS, None, by_shadow)


@pytest.fixture(scope="module")
def stepped():
    """A step scanned finely from above: what it still lacks lies in its shadow."""
    judged = Bench(PARTS["step"]().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.25).judged()
    return judged, look_of(judged[0], 0, FROM_ABOVE, -1.0, 41.0, OPTICS.rays)


def places(kind):
    """On the floor before the step, in its shadow."""
    y = np.linspace(17.5, 19.5, 9)
    at = np.column_stack([np.zeros(9), y, np.zeros(9)])
    needs = Needs.plain(at, np.tile([0.0, 0.0, 1.0], (9, 1)), np.full(9, 0.1), DENSITY)
    return needs.changed(evidence=np.full(9, kind, dtype=np.int64))


def turned(degrees, about):
    a = np.radians(degrees)
    axes = np.roll(np.arange(3), -about)
    rotation = np.eye(3)
    rotation[np.ix_(axes[1:], axes[1:])] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    return StraightMotion(Pose(rotation, np.zeros(3)), rotation[:, 1].copy())


@pytest.mark.parametrize("kind", [one for one in Evidence if one is not Evidence.MEASURED])
def test_what_is_guessed_is_not_looked_for_twice_from_one_side_and_is_from_another(stepped, kind):
    judged, look = stepped
    needs = places(kind)

    def alike(motion, *looks):
        return looked_at_alike(known(judged, *looks), needs, motion, motion.sights(needs.places_mm, OPTICS), OPTICS)

    assert alike(FROM_ABOVE, look).all() and not alike(FROM_ABOVE).any()  # nobody has looked
    shifted = StraightMotion(Pose(np.eye(3), np.array([2.0, 0.0, 0.0])), FROM_ABOVE.travel)
    assert alike(shifted, look).all()
    far = StraightMotion(Pose(np.eye(3), np.array([20.0, 0.0, 0.0])), FROM_ABOVE.travel)  # 7.6 degrees aside
    others = [far, *(turned(angle, about) for angle, about in ((10.0, 0), (-10.0, 0), (10.0, 1), (180.0, 2)))]
    assert not any(alike(motion, look).any() for motion in others)
    assert not alike(FROM_ABOVE, Look(FROM_ABOVE, 20.0, 0.25, look.returned)).any()  # it did not go there
    lost = dataclasses.replace(look, returned=np.ones_like(look.returned))  # as lines that never came are told
    assert not alike(FROM_ABOVE, lost).any()


def test_a_shadow_is_not_mended_from_where_it_fell_and_sparse_surface_is(stepped):
    judged, look = stepped
    surface = known(judged, look)
    fails = surface.failing_share >= 0.5
    assert surface.by_shadow[fails].mean() > 0.9
    rows = np.flatnonzero(fails & surface.by_shadow)
    needs = Needs.plain(surface.points_mm[rows], surface.normals[rows], surface.area_mm2[rows], DENSITY)
    assert looked_at_alike(surface, needs, FROM_ABOVE, FROM_ABOVE.sights(needs.places_mm, OPTICS), OPTICS).all()
    coarse = Bench(PARTS["plate"]().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.7).judged()
    surface = known(coarse, look_of(coarse[0], 0, FROM_ABOVE, -1.0, 41.0, OPTICS.rays))
    assert not surface.by_shadow.any() and (surface.failing_share >= 0.5).sum() > 100
    needs = Needs.plain(surface.points_mm, surface.normals, surface.area_mm2, DENSITY)
    assert not looked_at_alike(surface, needs, FROM_ABOVE, FROM_ABOVE.sights(needs.places_mm, OPTICS), OPTICS).any()


def test_a_straight_stage_promises_nothing_that_it_has_looked_for_in_vain():
    """A wall 0.35 mm thick, too coarse, on a stage that only goes along: one pass mends, the next has little left."""
    wall = Union(box((-12.0, 0.0, -4.0), (12.0, 24.0, 0.0)), box((-6.0, 14.0, -1.0), (6.0, 14.35, 8.0)))
    bench, driven = Bench(wall).scan(FROM_ABOVE, -1.0, 25.0, 0.45), [(-1.0, 25.0)]
    kept = []
    for _ in range(3):
        snapshot, report = bench.judged()
        looks = tuple(look_of(snapshot, number, FROM_ABOVE, *ends, OPTICS.rays) for number, ends in enumerate(driven))
        plan = plan_passes(snapshot, report, linear_reach(), OPTICS, Wishes(DENSITY, max_passes=1), looks=looks)
        if not plan.passes:
            break
        one = plan.passes[0]
        driven.append((one.start_mm, one.end_mm))
        bench.scan(one.motion, one.start_mm, one.end_mm, one.line_spacing_mm)
        outcome = reckon(one, snapshot, report, *bench.judged(), OPTICS)
        kept.append(outcome.reached_mm2 / outcome.promised_mm2)
    assert kept[0] == pytest.approx(1.0, rel=0.05) and min(kept) > 0.6
    assert len(kept) < 3  # what is left is the shadows of the wall, and they are told as unreachable
    assert sum(one.area_mm2 for one in plan.unreachable) > 20.0
