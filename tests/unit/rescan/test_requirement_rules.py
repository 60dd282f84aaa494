"""What a user asks for beside density: each rule flags the surface that its inequality says, and no other."""

import numpy as np
import pytest

from scanner_service.rescan.curvature import curvature_across_per_mm
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.regions import find_regions
from scanner_service.rescan.requirement import Interest, Requirement
from tests.unit.rescan.synthetic_scan import snapshot_of, straight_down

X, Y = np.arange(-4, 4, 0.2), np.arange(0, 10, 0.3)
NOISE_MM = 0.002


def _ridge(radius_mm: float):
    """Half a cylinder along the line, its crest at y = 5, on flanks that go on straight where they reach 30 degrees."""

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        edge = 0.5 * radius_mm
        away = np.abs(y - 5.0)
        arc = np.sqrt(radius_mm**2 - np.minimum(away, edge) ** 2)
        return arc - np.maximum(away - edge, 0.0) * np.tan(np.radians(30.0))

    return height


@pytest.mark.parametrize("radius_mm", [2.0, 4.0, 8.0])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_the_curvature_across_the_lines_is_that_of_the_cylinder_and_flat_is_flat(
    radius_mm: float, sense: float
) -> None:
    ridge = _ridge(radius_mm)
    snapshot = snapshot_of(
        straight_down(lambda x, y: sense * ridge(x, y), X, Y, 0.3, noise_mm=NOISE_MM), noise_mm=NOISE_MM
    )
    rows = np.flatnonzero(snapshot.reliable)
    found = curvature_across_per_mm(snapshot, rows, snapshot.radius_mm, NOISE_MM)
    away = np.abs(snapshot.points_mm[rows, 1] - 5.0)
    round_, flat = away < 0.5 * radius_mm - 0.8, (away > 0.5 * radius_mm + 0.8) & (np.abs(away - 4.5) > 0.8)
    known = np.isfinite(found)
    assert np.median(found[round_ & known]) == pytest.approx(1.0 / radius_mm, rel=0.1)
    if flat.any():
        assert np.median(found[flat & known]) < 0.02


def test_only_the_round_part_asks_for_finer_lines_under_a_chord_error() -> None:
    radius_mm = 3.0
    snapshot = snapshot_of(straight_down(_ridge(radius_mm), X, Y, 0.3, noise_mm=NOISE_MM), noise_mm=NOISE_MM)
    chord_mm = 0.3**2 / (8.0 * radius_mm)  # of a head-on line pair on the crest
    loose = find_regions(snapshot, Requirement(chord_error_mm=2.0 * chord_mm), noise_mm=NOISE_MM)
    assert loose.regions == ()
    report = find_regions(snapshot, Requirement(chord_error_mm=0.5 * chord_mm), noise_mm=NOISE_MM)
    assert {region.reason for region in report.regions} == {Reason.SPARSE}
    away = np.abs(snapshot.points_mm[report.rescan][:, 1] - 5.0)
    assert away.max() < 0.5 * radius_mm + 0.8
    crest = np.abs(snapshot.points_mm[:, 1] - 5.0) < 0.5 * radius_mm - 0.8
    assert report.rescan[crest & (np.abs(snapshot.points_mm[:, 0]) < 3.5)].mean() > 0.95
    # what is asked for there: the spacing whose chord keeps the error
    assert report.regions[0].line_spacing_mm == pytest.approx(np.sqrt(0.5) * 0.3, rel=0.1)


def test_a_line_spacing_is_asked_for_on_the_surface_so_that_a_slope_needs_finer_lines_than_a_plain() -> None:
    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where(y < 5.0, 0.0, (y - 5.0) * np.tan(np.radians(45.0)))

    snapshot = snapshot_of(straight_down(height, X, Y, 0.3))
    report = find_regions(snapshot, Requirement(line_spacing_mm=0.36))
    assert [region.reason for region in report.regions] == [Reason.STEEP]
    assert snapshot.points_mm[report.rescan][:, 1].min() > 4.5
    assert report.regions[0].area_mm2 == pytest.approx(8.0 * 5.0 * np.sqrt(2.0), rel=0.1)
    finer = find_regions(snapshot, Requirement(line_spacing_mm=0.25))
    assert {region.reason for region in finer.regions} == {Reason.SPARSE}
    assert find_regions(snapshot, Requirement(line_spacing_mm=0.45)).regions == ()


def test_a_largest_incidence_flags_what_leans_away_until_another_pass_sees_it_better() -> None:
    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where(x < 0.0, 0.0, x * np.tan(np.radians(40.0)))

    first = straight_down(height, X, Y, 0.3)
    report = find_regions(snapshot_of(first), Requirement(incidence_rad=np.radians(30.0)))
    assert [region.reason for region in report.regions] == [Reason.STEEP]
    assert find_regions(snapshot_of(first), Requirement(incidence_rad=np.radians(45.0))).regions == ()
    tilted = straight_down(height, X, Y + 0.1, 0.3, pass_number=2)
    lean = np.radians(40.0)
    aside = np.array([-1e4 * np.sin(lean), 0.0, 1e4 * (np.cos(lean) - 1.0)])
    tilted.laser = [laser + aside for laser in tilted.laser]
    both = find_regions(snapshot_of(first.joined(tilted)), Requirement(incidence_rad=np.radians(30.0)))
    flagged = both.rescan[np.abs(snapshot_of(first.joined(tilted)).points_mm[:, 0]) > 0.6]
    assert not flagged.any()  # the slope is good in the second pass, the plain in the first


def test_only_the_region_of_interest_is_judged() -> None:
    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where(np.abs(y - 5.0) < 2.0, (y - 3.0) * np.tan(np.radians(72.0)), np.where(y < 5.0, 0.0, 12.31))

    snapshot = snapshot_of(straight_down(height, X, Y, 0.3))
    everywhere = find_regions(snapshot)
    assert everywhere.regions[0].reason is Reason.STEEP
    half = find_regions(snapshot, Requirement(interest=Interest((-9.0, 0.0, -1.0), (0.0, 10.0, 20.0))))
    assert half.regions[0].area_mm2 == pytest.approx(0.5 * everywhere.regions[0].area_mm2, rel=0.1)
    assert not half.judgement.judged[snapshot.points_mm[:, 0] > 0.0].any()
    assert sum(half.counts.values()) == len(snapshot)
    nowhere = find_regions(snapshot, Requirement(interest=Interest((-9.0, 0.0, 50.0), (9.0, 10.0, 60.0))))
    assert nowhere.regions == () and nowhere.counts["outside_interest"] == len(snapshot)
