"""Outlines and areas of patches whose shape is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from scanner_service.rescan.outline import patch_of


def _loop_length(loop: np.ndarray) -> float:
    return float(np.linalg.norm(loop - np.roll(loop, 1, axis=0), axis=1).sum())


def _grid(n: int, spacing: float) -> np.ndarray:
    a, b = np.meshgrid(np.arange(n) * spacing, np.arange(n) * spacing)
    return np.column_stack([a.ravel(), b.ravel(), np.zeros(a.size)])


@given(vector=st.tuples(*[st.floats(-3, 3)] * 3))
def test_a_square_keeps_its_area_and_perimeter_however_it_is_turned(vector: tuple[float, float, float]) -> None:
    points = _grid(11, 0.2) @ Rotation.from_rotvec(vector).as_matrix().T
    patch = patch_of(points, np.full(len(points), 0.3), np.full(len(points), 0.2))
    assert patch.area_mm2 == pytest.approx(4.0)
    assert len(patch.loops) == 1
    assert _loop_length(patch.loops[0]) == pytest.approx(8.0)


def test_a_ring_has_two_loops_and_the_area_between_them() -> None:
    points = _grid(81, 0.1) - [4.0, 4.0, 0.0]
    radius = np.hypot(points[:, 0], points[:, 1])
    points = points[(radius < 4) & (radius > 2)]
    patch = patch_of(points, np.full(len(points), 0.15), np.full(len(points), 0.1))
    assert len(patch.loops) == 2
    assert patch.area_mm2 == pytest.approx(np.pi * 12, rel=0.05)


@pytest.mark.parametrize("count", [1, 2, 3, 12])
def test_points_in_a_row_have_an_area_and_a_closed_outline(count: int) -> None:
    points = np.arange(count)[:, None] * np.array([[0.1, 0.2, 0.2]])
    patch = patch_of(points, np.full(count, 1.0), np.full(count, 0.3))
    assert patch.area_mm2 == pytest.approx(count * 0.3 * 0.3)
    assert len(patch.loops) == 1
    assert np.isfinite(patch.loops[0]).all()
    assert _loop_length(patch.loops[0]) == pytest.approx(2 * (count + 1) * 0.3)


def test_points_that_coincide_do_no_harm() -> None:
    points = np.ones((5, 3))
    assert patch_of(points, np.full(5, 1.0), np.full(5, 0.3)).area_mm2 > 0


def test_a_patch_of_very_many_points_keeps_its_area_to_three_percent() -> None:
    points = _grid(160, 0.1)
    patch = patch_of(points, np.full(len(points), 0.25), np.full(len(points), 0.1))
    assert len(points) > 20_000
    assert len(patch.loops) == 1
    assert patch.area_mm2 == pytest.approx(15.9**2, rel=0.03)
