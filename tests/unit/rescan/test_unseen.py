"""What other passes have left of a shadow, and the observed coverage, are true whatever hides what is missing."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from drivers.scanline import Pose
from scanner_service.rescan.coverage import observed_coverage
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.requirement import Interest, Requirement
from scanner_service.rescan.unseen import NOTHING, left_by_others, windows_of
from simulators.parts import demo_part
from simulators.shapes import Cylinder, Difference, Surface, Union, box
from tests.unit.rescan.passes.posed_scans import FROM_ABOVE, Bench

INSIDE = Interest((-11.0, 1.0, -9.0), (11.0, 23.0, 9.0))
ASKED = Requirement(density_per_mm2=12.0, interest=INSIDE)
SLAB = box((-14.0, -2.0, -12.0), (14.0, 26.0, 0.0))
PARTS = {
    "pocket": Difference(SLAB, box((-5.0, 7.0, -5.0), (5.0, 17.0, 1.0))),
    "block": Union(SLAB, box((-4.0, 8.0, -1.0), (4.0, 16.0, 5.0))),
    "post": Union(SLAB, Cylinder((0.0, 12.0, -1.0), (0.0, 12.0, 5.0), 3.5)),
}
"""Every surface inside is seen from above or from one of four sides at 45°, but for a line in the corners."""

SIDES = (0.0, 90.0, 180.0, 270.0)
EACH_MM = 0.25
FAR_MM = 0.5  # surface without a point nearer than this is missing


def leaning(azimuth_deg: float, tilt_deg: float = 45.0) -> StraightMotion:
    """A pass along its own lines' normal, tilted about them and turned about the middle of the part."""
    turn, tilt = np.radians(azimuth_deg), np.radians(tilt_deg)
    about_z = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]])
    about_y = np.array([[np.cos(tilt), 0.0, np.sin(tilt)], [0.0, 1.0, 0.0], [-np.sin(tilt), 0.0, np.cos(tilt)]])
    rotation = about_z @ about_y
    middle = np.array([0.0, 12.0, 0.0])
    return StraightMotion(Pose(rotation, middle - rotation @ np.array([0.0, 12.0, 0.0])), rotation[:, 1])


@cache
def samples(part: str) -> np.ndarray:
    """Places on the surface inside, found by rays from above and from many sides: no map, no planner."""
    rng, found = np.random.default_rng(5), []
    for azimuth in np.arange(0.0, 360.0, 15.0):
        for tilt in (5.0, 35.0, 60.0):
            turn, lean = np.radians(azimuth), np.radians(tilt)
            way = -np.array([np.cos(turn) * np.sin(lean), np.sin(turn) * np.sin(lean), np.cos(lean)])
            target = np.column_stack([rng.uniform(-11, 11, 4000), rng.uniform(1, 23, 4000), rng.uniform(-5, 5, 4000)])
            away, _ = PARTS[part].first_hit(target - 60.0 * way, np.tile(way, (4000, 1)))
            hit = np.isfinite(away)
            found.append((target - 60.0 * way)[hit] + away[hit, None] * way)
    places = np.concatenate(found)
    places = places[INSIDE.holds(places)]
    _, one = np.unique(np.floor(places / EACH_MM).astype(np.int64), axis=0, return_index=True)
    return places[one]


def true_share(part: str, points_mm: np.ndarray) -> float:
    """Share of the surface inside that has a point near."""
    return float((cKDTree(points_mm).query(samples(part))[0] <= FAR_MM).mean())


@cache
def stages(part: str) -> list[tuple[float, float, float]]:
    """True share, observed coverage and area of the listed shadows after a pass from above and after each side."""
    bench, told = Bench(PARTS[part]), []
    for number, motion in enumerate((FROM_ABOVE, *(leaning(side) for side in SIDES))):
        bench.scan(motion, -14.0 if number else 0.0, 38.0 if number else 24.0, 0.25)
        snapshot, report = bench.judged(ASKED)
        shadows = sum(region.area_mm2 for region in report.regions if region.reason is Reason.SHADOW)
        seen = snapshot.points_mm[snapshot.neighbours > 0]
        told.append((true_share(part, seen), observed_coverage(snapshot, report).share, shadows))
    return told


def test_what_is_left_hangs_on_no_order_and_on_no_other_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a gap may be looked at again alone, among more or fewer points than before."""
    rng, asked = np.random.default_rng(2), []

    def kept(*arguments):
        asked.append((arguments, left_by_others(*arguments)))
        return asked[-1][1].copy()

    monkeypatch.setattr("scanner_service.rescan.points.left_by_others", kept)
    bench = Bench(PARTS["pocket"]).scan(FROM_ABOVE, 0.0, 24.0, 0.3).scan(leaning(90.0), -14.0, 38.0, 0.3)
    bench.judged(ASKED)
    (((snapshot, frames, stations, gaps, rows, reach, points), left),) = asked
    assert {NOTHING} < set(left[:, 0].tolist()) and (left[:, 0] >= 0).any()
    some = rng.permutation(len(rows))[: len(rows) // 3]
    windows = windows_of(snapshot, gaps, rows[some], reach[some])
    near = [
        ((places >= windows.low_mm) & (places <= windows.high_mm)).all(axis=1).any()
        for places in snapshot.points_mm[points]
    ]
    fewer = rng.permutation(points[np.array(near)])
    assert 0 < len(fewer) < len(points)
    again = left_by_others(snapshot, frames, stations, gaps, rows[some], reach[some], fewer)
    np.testing.assert_array_equal(again, left[some])


@pytest.mark.parametrize("part", sorted(PARTS))
def test_the_observed_coverage_is_the_true_one_while_sides_are_missing_and_once_they_are_not(part: str) -> None:
    for true, observed, _ in stages(part):
        assert observed == pytest.approx(true, abs=0.07), stages(part)


@pytest.mark.parametrize("part", sorted(PARTS))
def test_a_shadow_is_listed_as_long_as_something_of_it_is_missing_and_no_longer(part: str) -> None:
    whole_mm2 = len(samples(part)) * EACH_MM**2
    for true, _, shadows in stages(part):
        missing_mm2 = (1.0 - true) * whole_mm2
        assert 0.4 * missing_mm2 - 3.0 <= shadows <= 2.0 * missing_mm2 + 3.0, stages(part)


FENCED = Union(SLAB, box((-9.0, 2.0, -1.0), (9.0, 10.0, 9.0)), box((-6.0, 14.0, -1.0), (6.0, 14.4, 4.0)))
"""A block, and a thin wall in front of it: from above, the step from its rim to the wall's top is the shorter one."""


@pytest.mark.parametrize(
    ("surface", "asked", "travel_mm", "line_spacing_mm"),
    [
        (FENCED, ASKED, 24.0, 0.25),
        (demo_part().surface, Requirement(density_per_mm2=12.0), 60.0, 0.3),  # walls 2 mm thick, a rib, a pocket
    ],
    ids=["fenced", "demo"],
)
def test_a_pass_from_where_nothing_more_is_seen_takes_nothing_from_a_shadow(
    surface: Surface, asked: Requirement, travel_mm: float, line_spacing_mm: float
) -> None:
    bench, told = Bench(surface), []
    for _ in range(3):
        _, report = bench.scan(FROM_ABOVE, 0.0, travel_mm, line_spacing_mm).judged(asked)
        told.append(sum(region.area_mm2 for region in report.regions if region.reason is Reason.SHADOW))
    assert told[0] > 200.0
    assert told[1:] == pytest.approx([told[0]] * 2, rel=0.05), told
