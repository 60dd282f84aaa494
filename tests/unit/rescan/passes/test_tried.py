"""Places that passes missed: tries are passes, however many places of one pass lie together."""

import numpy as np
import pytest

from scanner_service.rescan.passes.needs import Evidence, Needs
from scanner_service.rescan.passes.tried import EMPTIED, LOWERED, TRIES, Tried

CELL_MM = 0.35
PLACE = np.zeros((1, 3))
UP = np.array([0.0, 0.0, 1.0])


def cluster(seed):
    """A few dozen places, each well within a cell of the origin."""
    return np.random.default_rng(seed).uniform(-0.1, 0.1, (40, 3))


def wanted(places_mm, evidence=Evidence.MEASURED):
    n = len(places_mm)
    needs = Needs.plain(np.array(places_mm, dtype=np.float64).reshape(-1, 3), np.tile(UP, (n, 1)), np.ones(n))
    return needs.changed(evidence=np.full(n, evidence, dtype=np.int64))


def test_one_pass_in_vain_is_one_try_however_dense_its_places():
    tried = Tried.nothing()
    for passes in range(TRIES):
        needs, given_up = tried.of(wanted(PLACE), CELL_MM)
        assert needs.gain_mm2 == pytest.approx([LOWERED**passes]) and not len(given_up)
        tried = tried.and_also(cluster(passes))
    needs, given_up = tried.of(wanted(PLACE), CELL_MM)
    assert not len(needs) and given_up.places_mm.tolist() == PLACE.tolist()


def test_only_passes_that_missed_something_near_are_tries():
    far = np.array([[5.0, 0.0, 0.0]])
    tried = Tried.nothing().and_also(cluster(1)).and_also(far).and_also(np.zeros((0, 3))).and_also(cluster(2))
    needs, _ = tried.of(wanted([*PLACE, *far, [2.0, 2.0, 2.0]]), CELL_MM)
    assert needs.gain_mm2 == pytest.approx([LOWERED**2, LOWERED, 1.0])
    nothing, _ = tried.of(wanted([]), CELL_MM)
    assert not len(nothing)


def test_hidden_space_around_where_nothing_was_found_is_believed_in_less_and_surface_is_not():
    beside = [[0.0, 0.0, 1.5], [0.0, 0.0, 3.0]]
    tried = Tried.nothing().and_also(PLACE, PLACE).and_also(PLACE, PLACE)
    for kind in (Evidence.FRONTIER, Evidence.BEYOND):
        needs, given_up = tried.of(wanted(beside, kind), CELL_MM)
        assert needs.gain_mm2 == pytest.approx([EMPTIED**2, 1.0]) and not len(given_up)
    for kind in (Evidence.MEASURED, Evidence.FLOOR, Evidence.REFERENCE):
        assert tried.of(wanted(beside, kind), CELL_MM)[0].gain_mm2 == pytest.approx([1.0, 1.0])
