"""The optimal radius is the formula's, and what it finds on noisy spheres and cylinders is near the truth."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanner_service.analysis.optimal_radius import (
    FIRST_NEIGHBOURS,
    FLOOR_NEIGHBOURS,
    RadiusLaw,
    estimate_noise_mm,
    mitra_radius_mm,
    optimal_radius,
)
from tests.unit.analysis.known_surfaces import cylinder, sphere, tilted_plane

positive = st.floats(1e-3, 1e3)


def test_a_radius_worked_out_by_hand():
    # sigma 0.1, kappa 0.5, rho 10: 0.1 / sqrt(0.1 * 10) + 4 * 0.01 = 0.14; 0.14 / 0.5 = 0.28; cube root 0.6542
    assert mitra_radius_mm(np.array([0.5]), np.array([10.0]), 0.1)[0] == pytest.approx(0.654213, abs=1e-6)


@given(positive, positive, positive, positive)
def test_lengths_scale_as_lengths(curvature, density, noise, scale):
    """Measured in another unit the same surface has the same radius: only the cube root does that."""
    here = mitra_radius_mm(np.array([curvature]), np.array([density]), noise)
    there = mitra_radius_mm(np.array([curvature / scale]), np.array([density / scale**2]), noise * scale)
    assert there[0] == pytest.approx(scale * here[0], rel=1e-9)


def test_no_noise_asks_for_no_radius_and_no_curvature_for_all_of_it():
    assert mitra_radius_mm(np.array([0.5]), np.array([10.0]), 0.0).tolist() == [0.0]
    assert mitra_radius_mm(np.array([0.0]), np.array([10.0]), 0.1).tolist() == [math.inf]


@pytest.mark.parametrize("noise", [0.02, 0.1])
@pytest.mark.parametrize("shape", ["sphere", "cylinder"])
def test_noise_and_density_are_found_again(shape, noise):
    rng = np.random.default_rng(1)
    points, area = (
        (sphere(8000, 10.0, rng, noise)[0], 4 * math.pi * 100)
        if shape == "sphere"
        else (cylinder(8000, 5.0, 40.0, rng, noise)[0], 2 * math.pi * 5 * 40)
    )
    assert estimate_noise_mm(points) == pytest.approx(noise, rel=0.1)
    found = optimal_radius(points)
    assert np.median(found.density_per_mm2) == pytest.approx(8000 / area, rel=0.12)


@pytest.mark.parametrize(("shape", "truth"), [("sphere", 0.1), ("cylinder", 0.2)])
def test_curvature_is_found_again_within_a_fifth(shape, truth):
    rng = np.random.default_rng(2)
    points = sphere(8000, 10.0, rng, 0.02)[0] if shape == "sphere" else cylinder(8000, 5.0, 40.0, rng, 0.02)[0]
    found = optimal_radius(points, 0.02, RadiusLaw(c1=30.0, c2=120.0))
    inside = np.abs(points[:, 2]) < (20 if shape == "sphere" else 15)
    assert np.median(found.curvature_per_mm[inside]) == pytest.approx(truth, rel=0.2)


def test_more_noise_and_less_curvature_make_larger_radii():
    rng = np.random.default_rng(3)
    small, _ = sphere(1500, 5.0, rng, 0.1)
    quiet, loud = (optimal_radius(small, noise, RadiusLaw(c1=10, c2=40)) for noise in (0.02, 0.2))
    assert np.median(loud.radius_mm) > 1.2 * np.median(quiet.radius_mm)
    flat, _ = tilted_plane(1500, math.sqrt(4 * math.pi * 25), rng, 0.1)
    level = optimal_radius(flat, 0.1, RadiusLaw(c1=10, c2=40))
    assert np.median(level.radius_mm) > 1.2 * np.median(optimal_radius(small, 0.1, RadiusLaw(c1=10, c2=40)).radius_mm)


def test_the_radius_stays_between_floor_and_ceiling_and_says_which_decided():
    points, _ = sphere(3000, 10.0, np.random.default_rng(4), 0.05)
    found = optimal_radius(points, 0.05, RadiusLaw(floor_mm=0.9, ceiling_mm=1.1))
    assert (found.radius_mm >= 0.9 - 1e-12).all()
    assert (found.radius_mm <= 1.1 + 1e-12).all()
    still = optimal_radius(points, 0.0)
    assert still.at_floor.all()
    assert (still.neighbours >= FLOOR_NEIGHBOURS - 1).all()


def test_laws_and_clouds_that_cannot_be_meant_are_refused():
    with pytest.raises(ValueError, match="epsilon"):
        RadiusLaw(epsilon=0.0)
    with pytest.raises(ValueError, match="max_neighbours"):
        RadiusLaw(max_neighbours=3)
    with pytest.raises(ValueError, match=str(FIRST_NEIGHBOURS)):
        optimal_radius(np.zeros((4, 3)))
