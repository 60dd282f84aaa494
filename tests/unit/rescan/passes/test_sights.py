"""What a plan believes that it sees: beside surface, into narrow holes, and into hidden space with little behind."""

import numpy as np
import pytest

from scanner_service.rescan.passes.behind import ways_behind, weighed
from scanner_service.rescan.passes.known_surface import know_surface
from scanner_service.rescan.passes.needs import Evidence, Needs, failing_points
from scanner_service.rescan.passes.planner import MAX_NEEDS, Wishes, _thinned, plan_passes
from scanner_service.rescan.passes.stretch import best_stretch
from scanner_service.rescan.passes.visibility import look_around
from simulators.parts import plate, step
from simulators.shapes import Cylinder, Difference, box
from tests.unit.rescan.passes.posed_scans import DENSITY, FROM_ABOVE, OPTICS, Bench, free_reach

RADIUS_MM = 1.75


@pytest.fixture(scope="module")
def known_step():
    bench = Bench(step().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.3)
    snapshot, report = bench.judged()
    return know_surface(snapshot, *failing_points(report))


def test_a_sight_that_grazes_a_surface_is_free_and_one_that_goes_through_is_not(known_step):
    """Against the true box of the step: its upper plane at z = 5 mm for y > 20 mm."""
    rng = np.random.default_rng(4)
    n = 400
    places = np.column_stack([rng.uniform(-15, 15, n), rng.uniform(2, 12, n), np.full(n, 0.0)])
    up = np.tile([0.0, 0.0, 1.0], (n, 1))
    sky = look_around(known_step, places, up, np.radians(85.0))
    away = 20.0 - places[:, 1]
    checked = 0
    for column, way in enumerate(sky.directions):
        if way[1] < 0.2 or way[2] < 0.12:  # towards the step, and not below where the sky is looked at
            continue
        height = way[2] / way[1] * away
        aside = places[:, 0] + way[0] / way[1] * away
        clear, hidden = height > 5.4, (height < 4.3) & (np.abs(aside) < 19.0)
        assert sky.open[clear, column].all()
        assert not sky.open[hidden, column].any()
        checked += int(hidden.sum()) + int(clear.sum())
    assert checked > 10_000


def test_passes_planned_after_one_from_above_see_the_walls_of_narrow_holes():
    """Counted on the true cylinders: passes reach their walls all around, and deeper than they are wide."""
    holes = [(x, 6.0) for x in (-4.0, 4.0)]
    cutters = [Cylinder((x, y, -8.0), (x, y, 1.0), RADIUS_MM) for x, y in holes]
    bench = Bench(Difference(box((-8.0, 0.0, -6.0), (8.0, 12.0, 0.0)), *cutters)).scan(FROM_ABOVE, -1.0, 13.0, 0.35)
    for _ in range(4):
        for one in plan_passes(*bench.judged(), free_reach(), OPTICS, Wishes(DENSITY, max_passes=1)).passes:
            bench.scan(one.motion, one.start_mm, one.end_mm, one.line_spacing_mm)
    points = bench.map.snapshot().points_mm
    for x, y in holes:
        off = points[:, :2] - [x, y]
        wall = (np.abs(np.hypot(*off.T) - RADIUS_MM) < 0.1) & (points[:, 2] < -0.3)
        sector = np.floor(np.arctan2(off[wall, 1], off[wall, 0]) / (np.pi / 4)).astype(int) % 8
        deepest = np.array([-points[wall, 2][sector == one].min(initial=0.0) for one in range(8)])
        assert (deepest > 1.0).sum() >= 5
        assert np.median(deepest) > RADIUS_MM


def test_hidden_space_that_ends_soon_counts_for_less_and_the_back_of_a_surface_for_all(known_step):
    """Below the upper plate lies 6 mm + margin of hidden space; a way that leaves it sooner is worth no more."""
    normal = np.array([0.0, -1.0, 0.0])
    places = np.array([[0.0, 19.9, z] for z in (0.5, 1.5, 2.5, 3.5, 4.2)])
    down = np.array([0.0, 0.5, -np.sqrt(0.75)])
    length, stopped = ways_behind(known_step, places, np.tile(down, (5, 1)))
    assert not stopped.any()
    expected = (places[:, 2] - known_step.low_mm[2]) / -down[2]
    assert length == pytest.approx(expected, abs=2.0 * known_step.cell_mm)
    from_below = np.tile([0.0, 0.0, 1.0], (5, 1))
    assert ways_behind(known_step, places + np.array([0.0, 1.0, -0.6]), from_below)[1].all()  # the upper plane's back
    needs = Needs.plain(places, np.tile(normal, (5, 1)), np.ones(5)).changed(
        evidence=np.full(5, Evidence.REST, dtype=np.int64)
    )
    sky = look_around(known_step, places, needs.normals, np.radians(80.0))
    lit = weighed(known_step, needs, sky, free_reach().may_light(sky.directions))
    assert (lit.chance <= needs.chance + 1e-12).all()
    assert (np.diff(lit.chance) >= -1e-12).all()  # higher up more is hidden behind
    measured = needs.changed(evidence=np.full(5, Evidence.MEASURED, dtype=np.int64))
    same = weighed(known_step, measured, sky, free_reach().may_light(sky.directions))
    assert same.chance == pytest.approx(measured.chance)


def test_fewer_needs_stand_for_the_same_gain():
    rng = np.random.default_rng(8)
    n = 3 * MAX_NEEDS
    chance = rng.uniform(0.0, 1.0, n) ** 3
    needs = Needs.plain(rng.normal(size=(n, 3)), np.tile([0.0, 0.0, 1.0], (n, 1)), rng.uniform(0.01, 0.2, n))
    needs = needs.changed(chance=chance)
    fewer = _thinned(needs, MAX_NEEDS)
    assert MAX_NEEDS - 1 <= len(fewer) <= MAX_NEEDS
    assert fewer.gain_mm2.sum() == pytest.approx(needs.gain_mm2.sum())
    assert fewer.area_mm2.sum() == pytest.approx(needs.area_mm2.sum(), rel=0.05)
    half = needs.places_mm[:, 0] > 0
    assert fewer.gain_mm2[fewer.places_mm[:, 0] > 0].sum() == pytest.approx(needs.gain_mm2[half].sum(), rel=0.05)


@pytest.mark.parametrize("least_mm2", [0.0, 5.0, 40.0])
def test_a_stretch_brings_at_least_what_is_asked(least_mm2):
    position, gain = np.concatenate([np.linspace(0.0, 1.0, 10), np.linspace(5.0, 45.0, 300)]), np.full(310, 0.15)
    gain[:10] = 0.3
    best = best_stretch(
        position, np.full(310, 0.2), gain, (0.05, 1.0), (-9.0, 60.0), lambda length, spacing: length / 20.0, 0.1,
        least_mm2,
    )  # fmt: skip
    assert best is not None and best.gain_mm2 >= least_mm2
    nothing = best_stretch(
        position, np.full(310, 0.2), gain, (0.05, 1.0), (-9.0, 60.0), lambda length, spacing: length / 20.0, 0.1, 60.0
    )
    assert nothing is None


def test_a_plate_scanned_well_hides_nothing_that_is_worth_a_look():
    bench = Bench(plate().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.25)
    plan = plan_passes(*bench.judged(), free_reach(), OPTICS, Wishes(DENSITY))
    assert all(one.promised.mm2 < 1.0 for one in plan.passes)
    assert sum(one.gain_mm2 for one in plan.passes) < 20.0  # around the border of all of the plate
