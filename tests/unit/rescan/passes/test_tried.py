"""Places that passes missed: tries are passes, however many places of one pass lie together."""

import numpy as np

from scanner_service.rescan.passes.tried import TRIES, Tried

CELL_MM = 0.35
PLACE = np.zeros((1, 3))


def cluster(seed):
    """A few dozen places, each well within a cell of the origin."""
    return np.random.default_rng(seed).uniform(-0.1, 0.1, (40, 3))


def test_one_pass_in_vain_is_one_try_however_dense_its_places():
    tried = Tried.nothing()
    assert tried.times(PLACE, 0.8 * CELL_MM).tolist() == [0]
    for passes in range(1, TRIES + 2):
        tried = tried.and_also(cluster(passes))
        assert tried.times(PLACE, 0.8 * CELL_MM).tolist() == [passes]


def test_only_passes_that_missed_something_near_are_tries():
    far = np.array([[5.0, 0.0, 0.0]])
    tried = Tried.nothing().and_also(cluster(1)).and_also(far).and_also(np.zeros((0, 3))).and_also(cluster(2))
    asked = np.concatenate([PLACE, far, np.array([[2.0, 2.0, 2.0]])])
    assert tried.times(asked, 0.8 * CELL_MM).tolist() == [2, 1, 0]
    assert tried.times(np.zeros((0, 3)), 0.8 * CELL_MM).shape == (0,)
