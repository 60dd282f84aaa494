"""The border correction, against areas and centroids integrated numerically."""

import numpy as np
import pytest

from scanner_service.rescan.border import LEAST_OFFSET, STRAIGHT_OFFSET, border_aware, share_left


def _integrated(keep: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Share of the unit disc that is kept and the offset of its centroid, by counting a fine grid."""
    disc = x * x + y * y <= 1.0
    kept = keep & disc
    return float(kept.sum() / disc.sum()), float(np.hypot(x[kept].mean(), y[kept].mean()))


GRID = np.meshgrid(np.linspace(-1, 1, 1201), np.linspace(-1, 1, 1201))


@pytest.mark.parametrize("u", [0.0, 0.1, 0.25, 0.4, 0.55, 0.7])
def test_the_share_left_by_a_straight_border_is_that_of_the_disc(u: float) -> None:
    share, offset = _integrated(GRID[0] <= u, *GRID)
    assert share_left(np.array([offset]))[0] == pytest.approx(share, abs=2e-3)


@pytest.mark.parametrize("half_angle_deg", [45.0, 60.0, 75.0, 90.0])
def test_the_share_left_in_a_corner_is_that_of_the_wedge(half_angle_deg: float) -> None:
    x, y = GRID
    share, offset = _integrated(np.abs(np.arctan2(y, x)) <= np.radians(half_angle_deg), x, y)
    assert share_left(np.array([offset]))[0] == pytest.approx(share, abs=3e-3)


@pytest.mark.parametrize("u", [0.2, 0.4, 0.6])
def test_inside_a_right_angled_corner_too_much_share_is_left_by_15_percent_at_most(u: float) -> None:
    share, offset = _integrated((GRID[0] <= u) & (GRID[1] <= u), *GRID)
    assert share <= share_left(np.array([offset]))[0] <= 1.15 * share


def test_on_a_straight_border_the_density_doubles_and_in_the_middle_it_stays() -> None:
    corrected = border_aware(np.array([4.0, 4.0, 4.0]), np.array([STRAIGHT_OFFSET, 0.0, 0.99 * LEAST_OFFSET]))
    np.testing.assert_allclose(corrected, [8.0, 4.0, 4.0], rtol=1e-4)


def test_no_corner_is_taken_for_sharper_than_a_right_angle() -> None:
    assert share_left(np.array([0.66]))[0] == pytest.approx(0.25)
