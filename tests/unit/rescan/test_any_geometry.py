"""Whatever the points and the lines are, judging ends, says nothing non-finite, and counts every point."""

import json
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner_service.rescan.coverage import observed_coverage
from scanner_service.rescan.regions import find_regions
from scanner_service.rescan.requirement import Requirement
from tests.unit.rescan.synthetic_scan import Scan, snapshot_of, straight_down

COORDINATE = st.one_of(st.integers(-3, 3).map(float), st.floats(-2.0, 2.0), st.sampled_from([0.0, 1e4, -2e5]))
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE)


@st.composite
def scans(draw: st.DrawFn) -> Scan:
    scan = Scan(places=20)
    for number in range(draw(st.integers(1, 6))):
        points = np.array(draw(st.lists(POINT, max_size=20)), dtype=float).reshape(-1, 3)
        scan.points.append(points)
        scan.index.append(np.arange(len(points)))
        scan.line_index.append(draw(st.integers(0, 8)) + 10 * number)
        scan.pass_number.append(draw(st.integers(1, 2)))
        scan.position.append(draw(st.one_of(st.floats(-5, 5), st.just(float("nan")))))
        scan.laser.append(np.array([0.0, 0.3 * number, 150.5]))
        scan.spacing.append(draw(st.sampled_from([0.1, 0.3, 0.5])))
    return scan


@settings(max_examples=60, deadline=None)
@given(scan=scans())
def test_any_points_are_judged_without_an_exception_or_a_number_that_is_none(scan: Scan) -> None:
    snapshot = snapshot_of(scan)
    report = find_regions(snapshot, Requirement(region_points=1), noise_mm=0.01)
    assert sum(report.counts.values()) == len(snapshot)
    json.dumps(report.to_dict(), allow_nan=False)
    json.dumps(observed_coverage(snapshot, report).to_dict(), allow_nan=False)
    assert all(region.area_mm2 > 0 and 0 <= region.priority <= 1 for region in report.regions)


def test_lines_without_position_plane_or_travel_are_judged_by_what_was_measured() -> None:
    x, y = np.arange(-3, 3, 0.15), np.arange(0, 6, 0.3)
    for degrees, regions in ((0.0, 0), (40.0, 0), (70.0, 1)):
        slope = np.tan(np.radians(degrees))
        snapshot = snapshot_of(straight_down(lambda x, y, s=slope: s * y, x, y, 0.3))
        unknown = np.full((len(snapshot.lines), 3), np.nan)
        lines = replace(
            snapshot.lines, position_mm=unknown[:, 0].copy(), plane_normal=unknown.copy(), travel=unknown.copy()
        )
        assert len(find_regions(replace(snapshot, lines=lines)).regions) == regions


def test_the_direction_of_the_travel_does_not_matter() -> None:
    x, y = np.arange(-3, 3, 0.1507), np.arange(0, 8, 0.30011)

    def step(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where(y < 4.1, 4.0, 0.0)

    there = find_regions(snapshot_of(straight_down(step, x, y, 0.3)))
    back = find_regions(snapshot_of(straight_down(step, x, y[::-1].copy(), 0.3)))
    assert [r.reason for r in there.regions] == [r.reason for r in back.regions]
    np.testing.assert_allclose(there.regions[0].centroid_mm, back.regions[0].centroid_mm, atol=0.1)
    np.testing.assert_allclose(there.regions[0].area_mm2, back.regions[0].area_mm2, rtol=0.01)
