"""The shapes of the comparison: normals stand on the surface, and equal areas hold equally many points."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from scanner_service.analysis.comparison.peers import plain_pca
from scanner_service.analysis.comparison.scoring import angles_rad
from scanner_service.analysis.comparison.shapes import SHAPES

COUNT = 20_000


@pytest.fixture(scope="module", params=SHAPES)
def cloud(request):
    return SHAPES[request.param](COUNT, np.random.default_rng(5))


def share_is(found, expected):
    """A share of COUNT random points within five standard deviations."""
    return abs(found - expected) < 5.0 * math.sqrt(expected * (1.0 - expected) / COUNT)


def test_planes_through_a_few_points_stand_as_the_known_normals(cloud):
    assert len(cloud.points_mm) == len(cloud.normals) == COUNT
    assert np.allclose(np.linalg.norm(cloud.normals, axis=1), 1.0)
    apart = angles_rad(plain_pca(cloud.points_mm, 10), cloud.normals)
    assert np.degrees(np.median(apart)) < 1.5


def test_faces_and_lids_have_points_by_their_area():
    random = np.random.default_rng(6)
    assert share_is((np.abs(SHAPES["can"](COUNT, random).normals[:, 2]) == 1.0).mean(), 1.0 / 3.0)
    assert np.allclose(SHAPES["corner"](COUNT, random).normals.mean(axis=0), 1.0 / 3.0, atol=1e-4)


def test_the_outside_of_a_torus_has_more_points_than_its_inside():
    torus = SHAPES["torus"](COUNT, np.random.default_rng(7))
    outside = np.hypot(torus.points_mm[:, 0], torus.points_mm[:, 1]) > 10.0
    assert share_is(outside.mean(), 0.5 + 3.0 / (10.0 * math.pi))


def test_waves_have_points_by_the_length_of_their_arc():
    waves = SHAPES["waves"](COUNT, np.random.default_rng(8)).points_mm
    x = waves[:, 0] + 10.0
    assert np.allclose(waves[:, 2], np.cos(x / 1.5))

    def arc(end):
        return quad(lambda u: math.hypot(1.0, math.sin(u / 1.5) / 1.5), 0.0, end, limit=200)[0]

    for end in (1.0, 3.0, 7.0):
        assert share_is((x < end).mean(), arc(end) / arc(20.0))


def test_two_faces_of_a_ridge_meet_at_140_degrees():
    ridge = SHAPES["ridge"](COUNT, np.random.default_rng(9))
    left, right = ridge.normals[ridge.points_mm[:, 0] < 0.0], ridge.normals[ridge.points_mm[:, 0] > 0.0]
    assert math.degrees(math.acos(float(left[0] @ right[0]))) == pytest.approx(180.0 - 140.0)
