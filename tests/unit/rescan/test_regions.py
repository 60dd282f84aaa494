"""Rescan regions of analytic surfaces whose faults, areas and reasons are known."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.region import Limit
from scanner_service.rescan.regions import RegionReport, find_regions
from scanner_service.rescan.requirement import Requirement
from tests.unit.rescan.synthetic_scan import Height, Scan, snapshot_of, straight_down

X = np.arange(-5.0, 5.01, 0.15)
Y = np.arange(0.0, 10.01, 0.3)


def flat(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.zeros_like(x)


def only(report: RegionReport, reason: Reason) -> float:
    """Area of the regions, all of which must have the reason given."""
    assert {region.reason for region in report.regions} == {reason}, report.to_dict()
    return sum(region.area_mm2 for region in report.regions)


def tilted(degrees: float, azimuth_deg: float = 90.0) -> Height:
    """A plane that rises by `degrees` towards `azimuth_deg` from the scanlines' direction."""
    rise, azimuth = np.tan(np.radians(degrees)), np.radians(azimuth_deg)
    return lambda x, y: rise * (np.cos(azimuth) * x + np.sin(azimuth) * (y - 5.0))


def cut(surface: Height, azimuth_deg: float) -> Height:
    """The surface with everything beyond a straight border through its middle away."""
    a = np.radians(azimuth_deg)
    return lambda x, y: np.where(np.cos(a) * x + np.sin(a) * (y - 5.0) <= 0.0, surface(x, y), np.nan)


PERFECT: dict[str, Height] = {
    "plate": flat,
    "disc": lambda x, y: np.where(x**2 + (y - 5) ** 2 < 20, 0.0, np.nan),
    "ring": lambda x, y: np.where((x**2 + (y - 5) ** 2 < 22) & (x**2 + (y - 5) ** 2 > 4), 0.0, np.nan),
    "two plates": lambda x, y: np.where(np.abs(x) > 1.0, 0.0, np.nan),
    "two plates behind each other": lambda x, y: np.where(np.abs(y - 5) > 1.0, 0.0, np.nan),
    "tilted across": tilted(40.0),
    "tilted along": tilted(40.0, 0.0),
    "roof": lambda x, y: -0.8 * np.abs(y - 5),
    "ball's cap": lambda x, y: np.sqrt(np.where(x**2 + (y - 5) ** 2 < 22, 49 - x**2 - (y - 5) ** 2, np.nan)),
    "thin plate of 0.7 mm": lambda x, y: np.where(np.abs(y - 5.1) < 0.35, 0.0, np.nan),
}


@pytest.mark.parametrize("name", PERFECT)
def test_a_perfect_part_has_no_regions(name: str) -> None:
    snapshot = snapshot_of(straight_down(PERFECT[name], X, Y, 0.3, noise_mm=0.005), noise_mm=0.005)
    report = find_regions(snapshot, noise_mm=0.005)
    assert report.regions == ()
    assert not report.rescan.any()


@settings(max_examples=10, deadline=None)
@given(
    spacing=st.sampled_from([0.2, 0.3, 0.5]),
    ratio=st.floats(0.3, 0.9),
    tilt=st.floats(0.0, 42.0),
    azimuth=st.floats(0.0, 180.0),
    border=st.floats(0.0, 360.0),
)
def test_a_plate_with_a_straight_border_has_none_at_any_tilt_and_spacing(
    spacing: float, ratio: float, tilt: float, azimuth: float, border: float
) -> None:
    x, y = np.arange(-15, 16) * ratio * spacing, 5.0 + np.arange(-12, 13) * spacing
    report = find_regions(snapshot_of(straight_down(cut(tilted(tilt, azimuth), border), x, y, spacing)))
    assert report.regions == ()


@pytest.mark.parametrize("degrees", [60.0, 70.0, 78.0])
def test_a_plane_beyond_the_limit_is_one_steep_region_of_its_true_area(degrees: float) -> None:
    snapshot = snapshot_of(straight_down(tilted(degrees), X, Y, 0.3))
    report = find_regions(snapshot)
    assert len(report.regions) == 1
    truth = np.ptp(X) * np.ptp(Y) / np.cos(np.radians(degrees))
    assert only(report, Reason.STEEP) == pytest.approx(truth, rel=0.1)
    expected = np.array([0.0, -np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])
    np.testing.assert_allclose(report.regions[0].normal, expected, atol=0.02)
    # the spacing on the surface is what ranks: 1 / (line spacing / cos * point spacing)
    assert report.regions[0].measured_per_mm2 == pytest.approx(np.cos(np.radians(degrees)) / 0.3 / 0.15, rel=0.05)


