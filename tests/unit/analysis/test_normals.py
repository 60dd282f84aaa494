"""Normals of clouds by every method: right on known surfaces, one result type, plain words for bad input."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay, cKDTree

from scanner_service.analysis.errors import AnalysisError, MethodRefused, MethodUnknown
from scanner_service.analysis.normals.delaunay_balls import largest_balls
from scanner_service.analysis.normals.estimating import DEFAULT_METHOD, METHODS, estimate_normals
from scanner_service.analysis.normals.field import NormalOptions, NormalReason
from scanner_service.analysis.normals.neighbourhoods import PAIRS_AT_ONCE, by_radius
from tests.unit.analysis.known_surfaces import angle_deg, cylinder, rms_deg, sphere, tilted_plane

EVERYTHING = NormalOptions(max_error_rad=math.inf)
FITTING = ("orthogonal_distance", "fixed_radius", "adaptive_radius", "gaussian")


@pytest.mark.parametrize("method", METHODS)
def test_normals_of_a_sphere_without_noise_are_right_and_do_not_depend_on_where_it_lies(method):
    points, truth = sphere(600, 10.0, np.random.default_rng(1))
    here = estimate_normals(points, method, EVERYTHING)
    assert rms_deg(here.normals, truth) < 5.0
    np.testing.assert_allclose(np.linalg.norm(here.normals, axis=1), 1.0, atol=1e-12)
    there = estimate_normals(points + np.array([4096.0, -512.0, 64.0]), method, EVERYTHING)
    assert np.median(angle_deg(here.normals, there.normals)) < 1e-4


@pytest.mark.parametrize("method", METHODS)
def test_turning_the_part_turns_the_normals(method):
    points, _ = cylinder(400, 5.0, 20.0, np.random.default_rng(2), noise_mm=0.01)
    turn, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    before = estimate_normals(points, method, EVERYTHING).normals
    after = estimate_normals(points @ turn, method, EVERYTHING).normals
    assert np.nanpercentile(angle_deg(before @ turn, after), 99) < 1e-3
    assert (np.isnan(before) == np.isnan(after)).all()


def test_a_stated_number_of_neighbours_gives_numpys_decomposition():
    points, _ = sphere(800, 10.0, np.random.default_rng(4), noise_mm=0.05)
    found = estimate_normals(points, DEFAULT_METHOD, NormalOptions(neighbours=25, max_error_rad=math.inf))
    for row in range(0, 800, 37):
        near = points[cKDTree(points).query(points[row], k=25)[1]]
        axis = np.linalg.svd(near - near.mean(axis=0))[2][2]
        assert np.linalg.norm(np.cross(found.normals[row], axis)) < 1e-9


def test_a_stated_radius_takes_just_the_points_within_it():
    points, _ = sphere(2000, 10.0, np.random.default_rng(5))
    found = estimate_normals(points, "fixed_radius", NormalOptions(radius_mm=1.5))
    counts = [len(near) for near in cKDTree(points).query_ball_point(points, 1.5)]
    assert found.neighbours.tolist() == counts
    np.testing.assert_array_equal(found.reason == NormalReason.TOO_FEW, np.array(counts) < 6)
    assert np.isnan(found.normals[np.array(counts) < 6]).all()


def test_the_gaussian_weight_is_the_formulas():
    points, _ = sphere(500, 10.0, np.random.default_rng(6), noise_mm=0.05)
    found = estimate_normals(points, "gaussian", NormalOptions(radius_mm=4.0, max_error_rad=math.inf))
    for row in range(0, 500, 41):
        distance = np.linalg.norm(points - points[row], axis=1)
        weight = np.where(distance <= 4.0, np.exp(-((distance / (4.0 / 3.0)) ** 2)), 0.0)
        centred = points - (weight[:, None] * points).sum(axis=0) / weight.sum()
        axis = np.linalg.eigh((weight[:, None] * centred).T @ centred)[1][:, 0]
        assert np.linalg.norm(np.cross(found.normals[row], axis)) < 1e-9


def test_the_pole_is_the_farthest_circumcentre_of_the_points_tetrahedra():
    points = np.random.default_rng(7).normal(size=(120, 3))
    balls = largest_balls(points)
    mesh = Delaunay(points)
    on_hull = np.isin(np.arange(120), mesh.convex_hull)
    assert np.isinf(balls.radius_mm[on_hull]).all()
    for row in np.flatnonzero(~on_hull):
        farthest, where = 0.0, None
        for corners in mesh.simplices[(mesh.simplices == row).any(axis=1)]:
            a = points[corners]
            centre = np.linalg.solve(2.0 * (a[1:] - a[0]), (a[1:] ** 2).sum(1) - (a[0] ** 2).sum())
            if np.linalg.norm(centre - points[row]) > farthest:
                farthest, where = np.linalg.norm(centre - points[row]), centre
        assert balls.radius_mm[row] == pytest.approx(farthest, rel=1e-6)
        towards = (where - points[row]) / farthest
        np.testing.assert_allclose(balls.direction[row], towards, atol=1e-5)


def test_big_balls_withstand_noise_that_misleads_poles():
    points, truth = sphere(4000, 10.0, np.random.default_rng(8))
    noisy = points + np.random.default_rng(9).uniform(-0.4, 0.4, points.shape)
    poles, balls = (estimate_normals(noisy, method, EVERYTHING) for method in ("voronoi_poles", "big_delaunay_balls"))
    assert rms_deg(balls.normals, truth) < 0.75 * rms_deg(poles.normals, truth)
    assert "touch no big ball" in balls.notes[0]


@pytest.mark.parametrize("method", FITTING)
def test_the_predicted_error_is_the_error_on_a_noisy_plane(method):
    points, truth = tilted_plane(800, 12.0, np.random.default_rng(10), noise_mm=0.05)
    found = estimate_normals(points, method, EVERYTHING)
    error = np.radians(angle_deg(found.normals, truth))
    # two axes share the error, so the angle's mean square is twice that of one
    ratio = np.sqrt(np.mean(error**2) / (2.0 * np.mean(found.error_rad**2)))
    assert 0.5 < ratio < 1.6


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.3])
def test_the_chosen_number_is_about_as_good_as_the_best_of_all(noise):
    rng = np.random.default_rng(11)
    points, truth = cylinder(4000, 5.0, 20.0, rng)
    noisy = points + rng.uniform(-noise, noise, points.shape)
    by_number = [
        rms_deg(
            estimate_normals(noisy, DEFAULT_METHOD, NormalOptions(neighbours=k, max_error_rad=math.inf)).normals, truth
        )
        for k in (8, 15, 25, 40, 60, 100, 160, 250, 400)
    ]
    assert rms_deg(estimate_normals(noisy, DEFAULT_METHOD, EVERYTHING).normals, truth) < 1.15 * min(by_number)


def test_uncertain_normals_are_not_given():
    points = np.random.default_rng(12).normal(size=(2000, 3))  # no surface at all
    found = estimate_normals(points, DEFAULT_METHOD, NormalOptions(neighbours=20))
    assert (found.reason == NormalReason.UNCERTAIN).all()
    assert np.isnan(found.normals).all()
    assert found.reasons()["uncertain"] == 2000


@pytest.mark.parametrize("method", METHODS)
def test_points_that_are_not_finite_get_their_reason_and_harm_nobody(method):
    points, _ = sphere(200, 10.0, np.random.default_rng(13))
    spoilt = np.insert(points, [0, 100, 200], [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf]], axis=0)
    alone, among = estimate_normals(points, method, EVERYTHING), estimate_normals(spoilt, method, EVERYTHING)
    bad = ~np.isfinite(spoilt).all(axis=1)
    assert (among.reason[bad] == NormalReason.NOT_FINITE).all()
    np.testing.assert_array_equal(among.normals[~bad], alone.normals)
    assert all(len(values) == 203 for values in among.extra.values())


RNG = np.random.default_rng(14)
BAD_CLOUDS = {
    "one place": np.ones((40, 3)),
    "a line": np.outer(np.arange(40.0), [1.0, 2.0, 3.0]),
    "a plane": np.column_stack([RNG.uniform(0, 1, (60, 2)), np.zeros(60)]),
    "a grid in a plane": np.array([[x, y, 5.0] for x in range(8) for y in range(8)]),
    "doubled points": np.repeat(RNG.normal(size=(30, 3)), 3, axis=0),
    "a cube's lattice": np.array([[x, y, z] for x in range(4) for y in range(4) for z in range(4)], dtype=float),
    "a far outlier": np.vstack([RNG.normal(size=(60, 3)), [[1e8, 0, 0]]]),
    "beyond reason": np.vstack([RNG.normal(size=(60, 3)), [[1e30, 0, 0]]]),
    "few": RNG.normal(size=(7, 3)),
}


@pytest.mark.parametrize("name", BAD_CLOUDS)
@pytest.mark.parametrize("method", METHODS)
def test_bad_clouds_are_refused_in_plain_words_or_answered_with_reasons(method, name):
    points = BAD_CLOUDS[name]
    try:
        found = estimate_normals(points, method)
    except MethodRefused as refusal:
        assert len(str(refusal).splitlines()) == 1
        assert len(str(refusal)) > 40
        return
    given = found.reliable
    assert np.isnan(found.normals[~given]).all()
    np.testing.assert_allclose(np.linalg.norm(found.normals[given], axis=1), 1.0, atol=1e-9)
    if name in ("one place", "a line"):
        assert not given.any()
    if name in ("a plane", "a grid in a plane"):
        assert (np.abs(found.normals[given, 2]) > 1 - 1e-9).all()


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(*[st.sampled_from([0.0, 1.0, 2.0, 1e-9, 1e9, math.nan, math.inf])] * 3), max_size=30),
    st.sampled_from(sorted(METHODS)),
)
def test_no_cloud_whatsoever_breaks_a_method(points, method):
    points = np.array(points, dtype=float).reshape(-1, 3)
    try:
        found = estimate_normals(points, method)
    except AnalysisError:
        return
    assert not np.isfinite(found.normals[~found.reliable]).any()
    np.testing.assert_allclose(np.linalg.norm(found.normals[found.reliable], axis=1), 1.0, atol=1e-9)


def test_unknown_methods_and_options_of_other_methods_are_refused():
    points, _ = sphere(100, 1.0, np.random.default_rng(15))
    with pytest.raises(MethodUnknown, match="gaussian"):
        estimate_normals(points, "magic")
    with pytest.raises(MethodRefused, match="does not read ball_factor"):
        estimate_normals(points, "gaussian", NormalOptions(ball_factor=2.0))
    with pytest.raises(MethodRefused, match="6 points or more"):
        estimate_normals(points[:5])


@pytest.mark.parametrize(
    "wrong",
    [
        {"radius_mm": 0.0},
        {"radius_mm": math.nan},
        {"neighbours": 5},
        {"noise_mm": -1.0},
        {"radius_mm": 1.0, "neighbours": 9},
        {"floor_mm": 2.0, "ceiling_mm": 1.0},
        {"ball_factor": -1.0},
        {"max_error_rad": 0.0},
    ],
)
def test_options_that_cannot_be_meant_are_refused(wrong):
    with pytest.raises(ValueError, match=r"must|needs|leave|above"):
        NormalOptions(**wrong)


def test_a_radius_that_holds_everything_is_refused_before_the_work_begins():
    points, _ = sphere(12_000, 10.0, np.random.default_rng(16))
    with pytest.raises(MethodRefused, match="choose a smaller one"):
        estimate_normals(points, "fixed_radius", NormalOptions(radius_mm=100.0))


def test_pieces_are_bounded_and_cover_every_point_once():
    points, _ = sphere(9000, 10.0, np.random.default_rng(17))
    pieces = list(by_radius(cKDTree(points), points, np.full(9000, 4.0)))
    assert len(pieces) > 1
    assert all(len(piece.rows) <= PAIRS_AT_ONCE for piece in pieces)
    np.testing.assert_array_equal(np.concatenate([piece.at for piece in pieces]), np.arange(9000))


def test_whoever_is_told_the_progress_may_end_the_work():
    class Enough(Exception):
        pass

    def stop(share):
        raise Enough

    points, _ = sphere(300, 1.0, np.random.default_rng(18))
    with pytest.raises(Enough):
        estimate_normals(points, tell=stop)
