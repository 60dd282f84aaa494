"""Observed coverage against shares that are known from the drawing."""

import json

import numpy as np
import pytest

from scanner_service.rescan.coverage import Coverage, observed_coverage
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.regions import find_regions
from tests.unit.rescan.synthetic_scan import Scan, snapshot_of, straight_down, triangulated

X = np.arange(-5.0, 5.01, 0.15)
Y = np.arange(0.0, 10.01, 0.3)


def flat(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.zeros_like(x)


def coverage_of(scan: Scan) -> Coverage:
    snapshot = snapshot_of(scan)
    return observed_coverage(snapshot, find_regions(snapshot))


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0, 45.0])
def test_a_perfect_plate_is_covered_and_its_area_is_measured_at_any_tilt(tilt_deg: float) -> None:
    coverage = coverage_of(straight_down(lambda x, y: y * np.tan(np.radians(tilt_deg)), X, Y, 0.3))
    assert coverage.share == 1.0
    assert coverage.meets.all()
    truth = len(X) * 0.15 * len(Y) * 0.3 / np.cos(np.radians(tilt_deg))
    assert coverage.area_mm2.sum() == pytest.approx(truth, rel=0.02)


def test_a_plane_beyond_the_limit_is_not_covered_at_all() -> None:
    assert coverage_of(straight_down(lambda x, y: 3.0 * y, X, Y, 0.3)).share == 0.0


def test_lost_lines_take_their_strip_from_the_coverage() -> None:
    coverage = coverage_of(straight_down(flat, X, Y, 0.3).without(range(12, 17)))
    strip, all_of_it = 6 * 0.3, len(Y) * 0.3
    # cells are decided as a whole, so the strip may grow by a cell on either side
    assert 1 - (strip + 2 * coverage.cell_mm) / all_of_it <= coverage.share <= 1 - (strip - 0.3) / all_of_it


def test_a_second_pass_over_the_same_surface_does_not_double_it() -> None:
    once = straight_down(flat, X, Y, 0.3)
    twice = once.joined(straight_down(flat, X, Y + 0.1, 0.3, pass_number=2))
    assert coverage_of(twice).area_mm2.sum() == pytest.approx(coverage_of(once).area_mm2.sum(), rel=0.1)


def test_a_shadow_counts_against_the_coverage_by_its_area() -> None:
    scan = triangulated(lambda x, y: np.where(y < 5, 4.0, 0.0), X, Y, 0.3)
    coverage = coverage_of(scan)
    assert coverage.gap_mm2 == pytest.approx(4.0 * np.ptp(X), rel=0.1)
    assert coverage.share == pytest.approx(1 - coverage.gap_mm2 / (coverage.area_mm2.sum() + coverage.gap_mm2))


def test_the_density_map_is_plain_json_and_says_what_each_cell_lacks() -> None:
    told = json.loads(json.dumps(coverage_of(straight_down(lambda x, y: 3.0 * y, X, Y, 0.3)).to_dict()))
    assert told["kind"] == "observed"
    assert set(told["cells"]["reason"]) == {Reason.STEEP.label}
    assert len(told["cells"]["centre_mm"]) == len(told["cells"]["density_per_mm2"])


def test_nothing_judged_means_no_share_rather_than_none_covered() -> None:
    coverage = coverage_of(Scan())
    assert np.isnan(coverage.share)
    assert coverage.to_dict()["share"] is None


def test_a_cell_without_a_side_is_refused() -> None:
    snapshot = snapshot_of(straight_down(flat, X[:5], Y[:5], 0.3))
    with pytest.raises(ValueError, match="cell_mm must be greater than 0"):
        observed_coverage(snapshot, find_regions(snapshot), cell_mm=0.0)
