"""Where the line from a label ends."""

import numpy as np
import pytest

from scanner_service.storage.exports.label_places import pointed_at


def test_a_label_points_to_the_middle_of_a_loop_that_holds_it() -> None:
    square = np.array([[1.0, 1.0], [3.0, 1.0], [3.0, 5.0], [1.0, 5.0]])
    assert pointed_at(square) == (2.0, 3.0)


@pytest.mark.parametrize("turn", [1, -1])
def test_a_label_points_to_the_nearest_vertex_of_a_band_that_goes_around_its_middle(turn: int) -> None:
    angle = np.radians(np.arange(-120.0, 121.0, 10.0))
    arc = np.column_stack([np.cos(angle), np.sin(angle)])
    band = np.concatenate([5.0 * arc, 4.0 * arc[::-1]])[::turn]
    x, y = pointed_at(band)
    assert np.hypot(x, y) == pytest.approx(4.0)
    middle = 0.5 * (band.min(axis=0) + band.max(axis=0))
    assert np.hypot(x - middle[0], y - middle[1]) == pytest.approx(np.linalg.norm(band - middle, axis=1).min())
