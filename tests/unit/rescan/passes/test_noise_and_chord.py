"""Plans for what is noisy and for what is curved: from where a noisy place is looked at, how close lines must lie."""

import dataclasses
import math

import numpy as np

from drivers.scanline import Pose
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from scanner_service.rescan.requirement import Requirement
from simulators.parts import plate
from simulators.shapes import Sphere
from tests.unit.rescan.passes.posed_scans import FROM_ABOVE, OPTICS, SCANNER, Bench, free_reach, linear_reach

CHORD_MM = 0.002
SPARSE = 2.0  # points/mm2 that any of these scans has
RADIUS_MM = 12.0
TILT_RAD = math.radians(50.0)


def failing_share(judged):
    _, report = judged
    return float(report.judgement.fails.mean())


def test_curved_places_ask_for_lines_as_close_as_the_chord_error_allows_and_flat_ones_do_not():
    chord = Requirement(density_per_mm2=SPARSE, chord_error_mm=CHORD_MM)
    wishes = Wishes(SPARSE, max_passes=1, explore=False, requirement=chord)
    flat = Bench(plate().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.6)
    asked = sum(one.gain_mm2 for one in plan_passes(*flat.judged(chord), linear_reach(), OPTICS, wishes).passes)
    assert asked < 0.02 * 40.0 * 40.0

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
    bench = Bench(plate().surface)
    clean = bench.posed.scanner
    bench.posed.scanner = dataclasses.replace(clean, noise_mm=12.0 * SCANNER.noise_mm)
    bench.scan(aslant, -1.0, 41.0, 0.3)
    before = bench.judged(quiet)
    noisy = before[1].reason == Reason.NOISY
    assert noisy.mean() > 0.5
    wishes = Wishes(SPARSE, max_passes=1, explore=False, requirement=quiet)
    one = plan_passes(*before, free_reach(), OPTICS, wishes).passes[0]
    assert all(promise.largest_incidence_rad <= 0.75 * TILT_RAD for promise in one.promises)
    old = len(before[0]) / (40.0 * 40.0)
    assert all(promise.density_per_mm2 > old for promise in one.promises)
    bench.posed.scanner = clean
    bench.scan(one.motion, one.start_mm, one.end_mm, one.line_spacing_mm)
    assert one.gain_mm2 > 0.5 * 40.0 * 40.0
    snapshot, report = bench.judged(quiet)
    new = report.judgement.fails[snapshot.lines.pass_number[snapshot.line] == 1]
    assert new.mean() < 0.05
    assert failing_share((snapshot, report)) < 0.5 * failing_share(before)
