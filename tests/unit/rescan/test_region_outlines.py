"""What a region's outline is: a simple loop around what it marks, of the area that is stated."""

from functools import cache

import numpy as np
import pytest

from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.gaps import GapKind
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.regions import RegionReport, RescanRegion, find_regions
from scanner_service.rescan.requirement import Requirement
from tests.unit.rescan.plane_loops import crossings, distance, flattened, inside, signed_area
from tests.unit.rescan.synthetic_scan import Height, snapshot_of, straight_down, triangulated

X = np.arange(-5.0, 5.01, 0.15)
Y = np.arange(0.0, 12.01, 0.3)


def flat(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.zeros_like(x)


def wall(azimuth_deg: float) -> Height:
    """A step of 4 mm whose upper side faces away from `azimuth_deg`."""
    a = np.radians(azimuth_deg)
    return lambda x, y: np.where(np.cos(a) * (x - 1) + np.sin(a) * (y - 6) < 0, 4.0, 0.0)


@cache
def scanned_wall(azimuth_deg: float) -> MapSnapshot:
    return snapshot_of(triangulated(wall(azimuth_deg), X, Y, 0.3))


def agrees(region: RescanRegion, points_mm: np.ndarray, slack_mm: float) -> None:
    """Simple, around its points but for `slack_mm`, and of the area stated to 5 %."""
    loops, points = flattened(region.outline_mm, points_mm)
    for loop in loops:
        assert crossings(loop) == 0
    outer = max(loops, key=lambda loop: abs(signed_area(loop)))
    out = ~inside(outer, points)
    assert distance(outer, points[out]).max(initial=0.0) <= slack_mm
    holes = sum(abs(signed_area(loop)) for loop in loops) - abs(signed_area(outer))
    assert abs(signed_area(outer)) - holes == pytest.approx(region.area_mm2, rel=0.05)


PLANAR: dict[str, tuple[Height, np.ndarray, range]] = {
    "steep across": (lambda x, y: 2.75 * y, Y, range(0)),
    "steep askew": (lambda x, y: 2.6 * y + 0.8 * x, Y, range(0)),
    "lost lines": (flat, Y, range(12, 17)),
    "too fast": (flat, np.concatenate([np.arange(0, 3, 0.3), np.arange(3, 6, 0.75), np.arange(6, 9, 0.3)]), range(0)),
    "steep disc": (lambda x, y: np.where(x**2 + (y - 6) ** 2 < 20, 2.75 * y, np.nan), Y, range(0)),
}


@pytest.mark.parametrize("name", PLANAR)
def test_the_outline_of_failing_points_is_a_simple_loop_around_them_of_the_area_stated(name: str) -> None:
    surface, y, lost = PLANAR[name]
    snapshot = snapshot_of(straight_down(surface, X, y, 0.3).without(lost))
    report = find_regions(snapshot)
    assert len(report.regions) == 1
    region = report.regions[0]
    agrees(region, snapshot.points_mm[region.point_rows], slack_mm=0.01)


def shadow(report: RegionReport) -> RescanRegion:
    assert [region.reason for region in report.regions] == [Reason.SHADOW]
    return report.regions[0]


@pytest.mark.parametrize("azimuth_deg", [0.0, 25.0, 45.0, 70.0, 90.0])
def test_the_outline_of_a_shadow_is_a_simple_loop_around_the_gaps_of_the_area_stated(azimuth_deg: float) -> None:
    snapshot = scanned_wall(azimuth_deg)
    report = find_regions(snapshot)
    region = shadow(report)
    rows = report.gaps.of_kind(GapKind.SHADOW)
    middles = 0.5 * (snapshot.points_mm[report.gaps.high[rows]] + snapshot.points_mm[report.gaps.low[rows]])
    own = np.isin(report.gaps.high[rows], region.point_rows) & np.isin(report.gaps.low[rows], region.point_rows)
    assert own.sum() > 30
    # rungs of the other direction lie beside the ribbon's first and last ones, and within a strip of its plane
    agrees(region, middles[own], slack_mm=0.45)


def test_no_edge_of_a_shadow_s_outline_runs_across_it() -> None:
    report = find_regions(scanned_wall(45.0))
    loop = shadow(report).outline_mm[0]
    edges = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)
    # two edges go down the wall at its ends; all others follow rim or foot from one lane to the next
    assert np.sort(edges)[-2:] == pytest.approx([4.0, 4.0], abs=0.4)
    assert np.sort(edges)[-3] < 1.0


def test_a_round_boss_has_one_ring_of_unseen_wall_with_two_loops() -> None:
    radius, height = 3.0, 2.5
    boss: Height = lambda x, y: np.where(x**2 + (y - 6) ** 2 < radius**2, height, 0.0)  # noqa: E731
    report = find_regions(snapshot_of(straight_down(boss, X, Y, 0.3)))
    ring = shadow(report)
    assert len(ring.outline_mm) == 2
    assert ring.area_mm2 == pytest.approx(2 * np.pi * radius * height, rel=0.1)
    heights = sorted(float(loop[:, 2].mean()) for loop in ring.outline_mm)
    assert heights == pytest.approx([0.0, height], abs=0.01)


def test_a_square_boss_has_a_region_for_each_of_its_four_walls() -> None:
    boss: Height = lambda x, y: np.where((np.abs(x) < 3) & (np.abs(y - 6) < 3), 2.5, 0.0)  # noqa: E731
    report = find_regions(snapshot_of(straight_down(boss, X, Y, 0.3)))
    normals = np.array([region.normal for region in report.regions])
    assert len(normals) == 4
    for facing in ([1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]):
        assert (normals @ np.array(facing, dtype=float)).max() > 0.95
    assert sum(region.area_mm2 for region in report.regions) == pytest.approx(4 * 6 * 2.5, rel=0.1)


def test_what_is_smaller_than_the_least_area_is_counted_and_not_listed() -> None:
    snapshot = scanned_wall(0.0)
    listed = find_regions(snapshot)
    region = shadow(listed)
    smaller = find_regions(snapshot, Requirement(region_area_mm2=region.area_mm2 - 0.1))
    larger = find_regions(snapshot, Requirement(region_area_mm2=region.area_mm2 + 0.1))
    assert len(smaller.regions) == 1
    assert larger.regions == ()
    assert not larger.rescan.any()
    small = larger.small_patches["shadow"]
    assert (small.count, small.point_count) == (1, region.point_count)
    assert small.area_mm2 == pytest.approx(region.area_mm2)
    assert larger.counts == listed.counts
    assert larger.gap_mm2 == pytest.approx(listed.gap_mm2)
    assert larger.to_dict()["small_patches"] == {
        "shadow": {"count": 1, "point_count": region.point_count, "area_mm2": small.area_mm2}
    }


def test_patches_of_too_few_points_are_counted_with_the_area_they_stand_for() -> None:
    scan = straight_down(flat, X, Y, 0.3)
    for number in range(15, 26):  # a hole in the part with one return in its middle
        away = np.hypot(scan.points[number][:, 0], scan.points[number][:, 1] - 6.0)
        keep = (away > 1.5) | (away < 0.05)
        scan.points[number], scan.index[number] = scan.points[number][keep], scan.index[number][keep]
    report = find_regions(snapshot_of(scan))
    assert report.counts["isolated"] == 1
    assert report.regions == ()
    small = report.small_patches["isolated"]
    assert (small.count, small.point_count) == (1, 1)
    assert small.area_mm2 == pytest.approx(0.3 * 0.15)
