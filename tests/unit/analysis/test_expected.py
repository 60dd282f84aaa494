"""What the density should be, against plates whose spacing on the surface is known."""

import math

import numpy as np
import pytest

from scanner_service.analysis.expected import expected_density_per_mm2, expected_neighbours, surface_spacing_mm
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from tests.unit.analysis.scans import surface_scan


def tilted_plate(tilt_deg, spacing=0.2, lines=40, noise_mm=0.002, along=0.15):
    live = LiveMap(MapSettings(noise_mm=noise_mm, max_points=50_000))
    slope = math.tan(math.radians(tilt_deg))
    size = {
        "lines": lines,
        "points": 80,
        "spacing": spacing,
        "along": along,
        "rng": np.random.default_rng(1),
        "noise_mm": noise_mm,
    }
    for line in surface_scan(lambda x, y: slope * y, **size):
        live.add(line)
    live.close_all_passes()
    snapshot = live.snapshot()
    middle = (snapshot.line > 10) & (snapshot.line < lines - 10) & (np.abs(snapshot.points_mm[:, 0]) < 20 * along)
    return snapshot, np.flatnonzero(middle).astype(np.int32)


@pytest.mark.parametrize("tilt_deg", [0.0, 20.0, 45.0, 60.0, 72.0])
def test_the_spacing_on_a_tilted_surface_is_the_line_spacing_over_the_cosine(tilt_deg):
    snapshot, rows = tilted_plate(tilt_deg)
    spacing = surface_spacing_mm(snapshot, rows, 2.0)
    assert snapshot.reliable[rows].mean() > 0.95
    assert np.median(spacing) == pytest.approx(0.2 / math.cos(math.radians(tilt_deg)), rel=0.02)


def test_without_a_normal_the_distance_to_the_next_line_is_measured():
    live = LiveMap(MapSettings(noise_mm=0.002, max_radius_mm=0.0, max_points=50_000))  # nothing may grow
    slope = math.tan(math.radians(70.0))
    for line in surface_scan(lambda x, y: slope * y, lines=12, points=60):
        live.add(line)
    snapshot = live.snapshot()
    rows = np.flatnonzero((snapshot.line > 3) & (snapshot.line < 8)).astype(np.int32)
    assert not snapshot.reliable[rows].any()
    np.testing.assert_allclose(surface_spacing_mm(snapshot, rows, 2.0), 0.2 / math.cos(math.radians(70.0)), rtol=1e-3)
    assert np.isnan(surface_spacing_mm(snapshot, rows, 0.3)).all()


@pytest.mark.parametrize("spacing", [0.1, 0.2, 0.3, 0.5])
def test_the_expected_count_is_what_a_good_plate_has(spacing):
    snapshot, rows = tilted_plate(0.0, spacing, along=0.05)
    along = snapshot.lines.point_spacing_mm[snapshot.line[rows]]
    on_surface = surface_spacing_mm(snapshot, rows, 2.0)
    expected = expected_neighbours(snapshot.radius_mm[rows], on_surface, along)
    residual = snapshot.neighbours[rows] / expected - 1.0
    assert abs(residual.mean()) < 0.05
    assert residual.std() < 0.05
    density = expected_density_per_mm2(on_surface, along)
    assert np.median(density) == pytest.approx(1.0 / (spacing * 0.05), rel=0.03)


def test_what_is_not_known_stays_unknown():
    assert np.isnan(expected_neighbours(np.array([0.4]), np.array([np.nan]), np.array([0.1]))).all()
