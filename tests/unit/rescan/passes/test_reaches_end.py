"""Whether a pass was carried out to its end, from where its scanlines lie."""

import numpy as np
import pytest

from scanner_service.rescan.passes.guidance import reaches_end
from scanner_service.rescan.passes.motion import TurningMotion
from scanner_service.rescan.passes.recommendation import RecommendedPass
from tests.unit.rescan.passes.posed_scans import FROM_ABOVE

LASER_MM = np.array([0.0, 0.0, 150.0])
AROUND = TurningMotion(FROM_ABOVE.at_zero, np.array([1.0, 0.0, 0.0]), 20.0)
FULL_TURN_MM = 2 * np.pi * 20.0


def wanted(motion, end_mm):
    nothing, none = np.zeros((0, 3)), [np.zeros(0) for _ in range(4)]
    return RecommendedPass(
        1, motion, 0.0, end_mm, 0.2, 50.0, 4.0, 0.0, (), nothing, *none, nothing.copy(), np.zeros(0, bool)
    )


def lasers(motion, positions_mm):
    return np.array([motion.part_from_sensor(at).apply(LASER_MM) for at in positions_mm]).reshape(-1, 3)


@pytest.mark.parametrize(("motion", "end_mm"), [(FROM_ABOVE, 40.0), (FROM_ABOVE, -40.0), (AROUND, FULL_TURN_MM)])
def test_only_a_pass_that_went_through_to_its_end_reaches_it(motion, end_mm):
    one = wanted(motion, end_mm)
    whole = lasers(motion, np.linspace(0.0, end_mm, one.line_count))
    rng = np.random.default_rng(3)
    some_lost = whole[np.sort(rng.permutation(len(whole))[: int(0.9 * len(whole))])]
    assert reaches_end(one, LASER_MM, whole)
    assert reaches_end(one, LASER_MM, some_lost)
    for share in (0.0, 0.02, 0.5, 0.79, 0.9):  # a full turn begins where it ends: its first lines are not its last
        assert not reaches_end(one, LASER_MM, whole[: int(share * len(whole))])
    assert not reaches_end(one, LASER_MM, whole[-len(whole) // 4 :])  # only the last quarter
    aside = whole + np.array([25.0, 0.0, 0.0])
    assert not reaches_end(one, LASER_MM, aside)


def test_a_hand_may_be_slow_a_little_aside_and_go_too_far():
    one = wanted(FROM_ABOVE, 40.0)
    slow = lasers(FROM_ABOVE, np.linspace(-5.0, 48.0, 900)) + np.array([1.5, 0.0, 0.0])
    assert reaches_end(one, LASER_MM, slow)


def test_the_last_line_around_a_turntable_may_lie_a_line_before_the_end():
    far = TurningMotion(FROM_ABOVE.at_zero, np.array([1.0, 0.0, 0.0]), 2.0)  # the laser goes 75 times as far
    one = wanted(far, 8.1)
    assert reaches_end(one, LASER_MM, lasers(far, np.arange(0.0, 8.01, 0.2)))
    assert not reaches_end(one, LASER_MM, lasers(far, np.arange(0.0, 7.41, 0.2)))
