"""The proofs themselves: the benchmark's truth against formulas, sights against real scans, promises that learn."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.rescan_bunny import compare
from benchmarks.scannable import Allowed, CoverageTruth, sample_surface, scannable
from scanner_service.rescan.passes.experience import chances_of
from scanner_service.rescan.passes.needs import FIRST_CHANCES, Evidence
from scanner_service.rescan.passes.outcome import KindOutcome, Outcome, RegionOutcome
from simulators.posed_rig import PosedScanner
from simulators.shapes import Sphere, box
from tests.unit.rescan.passes.posed_scans import FROM_ABOVE, SCANNER

BUNNY = Path(__file__).resolve().parents[5] / "shared" / "data" / "bunny"


def samples_of(surface, low, high, count, seed=1):
    return sample_surface(surface, np.array(low), np.array(high), count, np.random.default_rng(seed))


def test_samples_tell_the_area_and_lie_evenly():
    ball = samples_of(Sphere((0.0, 0.0, 0.0), 10.0), [-10.0] * 3, [10.0] * 3, 20_000)
    assert len(ball) * ball.each_mm2 == pytest.approx(4 * np.pi * 100.0, rel=0.03)
    assert (ball.places_mm[:, 2] > 5.0).mean() == pytest.approx(0.25, abs=0.015)  # Archimedes
    assert np.einsum("ij,ij->i", ball.normals, ball.places_mm / 10.0) == pytest.approx(1.0, abs=1e-6)


def test_a_free_ball_can_be_scanned_as_far_down_as_tilt_and_incidence_reach():
    ball = Sphere((0.0, 0.0, 0.0), 10.0)
    samples = samples_of(ball, [-10.0] * 3, [10.0] * 3, 3_000)
    seen = scannable(ball, samples, Allowed(np.radians(40.0), np.radians(30.0), np.radians(27.0)))
    angle = np.degrees(np.arccos(samples.normals[:, 2]))
    assert seen[angle < 60.0].all()
    assert not seen[angle > 71.0].any()


def test_coverage_counts_what_was_scanned_densely_enough():
    surface = box((-20.0, 0.0, -6.0), (20.0, 40.0, 0.0))
    samples, dense = (samples_of(surface, [-20.0, 0.0, -6.0], [20.0, 40.0, 0.0], n) for n in (2_000, 60_000))
    truth = CoverageTruth(samples, dense, samples.normals[:, 2] > 0.5, 20.0)
    assert truth.share == 0.0
    posed = PosedScanner(SCANNER, surface, np.random.default_rng(1))
    truth.add(posed.scan(FROM_ABOVE.part_from_sensor, -1.0, 19.0, 0.2))  # 40 points/mm2 over one half
    assert truth.share == pytest.approx(0.5, abs=0.05)
    truth.add(posed.scan(FROM_ABOVE.part_from_sensor, 19.0, 41.0, 0.8))  # 10 points/mm2 over the other
    assert truth.share == pytest.approx(0.5, abs=0.05)


def became(asked_mm2, reached_mm2, kind=Evidence.FRONTIER):
    regions = (RegionOutcome(0, asked_mm2, reached_mm2),)
    return Outcome(regions, np.zeros((0, 3)), (KindOutcome(kind, asked_mm2, reached_mm2),))


def test_each_kind_of_evidence_is_believed_as_far_as_it_proved_true():
    assert chances_of([]) == pytest.approx(FIRST_CHANCES)
    learned = chances_of([became(400.0, 40.0)])
    assert learned[Evidence.FRONTIER] < 0.4 * FIRST_CHANCES[Evidence.FRONTIER]
    assert learned[Evidence.MEASURED] == pytest.approx(FIRST_CHANCES[Evidence.MEASURED])
    ratios = [chances_of([became(400.0, 600.0)] * n)[Evidence.FRONTIER] for n in range(12)]
    assert np.all(np.diff(ratios) > 0) and ratios[-1] == pytest.approx(1.5, rel=0.08)  # what comes again is learned
    outlier = [became(50.0, 55.0)] * 4 + [became(1e4, 3e4)]  # one large pass does not decide
    assert 1.1 < chances_of(outlier)[Evidence.FRONTIER] < 1.7
    small = chances_of([became(0.5, 0.0)])[Evidence.FRONTIER]
    assert small > 0.9 * FIRST_CHANCES[Evidence.FRONTIER]  # too small to learn from
    beyond = became(400.0, 0.0, Evidence.BEYOND)
    later = [became(100.0, 100.0)] * 5  # passes that had no such places teach nothing of them
    assert chances_of([beyond, *later])[Evidence.BEYOND] == chances_of([beyond])[Evidence.BEYOND] < 0.5
    assert chances_of([became(1e6, 0.0)] * 50)[Evidence.FRONTIER] > 0.09  # nothing is ruled out for good


@pytest.mark.skipif(not BUNNY.is_dir(), reason="the real scans lie beside the checkout, and are not there")
def test_what_is_foretold_of_real_scans_from_other_sides_is_what_they_saw():
    found = compare(BUNNY)
    assert found["bun045.ply"]["covered_share_of_predicted"] > 0.99
    assert found["bun045.ply"]["points_where_invisible_share"] < 0.08
    assert found["bun180.ply"]["predicted_mm2"] < 0.01 * found["bun180.ply"]["known_mm2"]
    assert found["bun180.ply"]["points_on_known"] < 0.005 * found["bun180.ply"]["points_on_new_surface"]