@pytest.mark.parametrize("degrees", [57.0, 65.0, 75.0])
def test_a_tilt_is_measured_where_the_radius_of_the_rule_reaches_no_second_line(degrees: float) -> None:
    snapshot = snapshot_of(straight_down(tilted(degrees), X, Y, 0.3))
    assert not snapshot.reliable.any(), "the neighbourhood is a single scanline, whose plane would be the laser's"
    nominal = np.median(snapshot.density_per_mm2) * 0.3 * 0.15
    assert nominal == pytest.approx(2 * 0.3 / (np.pi * 0.524), rel=0.1), "... and its density the same at any tilt"
    region = find_regions(snapshot).regions[0]
    assert region.reason is Reason.STEEP and region.limit is not None
    assert region.limit.quantity == "line_spacing" and region.limit.unit == "mm"
    assert region.limit.measured == pytest.approx(0.3 / np.cos(np.radians(degrees)), rel=0.02)
    assert region.limit.required == pytest.approx(np.sqrt(2.0) * 0.3 + 0.1)


def test_what_a_region_fails_by_is_told_with_its_unit_and_which_way_it_fails() -> None:
    steep = find_regions(snapshot_of(straight_down(tilted(60.0), X, Y, 0.3))).regions[0]
    assert steep.to_dict()["limit"] == {
        "quantity": "line_spacing",
        "measured": pytest.approx(0.6, rel=0.01),
        "required": pytest.approx(0.524, rel=0.01),
        "unit": "mm",
        "bound": "at most",
        "text": "scanlines on the surface apart by 0.6 mm, at most 0.524 mm",
        "has": "0.6 mm",
        "needs": "≤ 0.524 mm",
    }
    sparse = find_regions(snapshot_of(straight_down(flat, X, Y, 0.3)), Requirement(density_per_mm2=60.0)).regions[0]
    assert sparse.limit is not None and Limit.from_dict(sparse.limit.to_dict()) == sparse.limit
    leaning = Requirement(incidence_rad=np.radians(30.0))
    turned = find_regions(snapshot_of(straight_down(tilted(45.0), X, Y, 0.3)), leaning).regions[0]
    assert turned.limit is not None and turned.limit.text == "incidence 45°, at most 30°"


@pytest.mark.parametrize("degrees", [20.0, 45.0, 53.0])
def test_a_plane_within_the_limit_is_not_steep(degrees: float) -> None:
    assert find_regions(snapshot_of(straight_down(tilted(degrees), X, Y, 0.3))).regions == ()


def test_five_lost_lines_are_one_region_of_the_strip_they_left() -> None:
    snapshot = snapshot_of(straight_down(flat, X, Y, 0.3).without(range(12, 17)))
    report = find_regions(snapshot)
    assert len(report.regions) == 1
    assert only(report, Reason.LOST_LINES) == pytest.approx(6 * 0.3 * np.ptp(X), rel=0.05)
    assert report.regions[0].measured_per_mm2 == pytest.approx(1 / (6 * 0.3 * 0.15), rel=0.02)
    np.testing.assert_allclose(report.regions[0].centroid_mm, [0.0, 0.3 * 14, 0.0], atol=0.1)


def test_lines_lost_before_the_part_and_after_it_are_no_reason() -> None:
    surface: Height = lambda x, y: np.where((y > 2) & (y < 8), 0.0, np.nan)  # noqa: E731
    scan = straight_down(surface, X, Y, 0.3)
    for lost in (range(0, 7), range(27, 40)):
        assert find_regions(snapshot_of(scan.without(lost))).regions == ()


def test_lost_lines_are_resolved_by_the_same_pass_again() -> None:
    scan = straight_down(flat, X, Y, 0.3).without(range(12, 17))
    again = straight_down(flat, X, Y, 0.3, pass_number=2)
    assert find_regions(snapshot_of(scan.joined(again))).regions == ()


def test_a_second_pass_that_does_not_reach_the_lost_lines_resolves_nothing() -> None:
    scan = straight_down(flat, X, Y, 0.3).without(range(12, 17))
    again = straight_down(flat, X, Y[20:], 0.3, pass_number=2)
    assert only(find_regions(snapshot_of(scan.joined(again))), Reason.LOST_LINES) > 15.0


def test_where_the_stage_was_too_fast_is_sparse_and_nowhere_else() -> None:
    y = np.concatenate([np.arange(0, 3, 0.3), np.arange(3, 6, 0.75), np.arange(6, 9, 0.3)])
    report = find_regions(snapshot_of(straight_down(flat, X, y, 0.3)))
    assert len(report.regions) == 1
    assert only(report, Reason.SPARSE) == pytest.approx(3.0 * np.ptp(X), rel=0.15)
    points = snapshot_of(straight_down(flat, X, y, 0.3)).points_mm[report.rescan]
    assert points[:, 1].min() >= 2.6
    assert points[:, 1].max() <= 6.1


def test_a_requirement_above_what_the_pass_can_give_makes_the_whole_plate_sparse() -> None:
    report = find_regions(snapshot_of(straight_down(flat, X, Y, 0.3)), Requirement(density_per_mm2=60.0))
    assert only(report, Reason.SPARSE) == pytest.approx(np.ptp(X) * np.ptp(Y), rel=0.05)


