"""What a triangulation scanner leaves unseen, by ray casting with both shadows, and what is made of it."""

from dataclasses import replace

import numpy as np
import pytest

from drivers.scanline import SensorGeometry
from scanner_service.rescan.gaps import GapKind
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.regions import RegionReport, RescanRegion, find_regions
from tests.unit.rescan.synthetic_scan import Height, snapshot_of, triangulated

X = np.arange(-5.0, 5.01, 0.15)
Y = np.arange(0.0, 12.01, 0.3)
GEOMETRY = SensorGeometry(np.array([0.0, 0.0, 150.0]), np.array([0.0, 86.6, 150.0]), (-20.0, 9.0), 0.0)


def shadows(report: RegionReport) -> list[RescanRegion]:
    return [region for region in report.regions if region.reason is Reason.SHADOW]


def test_a_pocket_has_a_shadow_region_for_each_of_its_walls() -> None:
    pocket: Height = lambda x, y: np.where((np.abs(x) < 3) & (np.abs(y - 6) < 3.5), -3.0, 0.0)  # noqa: E731
    report = find_regions(snapshot_of(triangulated(pocket, X, Y, 0.3)))
    normals = np.array([region.normal for region in shadows(report)])
    assert {region.reason for region in report.regions} == {Reason.SHADOW}
    for facing in ([1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]):
        assert (normals @ np.array(facing, dtype=float)).max() > 0.9


@pytest.mark.parametrize("low_side", [1, -1])
def test_a_step_across_the_travel_hides_what_lies_below_it(low_side: int) -> None:
    step: Height = lambda x, y: np.where((y - 6) * low_side < 0, 4.0, 0.0)  # noqa: E731
    report = find_regions(snapshot_of(triangulated(step, X, Y, 0.3)))
    assert len(report.regions) == len(shadows(report)) == 1
    region = report.regions[0]
    assert region.normal[1] * low_side > 0.95, "a wall faces its open side"
    # towards the camera the wall alone is missing; away from it the camera's shadow is 4 tan 30 deg wide on the floor
    slant = 4.0 if low_side > 0 else 4.0 / np.cos(np.radians(30.0))
    assert region.area_mm2 == pytest.approx(slant * np.ptp(X), rel=0.1)
    assert region.measured_per_mm2 == 0.0


@pytest.mark.parametrize("azimuth_deg", [0.0, 25.0, 45.0, 70.0])
def test_the_area_of_a_wall_does_not_depend_on_its_angle_to_the_scanlines(azimuth_deg: float) -> None:
    a = np.radians(azimuth_deg)
    # the wall faces the camera, so that only the wall itself is missing; and away from the fan's middle
    wall: Height = lambda x, y: np.where(np.cos(a) * (x - 1) + np.sin(a) * (y - 6) < 0, 4.0, 0.0)  # noqa: E731
    report = find_regions(snapshot_of(triangulated(wall, X, Y, 0.3)))
    lengths = []
    for t in np.linspace(-20, 20, 40001):
        lengths.append(abs(1 - np.sin(a) * t) < 5 and 0 < 6 + np.cos(a) * t < 12)
    truth = 4.0 * sum(lengths) * 1e-3
    assert sum(region.area_mm2 for region in shadows(report)) == pytest.approx(truth, rel=0.15)


def test_a_thin_wall_hides_both_of_its_sides() -> None:
    rib: Height = lambda x, y: np.where(np.abs(y - 6.1) < 0.4, 3.0, 0.0)  # noqa: E731
    report = find_regions(snapshot_of(triangulated(rib, X, Y, 0.3)))
    assert sorted(round(region.normal[1]) for region in shadows(report)) == [-1, 1]


def test_a_hole_through_the_part_is_no_reason() -> None:
    hole: Height = lambda x, y: np.where(x**2 + (y - 6) ** 2 < 9, np.nan, 0.0)  # noqa: E731
    report = find_regions(snapshot_of(triangulated(hole, X, Y, 0.3, thickness_mm=0.5)))
    assert report.regions == ()
    assert len(report.gaps.of_kind(GapKind.HOLE)) > 10, "the hole is seen, and known for what it is"


def test_a_long_slot_through_the_part_is_no_reason() -> None:
    slot: Height = lambda x, y: np.where(np.abs(y - 6) < 1.0, np.nan, 0.0)  # noqa: E731
    assert find_regions(snapshot_of(triangulated(slot, X, Y, 0.3, thickness_mm=0.5))).regions == ()


