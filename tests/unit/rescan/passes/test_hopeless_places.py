"""Places from which nothing is expected any more: they are kept, thinned and weighed without a division by nothing."""

import numpy as np
import pytest

from scanner_service.rescan.passes.behind import weighed_like
from scanner_service.rescan.passes.needs import Evidence, Needs
from scanner_service.rescan.passes.planner import _thinned


def hidden_places(chance, rng):
    n = len(chance)
    plain = Needs.plain(rng.uniform(0.0, 50.0, (n, 3)), np.tile([0.0, 0.0, 1.0], (n, 1)), rng.uniform(0.5, 1.5, n))
    return plain.changed(evidence=np.full(n, int(Evidence.BEYOND)), chance=np.asarray(chance))


@pytest.mark.parametrize("hopeless", [0.0, 0.5, 0.99, 1.0])
def test_of_many_places_at_most_so_many_are_kept_and_stand_for_the_gain_of_all(hopeless):
    rng = np.random.default_rng(3)
    needs = hidden_places(np.where(rng.random(1000) < hopeless, 0.0, 0.4), rng)
    kept = _thinned(needs, 100)
    assert 0 < len(kept) <= 101
    assert kept.gain_mm2.sum() == pytest.approx(needs.gain_mm2.sum())
    assert np.isfinite(kept.area_mm2).all() and (kept.area_mm2 > 0.0).all()


def test_a_place_without_a_chance_says_nothing_of_the_chances_of_those_around_it():
    rng = np.random.default_rng(4)
    every = hidden_places(np.full(60, 0.8), rng)
    drawn = every.only(np.arange(60) < 20)
    drawn = drawn.changed(chance=np.where(np.arange(20) < 10, 0.0, 0.8))
    weighed = weighed_like(every, drawn, drawn.changed(chance=0.25 * drawn.chance)).chance
    away = np.linalg.norm(every.places_mm[:, None] - drawn.places_mm[None], axis=2).argmin(axis=1)
    np.testing.assert_allclose(weighed, np.where(away < 10, 0.8, 0.2))
