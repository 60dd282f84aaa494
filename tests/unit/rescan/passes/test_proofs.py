"""The proofs themselves: the benchmark's truth against formulas, sights against real scans."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.rescan_bunny import compare
from benchmarks.scannable import Allowed, CoverageTruth, sample_surface, scannable
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


@pytest.mark.skipif(not BUNNY.is_dir(), reason="the real scans lie beside the checkout, and are not there")
def test_what_is_foretold_of_real_scans_from_other_sides_is_what_they_saw():
    found = compare(BUNNY)
    assert found["bun045.ply"]["covered_share_of_predicted"] > 0.99
    assert found["bun045.ply"]["points_where_invisible_share"] < 0.08
    assert found["bun180.ply"]["predicted_mm2"] < 0.01 * found["bun180.ply"]["known_mm2"]
    assert found["bun180.ply"]["points_on_known"] < 0.005 * found["bun180.ply"]["points_on_new_surface"]