def test_the_summit_beyond_the_measurement_range_is_out_of_range() -> None:
    dome: Height = lambda x, y: 10.0 - 0.08 * (x**2 + (y - 6) ** 2)  # noqa: E731
    snapshot = snapshot_of(triangulated(dome, X, Y, 0.3, range_mm=GEOMETRY.range_mm))
    report = find_regions(snapshot, geometry=GEOMETRY)
    assert [region.reason for region in report.regions] == [Reason.OUT_OF_RANGE]
    assert report.regions[0].area_mm2 == pytest.approx(np.pi / 0.08, rel=0.15)
    assert find_regions(snapshot).regions == (), "without the scanner's range the summit is a hole like any other"


def test_a_summit_within_the_range_is_no_reason() -> None:
    dome: Height = lambda x, y: 8.0 - 0.08 * (x**2 + (y - 6) ** 2)  # noqa: E731
    snapshot = snapshot_of(triangulated(dome, X, Y, 0.3, range_mm=GEOMETRY.range_mm))
    assert find_regions(snapshot, geometry=GEOMETRY).regions == ()


def test_a_flank_that_goes_on_is_steep_and_not_a_wall() -> None:
    flank: Height = lambda x, y: np.clip(10.0 - 3.0 * (y - 4), 0.0, 10.0)  # noqa: E731
    report = find_regions(snapshot_of(triangulated(flank, X, Y, 0.3)))
    assert {region.reason for region in report.regions} == {Reason.STEEP}


def test_a_pass_that_sees_the_wall_resolves_its_shadow() -> None:
    step: Height = lambda x, y: np.where(y < 6, 4.0, 0.0)  # noqa: E731
    scan = triangulated(step, X, Y, 0.3)
    other = triangulated(lambda x, y: np.zeros_like(x), X, np.arange(0.0, 4.01, 0.3), 0.3, pass_number=2)
    # the second pass looks at the wall y = 6 head-on: its plane is stood upright there, and its laser with it
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    other.points = [points @ turn.T + [0.0, 6.0, 0.0] for points in other.points]
    other.laser = [laser @ turn.T + [0.0, 6.0, 0.0] for laser in other.laser]
    assert shadows(find_regions(snapshot_of(scan)))
    assert not shadows(find_regions(snapshot_of(scan.joined(other))))


@pytest.mark.parametrize("count", [1, 2])
def test_stray_returns_in_front_of_the_surface_cast_no_shadow_and_are_told_as_isolated(count: int) -> None:
    scan = triangulated(lambda x, y: np.zeros_like(x), X, Y, 0.3)
    for number in (9, 20, 31):
        scan.points[number][30 : 30 + count, 2] += 4.0
    snapshot = snapshot_of(scan)
    report = find_regions(snapshot, geometry=GEOMETRY)
    stray = snapshot.points_mm[:, 2] > 2.0
    assert stray.sum() == 3 * count
    assert not report.regions
    assert (report.reason[stray] == Reason.ISOLATED).all()
    assert not report.reason[~stray].any()


def test_what_a_round_silhouette_hides_is_a_shadow_all_around_though_the_surface_grows_steep_before_it() -> None:
    ball: Height = lambda x, y: np.where(  # noqa: E731
        np.hypot(x, y - 6) < 4.0, 6.0 + np.sqrt(np.maximum(16.0 - x**2 - (y - 6) ** 2, 0.0)), 0.0
    )
    x, y = np.arange(-7.0, 7.01, 0.1), np.arange(-6.0, 14.01, 0.2)
    snapshot = snapshot_of(triangulated(ball, x, y, 0.2))
    report = find_regions(snapshot, geometry=replace(GEOMETRY, range_mm=(-20.0, 40.0)))
    gaps = report.gaps
    drop = snapshot.points_mm[gaps.high, 2] - snapshot.points_mm[gaps.low, 2]
    long = drop > 5.0
    assert long.sum() > 50
    assert np.mean(gaps.kind[long] == GapKind.SHADOW) > 0.9
    # the floor is hidden behind the ball's whole width, and so is the ball's own lower half
    assert sum(region.area_mm2 for region in shadows(report)) > np.pi * 4.0 * 6.0
