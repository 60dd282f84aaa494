"""Every radius rule of the chapter, live: what the map uses equals what a batch search finds."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from scanner_service.analysis.global_radius import FIRST_ESTIMATE
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.analysis.radius import RadiusSettings, sample_rows
from scanner_service.analysis.snapshot import RadiusRule
from tests.oracle import Q_MM, Oracle
from tests.unit.analysis.scans import UNKNOWN, stored, surface_scan

LIMIT_MM = 2.0  # 20 c


def flexible_map(threads=1):
    return LiveMap(MapSettings(radius=RadiusSettings(rule="flexible"), max_points=50_000, threads=threads))


def hand_guided(rng, lines, points=40):
    """Lines in any direction over a gently curved surface, as a hand would draw them; some cross, some are far."""
    result = []
    for i in range(lines):
        start, angle = rng.uniform(-3, 3, 2), rng.uniform(0, 2 * math.pi)
        along = np.arange(points) * rng.uniform(0.03, 0.3)
        x, y = start[0] + along * math.cos(angle), start[1] + along * math.sin(angle)
        p = np.column_stack([x, y, 0.05 * x * y]) + rng.normal(0, 0.01, (points, 3))
        laser = np.array([*start, 200.0])
        result.append(stored(p, i, laser_mm=laser, plane_normal=UNKNOWN, travel=UNKNOWN, position_mm=math.nan))
    return result


def assert_flexible(live):
    snapshot = live.snapshot()
    q = np.rint(snapshot.points_mm / Q_MM)
    tree = cKDTree(q)
    distance = tree.query(q, k=min(20, len(q)))[0].reshape(len(q), -1)[:, -1] * Q_MM
    if len(q) < 20:
        distance[:] = np.inf
    expected = np.clip(distance, 0.1, LIMIT_MM)
    np.testing.assert_allclose(snapshot.radius_mm, expected, rtol=1e-12)
    oracle = Oracle(q, snapshot.radius_mm, snapshot.line, snapshot.lines.laser_mm[snapshot.line])
    for row in range(0, len(q), 7):
        truth = oracle.at(row)
        assert snapshot.neighbours[row] == truth.neighbours
        if snapshot.reliable[row]:
            assert np.linalg.norm(np.cross(snapshot.normals[row], truth.normal)) < 1e-6
    covered = (expected > 0.1) & (expected < LIMIT_MM)
    assert (snapshot.neighbours[covered] >= 20).all()
    assert (snapshot.radius_rule == RadiusRule.FLEXIBLE).all()
    return snapshot


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 12), st.integers(1, 2))
def test_a_flexible_scan_has_each_radius_at_its_20th_point_after_every_prefix(seed, count, threads):
    rng = np.random.default_rng(seed)
    live = flexible_map(threads)
    for line in hand_guided(rng, count):
        live.add(line)
        if rng.random() < 0.4:
            assert_flexible(live)
    assert_flexible(live)
    live.close()


def test_a_flexible_radius_shrinks_as_points_arrive_and_says_what_the_20th_point_biases():
    rng = np.random.default_rng(3)
    live = flexible_map()
    lines = hand_guided(rng, 30)
    for line in lines[:5]:
        live.add(line)
    before = live.snapshot()
    for line in lines[5:]:
        live.add(line)
    after = assert_flexible(live)
    assert (after.radius_mm[: len(before)] <= before.radius_mm).all()
    assert (after.radius_mm[: len(before)] < before.radius_mm).any()
    inside = (after.radius_mm > 0.1) & (after.radius_mm < LIMIT_MM)
    expected = 19 / (np.pi * after.radius_mm[inside] ** 2)
    exactly = after.neighbours[inside] == 20
    np.testing.assert_allclose(after.unbiased_density_per_mm2[inside][exactly], expected[exactly])


def test_the_global_radius_is_the_median_of_the_hashed_sample_and_holds_for_every_point():
    rng = np.random.default_rng(4)
    live = LiveMap(MapSettings(radius=RadiusSettings(rule="global"), max_points=50_000))
    lines = surface_scan(lambda x, y: 0.1 * x, lines=90, points=100, rng=rng, noise_mm=0.01)
    used = 0
    estimates = []
    for line in lines:
        live.add(line)
        used += len(line.index)
        snapshot = live.snapshot()
        if used < FIRST_ESTIMATE:
            assert set(snapshot.radius_rule) <= {RadiusRule.LINE_SPACING, RadiusRule.GROWN}
            continue
        base = np.unique(snapshot.radius_mm[snapshot.radius_rule == RadiusRule.GLOBAL])
        assert len(base) == 1
        if not estimates or base[0] != estimates[-1]:
            estimates.append(base[0])
            q = np.rint(snapshot.points_mm / Q_MM)
            numbers = snapshot.lines.line_index[snapshot.line]
            sample = sample_rows("A", 1, numbers, snapshot.index.astype(np.int64))
            radii = np.clip(cKDTree(q).query(q[sample], k=20)[0][:, -1] * Q_MM, 0.1, LIMIT_MM)
            assert base[0] == pytest.approx(np.median(radii), rel=1e-12)
    assert len(estimates) == 3  # at 2,000, 4,000 and 8,000 points
    oracle = Oracle(q_of(snapshot), snapshot.radius_mm, snapshot.line, snapshot.lines.laser_mm[snapshot.line])
    for row in range(0, len(snapshot), 97):
        assert snapshot.neighbours[row] == oracle.at(row).neighbours


def q_of(snapshot):
    return np.rint(snapshot.points_mm / Q_MM)


def test_the_sample_is_one_percent_and_the_same_in_any_order():
    line, place = np.repeat(np.arange(300), 200), np.tile(np.arange(200), 300)
    chosen = sample_rows("A", 7, line, place)
    assert 0.008 < len(chosen) / len(line) < 0.012
    order = np.random.default_rng(0).permutation(len(line))
    again = np.sort(order[sample_rows("A", 7, line[order], place[order])])
    np.testing.assert_array_equal(chosen, again)
    assert len(np.intersect1d(chosen, sample_rows("B", 7, line, place))) < 0.1 * len(chosen)


@pytest.mark.parametrize("rule", ["flexible", "global"])
def test_a_rule_that_grows_from_c_needs_c(rule):
    with pytest.raises(ValueError, match="greater than 0"):
        RadiusSettings(uncertainty_mm=0.0, rule=rule)