def test_noise_alone_is_a_noisy_region() -> None:
    snapshot = snapshot_of(straight_down(flat, X, Y, 0.3, noise_mm=0.05), noise_mm=0.01)
    report = find_regions(snapshot, noise_mm=0.01)
    # roughness adds to the area of a triangulated surface
    assert only(report, Reason.NOISY) == pytest.approx(np.ptp(X) * np.ptp(Y), rel=0.15)
    assert np.nanmedian(report.judgement.noise_mm) == pytest.approx(0.05, rel=0.1)
    assert find_regions(snapshot).regions == (), "without a stated noise nothing is noisy"


@pytest.mark.parametrize("name", ["small ball", "edge along", "edge across", "small step"])
def test_curvature_and_edges_are_not_noise(name: str) -> None:
    surfaces: dict[str, Height] = {
        "small ball": lambda x, y: np.sqrt(np.where(x**2 + (y - 5) ** 2 < 3, 6.25 - x**2 - (y - 5) ** 2, np.nan)),
        "edge along": lambda x, y: -0.9 * np.abs(y - 5),
        "edge across": lambda x, y: -0.9 * np.abs(x),
        "small step": lambda x, y: np.where(x < 0, 0.0, 0.15),
    }
    snapshot = snapshot_of(straight_down(surfaces[name], X, Y, 0.3, noise_mm=0.003), noise_mm=0.003)
    assert (snapshot.residual_mm > 3 * 0.003).sum() > 50, "the plane's residual alone would call this noisy"
    report = find_regions(snapshot, noise_mm=0.003)
    assert report.counts["noisy"] == 0


def test_unsettled_points_are_never_judged() -> None:
    scan = straight_down(tilted(70.0), X, Y, 0.3)
    snapshot = snapshot_of(scan, unsettled=lambda points: points[:, 1] > 5.0)
    report = find_regions(snapshot)
    late = snapshot.points_mm[:, 1] > 5.0
    assert not report.rescan[late].any()
    assert (report.reason[late] == Reason.NONE).all()
    assert report.rescan[~late].any()
    assert report.counts["unsettled"] == int(late.sum())


def test_every_point_is_counted_under_one_verdict() -> None:
    scan = straight_down(tilted(70.0), X, Y, 0.3)
    snapshot = snapshot_of(scan, unsettled=lambda points: points[:, 1] > 5.0)
    assert sum(find_regions(snapshot).counts.values()) == len(snapshot)


def _facts(report: RegionReport) -> list[tuple[str, int, float, float]]:
    return [(r.reason.label, r.point_count, round(r.area_mm2, 6), round(r.measured_per_mm2, 6)) for r in report.regions]


@settings(max_examples=5, deadline=None)
@given(
    vector=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-500, 500)] * 3),
)
def test_turning_and_shifting_part_and_scanlines_together_changes_no_region(
    vector: tuple[float, float, float], shift: tuple[float, float, float]
) -> None:
    # a step of 4 mm, lost lines and a flank; spacings of no round ratio, so that no distance equals a radius
    surface: Height = lambda x, y: np.where(x < 0.02, 4.0, 0.0) + np.where(y > 7, 2.3 * (y - 7), 0.0)  # noqa: E731
    scan = straight_down(surface, np.arange(-3, 3, 0.1507), np.arange(0, 10, 0.30011), 0.3).without(range(10, 14))
    rotation = Rotation.from_rotvec(vector).as_matrix()
    still, moved = find_regions(snapshot_of(scan)), find_regions(snapshot_of(scan, rotation, shift))
    assert {r.reason for r in still.regions} >= {Reason.STEEP, Reason.SHADOW, Reason.LOST_LINES}
    assert sorted(_facts(still)) == sorted(_facts(moved))
    np.testing.assert_array_equal(still.rescan, moved.rescan)
    np.testing.assert_array_equal(still.reason, moved.reason)


def test_regions_are_numbered_by_falling_priority_and_become_plain_json() -> None:
    y = np.concatenate([np.arange(0, 3, 0.3), np.arange(3, 6, 0.75), np.arange(6, 12, 0.3)])
    scan = straight_down(flat, X, y, 0.3).without(range(22, 30))
    report = find_regions(snapshot_of(scan))
    assert [region.number for region in report.regions] == [1, 2]
    assert report.regions[0].priority > report.regions[1].priority > 0
    told = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert {region["reason"] for region in told["regions"]} == {"sparse", "lost_lines"}
    assert all(len(loop) >= 4 for region in told["regions"] for loop in region["outline_mm"])


@pytest.mark.parametrize("points", [0, 1, 2, 5])
def test_a_scan_of_hardly_any_points_has_no_regions(points: int) -> None:
    x = np.arange(points) * 0.15
    report = find_regions(snapshot_of(straight_down(flat, x, Y[:1], 0.3) if points else Scan()))
    assert report.regions == ()


def test_a_scanline_of_its_own_is_flagged_with_the_area_of_a_strand() -> None:
    report = find_regions(snapshot_of(straight_down(flat, X, Y[:1], 0.3)))
    assert only(report, Reason.SPARSE) == pytest.approx(len(X) * 0.15 * 0.15, rel=0.05)
