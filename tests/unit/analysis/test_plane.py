"""The plane fit agrees with numpy's decomposition wherever the normal is defined."""

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from scanner_service.analysis.plane import fit_planes, smallest_axis

PAIRS = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]

offsets = st.lists(st.tuples(*[st.integers(-4000, 4000)] * 3), min_size=4, max_size=40)


def fit(points):
    centred = points - points.mean(axis=0)
    m = centred.T @ centred
    return np.array(smallest_axis(m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2]))


@settings(max_examples=500, deadline=None)
@given(offsets)
@example([(100, 4000, 378)] * 2 + [(1354, -403, -51)] * 3)  # doubled points in a line
def test_axis_and_moments_agree_with_svd(points):
    points = np.array(points, dtype=float)
    _, s, axes = np.linalg.svd(points - points.mean(axis=0))
    answer = fit(points)
    np.testing.assert_allclose(answer[3:], s**2, atol=1e-8 * s[0] ** 2)
    if s[0] > 0 and (s[1] ** 2 - s[2] ** 2) / s[0] ** 2 >= 1e-3:
        assert np.linalg.norm(np.cross(answer[:3], axes[2])) < 1e-9


@settings(max_examples=100, deadline=None)
@given(offsets, st.integers(0, 2))
def test_an_exactly_flat_patch_has_an_exact_normal(points, axis):
    points = np.array(points, dtype=float)
    points[:, axis] = 7
    _, s, _ = np.linalg.svd(points - points.mean(axis=0))
    if s[0] > 0 and s[1] ** 2 / s[0] ** 2 >= 1e-3:
        answer = fit(points)
        assert abs(answer[axis]) > 1 - 1e-15
        assert answer[5] <= 1e-12 * answer[3]


def test_no_spread_at_all_still_gives_a_unit_axis_and_zero_moments():
    assert np.array(smallest_axis(0, 0, 0, 0, 0, 0)).tolist() == [0, 0, 1, 0, 0, 0]


@settings(max_examples=100, deadline=None)
@given(st.lists(offsets, min_size=1, max_size=20))
def test_many_planes_at_once_agree_with_one_at_a_time(patches):
    sums = np.zeros((13, len(patches)))
    for i, points in enumerate(patches):
        p = np.array(points, dtype=float)
        sums[:, i] = [len(p), 0, 0, 0, *p.sum(axis=0), *(p[:, a] @ p[:, b] for a, b in PAIRS)]
    fits = np.zeros((8, len(patches)))
    fit_planes(sums, len(patches), fits)
    for i, points in enumerate(patches):
        if fits[6, i] == 0:  # handed on to the solver that always arrives
            continue
        one = fit(np.array(points, dtype=float))
        np.testing.assert_allclose(fits[3:6, i], one[3:], atol=1e-8 * one[3])
        if one[4] - one[5] >= 1e-3 * one[3]:
            assert np.linalg.norm(np.cross(fits[:3, i], one[:3])) < 1e-9
