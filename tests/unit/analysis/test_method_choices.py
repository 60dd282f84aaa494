"""Choices of the methods for normals: neighbours found without lists, numbers chosen alone, sides found on request."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scanner_service.analysis.comparison.noise import NoiseLevel, add_noise
from scanner_service.analysis.comparison.peers import plain_pca
from scanner_service.analysis.comparison.scoring import score
from scanner_service.analysis.comparison.shapes import SHAPES
from scanner_service.analysis.errors import MethodRefused
from scanner_service.analysis.method_analysis import analyse_by_method
from scanner_service.analysis.normals.against_balls import AgainstBalls
from scanner_service.analysis.normals.estimating import estimate_normals
from scanner_service.analysis.normals.field import NormalOptions
from scanner_service.analysis.normals.fitting import Weighting, fit_all
from scanner_service.analysis.normals.halves import Halves
from scanner_service.analysis.normals.neighbourhoods import by_radius
from scanner_service.analysis.normals.within import fit_within


@pytest.mark.parametrize("weighting", list(Weighting))
def test_planes_without_lists_are_those_of_the_neighbours_found_by_scipy(weighting):
    rng = np.random.default_rng(3)
    points = rng.normal(size=(700, 3)) * [4.0, 3.0, 0.3]
    radius = rng.uniform(0.4, 1.5, 700)
    open_field = NormalOptions(max_error_rad=math.inf, threads=2)
    found = fit_within("any", points, radius, open_field, lambda share: None, weighting=weighting)
    same = fit_all(
        "any", points, by_radius(cKDTree(points), points, radius), max_error_rad=math.inf, weighting=weighting
    )
    np.testing.assert_array_equal(found.neighbours, same.neighbours)
    np.testing.assert_array_equal(found.reason, same.reason)
    given = found.reliable
    np.testing.assert_allclose(np.abs((found.normals * same.normals).sum(axis=1))[given], 1.0, atol=1e-9)


@pytest.mark.parametrize("seed", [5, pytest.param(6, marks=pytest.mark.long)])
@pytest.mark.parametrize("share", [0.005, 0.02])
@pytest.mark.parametrize("shape", ["cylinder", "edge"])
def test_left_to_itself_the_default_is_no_worse_than_a_plain_pca_told_its_best_number(shape, share, seed):
    rng = np.random.default_rng(seed)
    cloud = SHAPES[shape](2000, rng)
    points = add_noise(cloud.points_mm, NoiseLevel("box", share), rng)
    everything = NormalOptions(max_error_rad=math.inf)
    error = score(estimate_normals(points, options=everything).normals, cloud.normals).rms_rad
    best = min(score(plain_pca(points, count), cloud.normals).rms_rad for count in (10, 15, 20, 30, 40, 60, 80, 120))
    assert error < 1.05 * best


def thin_box(count, rng):
    """A closed box of 5 x 3 x 1 mm, whose walls stand a few spacings apart; normals (n, 3) without meaningful sign."""
    size = np.array([5.0, 3.0, 1.0])
    area = size.prod() / size
    axis = rng.choice(3, count, p=area / area.sum())
    points = rng.uniform(size=(count, 3))
    points[np.arange(count), axis] = rng.integers(0, 2, count)
    return points * size, np.eye(3)[axis]


@pytest.mark.parametrize("seed", [1, 2])
def test_where_walls_are_a_few_spacings_apart_the_default_smooths_nothing_away(seed):
    rng = np.random.default_rng(seed)
    points, known = thin_box(600, rng)
    points += rng.uniform(-0.02, 0.02, points.shape)
    halves = Halves.deal(points, Weighting.BIWEIGHT)
    assert halves is not None
    assert halves.too_coarse
    error = score(estimate_normals(points, options=NormalOptions(max_error_rad=math.inf)).normals, known).rms_rad
    best = min(score(plain_pca(points, count), known).rms_rad for count in (8, 10, 12, 15, 20, 30, 40, 60, 80))
    assert error < 1.02 * best


@pytest.mark.parametrize("shape", ["sphere", pytest.param("cylinder", marks=pytest.mark.long), "edge"])
def test_noise_alone_never_makes_a_cloud_coarse(shape):
    rng = np.random.default_rng(3)
    points = add_noise(SHAPES[shape](2000, rng).points_mm, NoiseLevel("spacing", 1.0), rng)
    halves = Halves.deal(points, Weighting.BIWEIGHT)
    assert halves is not None
    assert not halves.too_coarse


def test_what_cannot_be_triangulated_is_judged_by_its_halves():
    flat = np.random.default_rng(4).uniform(size=(300, 3)) * [1.0, 1.0, 0.0]
    assert AgainstBalls.touch(flat, Weighting.EQUAL) is None


def test_a_method_s_normals_are_oriented_outwards_and_curvatures_turn_with_them():
    ball = SHAPES["sphere"](1500, np.random.default_rng(2))
    found = analyse_by_method(ball.points_mm, "bivariate_quadric", NormalOptions(radius_mm=3.0), orient=True)
    assert ((found.normals * ball.normals).sum(axis=1) > 0).all()
    assert (found.scalars["curvature_1_per_mm"] < 0).all()  # bends away from its outside
    assert set(found.scalars["sure"]) == {1.0}
    assert found.orientation is not None
    with pytest.raises(MethodRefused, match="nothing to orient"):
        analyse_by_method(ball.points_mm, "fixed_radius", NormalOptions(radius_mm=0.01), orient=True)
