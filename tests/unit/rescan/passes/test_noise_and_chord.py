"""Plans by verdicts: from where noisy and steep places are looked at, how close lines must lie on curved ones."""

import dataclasses
import math

import numpy as np

from drivers.scanline import Pose
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from scanner_service.rescan.requirement import Requirement
from simulators.shapes import Sphere, box
from tests.unit.rescan.passes.posed_scans import DENSITY, FROM_ABOVE, OPTICS, SCANNER, Bench, free_reach, linear_reach

PLATE, AREA_MM2 = box((-10.0, 10.0, -6.0), (10.0, 30.0, 0.0)), 20.0 * 20.0
CHORD_MM = 0.002
SPARSE = 2.0  # points/mm2 that any of these scans has
RADIUS_MM = 12.0
TILT_RAD = math.radians(50.0)
STEEP_RAD = math.radians(66.0)


def failing_share(judged):
    _, report = judged
    return float(report.judgement.fails.mean())


def test_curved_places_ask_for_lines_as_close_as_the_chord_error_allows_and_flat_ones_do_not():
    chord = Requirement(density_per_mm2=SPARSE, chord_error_mm=CHORD_MM)
    wishes = Wishes(SPARSE, max_passes=1, explore=False, requirement=chord)
    flat = Bench(PLATE).scan(FROM_ABOVE, 9.0, 31.0, 0.6)
    asked = sum(one.gain_mm2 for one in plan_passes(*flat.judged(chord), linear_reach(), OPTICS, wishes).passes)
    assert asked < 0.02 * AREA_MM2

    ball = Bench(Sphere((0.0, 15.0, 0.0), RADIUS_MM)).scan(FROM_ABOVE, 2.0, 28.0, 0.6)
    before = ball.judged(chord)
    one = plan_passes(*before, linear_reach(), OPTICS, wishes).passes[0]
    allowed_mm = math.sqrt(8.0 * CHORD_MM * RADIUS_MM)  # κ s²/8 with κ = 1/R
    assert 0.6 > allowed_mm >= one.line_spacing_mm
    ball.scan(one.motion, one.start_mm, one.end_mm, one.line_spacing_mm)
    assert failing_share(ball.judged(chord)) < 0.5 * failing_share(before)


def test_a_noisy_place_is_looked_at_from_nearer_to_its_normal_and_until_good_points_outnumber():
    quiet = Requirement(density_per_mm2=SPARSE, noise_mm=3.0 * SCANNER.noise_mm)
    cosine, sine = math.cos(TILT_RAD), math.sin(TILT_RAD)
    turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    aslant = StraightMotion(Pose(turn, np.zeros(3)), np.array([0.0, 1.0, 0.0]))
    bench = Bench(PLATE)
    clean = bench.posed.scanner
    bench.posed.scanner = dataclasses.replace(clean, noise_mm=12.0 * SCANNER.noise_mm)
    bench.scan(aslant, 9.0, 31.0, 0.3)
    before = bench.judged(quiet)
    noisy = before[1].reason == Reason.NOISY
    assert noisy.mean() > 0.5
    wishes = Wishes(SPARSE, max_passes=1, explore=False, requirement=quiet)
    one = plan_passes(*before, free_reach(), OPTICS, wishes).passes[0]
    assert all(promise.largest_incidence_rad <= 0.75 * TILT_RAD for promise in one.promises)
    old = len(before[0]) / (AREA_MM2)
    assert all(promise.density_per_mm2 > old for promise in one.promises)
    bench.posed.scanner = clean
    bench.scan(one.motion, one.start_mm, one.end_mm, one.line_spacing_mm)
    assert one.gain_mm2 > 0.5 * AREA_MM2
    snapshot, report = bench.judged(quiet)
    new = report.judgement.fails[snapshot.lines.pass_number[snapshot.line] == 1]
    assert new.mean() < 0.05
    assert failing_share((snapshot, report)) < 0.5 * failing_share(before)


def test_when_nothing_else_is_left_steep_surface_is_asked_for_what_it_lacks_from_somewhat_steeper_too():
    cosine, sine = math.cos(STEEP_RAD), math.sin(STEEP_RAD)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])  # the camera's side is turned down
    aslant = StraightMotion(Pose(turn, np.array([0.0, 20.0, 0.0])), turn[:, 1].copy())
    bench = Bench(PLATE).scan(aslant, -9.0, 9.0, 0.25)
    before = bench.judged()
    assert (before[1].reason == Reason.STEEP).mean() > 0.5
    only_so = dataclasses.replace(free_reach(max_tilt_deg=2.0), up=aslant.at_zero.rotation[:, 2].copy())
    wishes = Wishes(DENSITY, max_passes=1, explore=False)
    better = plan_passes(*before, free_reach(), OPTICS, wishes).passes[0]
    assert all(promise.largest_incidence_rad <= OPTICS.max_incidence_rad for promise in better.promises)
    assert all(promise.density_per_mm2 >= DENSITY for promise in better.promises)
    one = plan_passes(*before, only_so, OPTICS, wishes).passes[0]
    assert all(60.0 < math.degrees(promise.largest_incidence_rad) <= 75.0 for promise in one.promises)
    assert all(promise.density_per_mm2 < DENSITY for promise in one.promises)
    bench.scan(one.motion, one.start_mm, one.end_mm, one.line_spacing_mm)
    after = bench.judged()
    assert float(np.median(before[0].side_density_per_mm2)) < DENSITY < float(np.median(after[0].side_density_per_mm2))
    assert failing_share(after) < 0.6 * failing_share(before)  # lines of one direction may lie close in pairs

    head_on = Requirement(density_per_mm2=DENSITY, incidence_rad=math.radians(60.0))
    strict = dataclasses.replace(wishes, requirement=head_on)
    assert not plan_passes(*before, only_so, OPTICS, strict).passes
