"""Local quadrics find quadrics of known coefficients again: distance, curvatures and their directions."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner_service.analysis.quadrics import general
from scanner_service.analysis.quadrics.bivariate import fit_bivariate
from scanner_service.analysis.quadrics.field import QuadricReason
from scanner_service.analysis.quadrics.local import NEEDED, SPARE_POINTS, local_quadrics
from tests.unit.analysis.known_surfaces import angle_deg, cylinder, sphere, tilted_plane

KINDS = tuple(NEEDED)
coefficient = st.floats(-1.0, 1.0)


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[coefficient] * 6))
def test_a_bivariate_quadratic_is_found_again(truth):
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-1, 1, (2, 30))
    a, b, c, d, e, f = truth
    points = np.column_stack([x, y, a + b * x + c * y + d * x * x + e * x * y + f * y * y])
    points[0] = 0.0  # the point that offsets are taken from; it is not in the fit
    found, variances = np.empty(6), np.empty(6)
    residual = fit_bivariate(points, 0, np.arange(1, 30), 2.0, np.eye(3), found, variances)
    np.testing.assert_allclose(found, truth, atol=1e-9)
    assert residual < 1e-6
    terms = np.column_stack([np.ones(29), x[1:], y[1:], x[1:] ** 2, x[1:] * y[1:], y[1:] ** 2])
    np.testing.assert_allclose(variances, np.diag(np.linalg.inv(terms.T @ terms)), rtol=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(0.5, 3.0)] * 3), st.integers(0, 1000))
def test_a_general_quadric_is_found_again(axes, seed):
    """An ellipsoid, turned and moved: 40 of its points give back its equation."""
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    ball = rng.normal(size=(40, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    points = (ball * axes) @ turn + rng.normal(size=3)
    rows = np.arange(40)
    radius = np.array([np.linalg.norm(points - points[0], axis=1).max()])
    found, residual = general.fit_general(points, np.array([0]), np.array([0, 40]), rows, radius)
    offsets = points - points[0]
    every = np.repeat(found, 40, axis=0)
    slope = np.linalg.norm(general.gradient(every, offsets), axis=1)
    assert np.abs(general.value(every, offsets) / slope).max() < 1e-3 * min(axes)
    assert residual[0] < 1e-3
    # curvature at the first point, from the formula of an ellipsoid with support distance h: K = h^4 / (abc)^2
    local = ball[0] * axes
    support = 1.0 / math.sqrt(((local / np.square(axes)) ** 2).sum())
    curvature, _, _ = general.curvatures(found, np.zeros((1, 3)))
    assert curvature.prod() == pytest.approx(support**4 / np.prod(axes) ** 2, rel=2e-2)


@pytest.mark.parametrize("kind", KINDS)
def test_a_sphere_has_its_curvature_in_every_direction(kind):
    points, truth = sphere(6000, 10.0, np.random.default_rng(2))
    found = local_quadrics(points, kind)
    assert found.given.mean() > 0.99
    size = np.abs(found.curvature_per_mm[found.given])
    assert np.percentile(np.abs(size - 0.1), 95) < 0.01
    assert np.percentile(angle_deg(found.normals[found.given], truth[found.given]), 99) < 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_a_cylinder_bends_around_and_not_along(kind):
    points, truth = cylinder(6000, 5.0, 20.0, np.random.default_rng(3))
    found = local_quadrics(points, kind, spare_points=25)
    inside = found.given & (np.abs(points[:, 2]) < 8.0)
    curvature = found.curvature_per_mm[inside]
    bent = np.argmax(np.abs(curvature), axis=1)
    rows = np.arange(len(curvature))
    np.testing.assert_allclose(np.median(np.abs(curvature[rows, bent])), 0.2, rtol=0.02)
    assert np.median(np.abs(curvature[rows, 1 - bent])) < 0.005
    along = found.direction[inside][rows, 1 - bent]
    assert np.median(np.abs(along[:, 2])) > 0.999
    around = found.direction[inside][rows, bent]
    assert np.abs((around * along).sum(axis=1)).max() < 1e-6
    assert np.abs((around * found.normals[inside]).sum(axis=1)).max() < 1e-6
    outwards = np.sign((found.normals[inside] * truth[inside]).sum(axis=1))
    assert (np.sign(curvature[rows, bent]) == -outwards).mean() > 0.999  # positive bends towards the normal


def test_the_distance_of_a_point_off_the_surface_is_measured():
    points, truth = sphere(4000, 10.0, np.random.default_rng(4))
    points = np.vstack([points, 10.25 * truth[:5]])
    found = local_quadrics(points, "bivariate", radius_mm=np.full(len(points), 3.0))
    # the fit is least squares, so the one point off the surface draws it a little towards itself
    np.testing.assert_allclose(found.distance_mm[-5:], 0.25, rtol=0.12)
    assert np.median(found.distance_mm[:-5]) < 5e-3


def test_feet_on_a_general_quadric_are_nearest():
    """A sphere of radius 3 around the origin: x² + y² + z² - 9 = 0; inside and outside."""
    equation = np.array([-9.0, 0, 0, 0, 1, 0, 0, 1, 0, 1])
    at = np.random.default_rng(5).normal(size=(50, 3))
    at *= np.linspace(1.5, 6.0, 50)[:, None] / np.linalg.norm(at, axis=1, keepdims=True)
    foot = general.feet(np.tile(equation, (50, 1)), at)
    np.testing.assert_allclose(foot, 3.0 * at / np.linalg.norm(at, axis=1, keepdims=True), atol=1e-9)
    curvature, _, normals = general.curvatures(np.tile(equation, (50, 1)), foot)
    np.testing.assert_allclose(curvature, -1.0 / 3.0, atol=1e-9)  # bends away from the outward normal
    np.testing.assert_allclose(normals, foot / 3.0, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_plane_is_flat_wherever_it_lies(kind):
    points, truth = tilted_plane(1000, 10.0, np.random.default_rng(5))
    found = local_quadrics(points + 500.0, kind)
    assert found.given.all()
    assert np.abs(found.curvature_per_mm).max() < 1e-3
    assert angle_deg(found.normals, truth).max() < 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_the_radius_starts_at_its_least_and_grows_until_points_suffice(kind):
    points, _ = sphere(3000, 10.0, np.random.default_rng(6))
    found = local_quadrics(points, kind)
    assert (found.neighbours >= NEEDED[kind] + SPARE_POINTS).all()
    wide = local_quadrics(points, kind, first_radius_mm=2.0)
    assert (wide.radius_mm >= 2.0).all()
    short = local_quadrics(points, kind, max_radius_mm=0.3)
    assert (short.reason[short.neighbours < NEEDED[kind]] == QuadricReason.TOO_FEW).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "points",
    [
        np.ones((40, 3)),
        np.outer(np.arange(40.0), [1.0, 2.0, 3.0]),
        np.full((40, 3), np.nan),
        np.random.default_rng(7).normal(size=(5, 3)),
        np.repeat(np.random.default_rng(8).normal(size=(4, 3)), 10, axis=0),
        np.vstack([np.random.default_rng(9).normal(size=(40, 3)), [[1e8, 0, 0]]]),
    ],
    ids=["one place", "a line", "nan", "few", "doubled", "outlier"],
)
def test_bad_clouds_get_reasons(kind, points):
    found = local_quadrics(points, kind)
    lost = ~found.given
    assert np.isnan(found.curvature_per_mm[lost]).all()
    assert np.isnan(found.distance_mm[lost]).all()
    assert np.isfinite(found.curvature_per_mm[~lost]).all()
    assert sum(found.reasons().values()) == len(points)


def test_what_cannot_be_meant_is_refused():
    with pytest.raises(ValueError, match="bivariate or general"):
        local_quadrics(np.zeros((20, 3)), "cubic")
    with pytest.raises(ValueError, match="greater than 0"):
        local_quadrics(np.zeros((20, 3)), first_radius_mm=0.0)
