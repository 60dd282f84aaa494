"""Lines of a turntable stand still by their position, not by their laser, which never moves along its own tangent."""

import math

import numpy as np

from drivers.rig import Rig, Turntable
from drivers.scanline import Pose, Profile
from scanner_service.analysis.intake import quantise
from scanner_service.analysis.passes import PassBook


def line(number: int, position_mm: float):
    x_mm = np.linspace(-5, 5, 11)
    profile = Profile(
        "S", 1, 1, number, 0.1 * number, 0.0, x_mm, np.full(11, 40.0), np.zeros(11, dtype=bool),
        np.array([0.0, 0.0, 150.0]), position_mm, 1.0, math.nan,
    )  # fmt: skip
    radial = Pose(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3))
    rig = Rig(stage_from_sensor=radial, turntable=Turntable(np.array([0.0, 0.0, 1.0]), 40.0))
    return quantise(rig.place(profile), np.zeros(3))


def test_a_turning_part_is_no_stopped_one_and_a_stopped_one_is() -> None:
    book = PassBook()
    positions = [0.0, 1.0, 2.0, 2.05, 2.1, 3.0, 2.95, 4.0]
    lines = [line(number, position) for number, position in enumerate(positions)]
    assert all(abs(float(item.laser_mm @ item.travel)) < 1e-9 for item in lines)
    still = [book.enter(item).stands_still_at(item) for item in lines]
    assert still == [False, False, False, True, True, False, True, False]
