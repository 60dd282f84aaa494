"""What a pass promised and what was found: to which place new surface belongs, what is a promise and what exploring."""

import numpy as np
import pytest

from scanner_service.rescan.passes.needs import FIRST_CHANCES, HIDDEN_KINDS, Evidence
from scanner_service.rescan.passes.outcome import Outcome, owners_of, reckon
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from scanner_service.rescan.passes.recommendation import Promise, RecommendedPass
from simulators.parts import step
from tests.unit.rescan.passes.posed_scans import DENSITY, FROM_ABOVE, OPTICS, Bench, free_reach

CELL_MM = 0.35


def served(places_mm, kinds, mm2=None, area_mm2=None):
    n = len(places_mm)
    area = np.ones(n) if area_mm2 is None else area_mm2
    mm2 = area * np.array(FIRST_CHANCES)[list(kinds)] if mm2 is None else mm2
    return RecommendedPass(
        1, FROM_ABOVE, -5.0, 45.0, 0.2, 50.0, 4.0, 0.0, (Promise(0, float(mm2.sum()), 20.0, 0.0, 0.0),),
        np.array(places_mm, dtype=np.float64), np.zeros(n), mm2, area, np.array(kinds, dtype=np.float64),
        np.tile([0.0, 0.0, 1.0], (n, 1)), np.zeros(n, dtype=bool),
    )  # fmt: skip


@pytest.mark.parametrize("kind", Evidence)
def test_surface_behind_the_border_of_hidden_space_belongs_to_the_place_its_ray_went_through(kind):
    one = served([[0.0, 10.0, 5.0], [0.0, 30.0, 5.0]], (kind, kind))
    laser = OPTICS.geometry.laser_mm + np.array([0.0, 10.0, 0.0])
    behind = laser + 1.06 * (one.places_mm[0] - laser)  # 8 mm further on the ray of the first place
    before = laser + 0.94 * (one.places_mm[0] - laser)
    on_it, aside = one.places_mm[1] + [0.0, 0.2, 0.1], behind + np.array([4.0, 0.0, 0.0])
    owner = owners_of(one, np.array([behind, before, on_it, aside]), OPTICS, 1.5 * CELL_MM)
    assert owner.tolist() == [0 if kind in HIDDEN_KINDS else -1, -1, 1, -1]


def test_what_was_promised_what_was_explored_and_what_was_found_besides_is_all_that_is_new():
    bench = Bench(step().surface).scan(FROM_ABOVE, -1.0, 41.0, 0.5)
    before = bench.judged()
    one = plan_passes(*before, free_reach(), OPTICS, Wishes(DENSITY, max_passes=1)).passes[0]
    bench.scan(one.motion, one.start_mm, one.end_mm, one.line_spacing_mm)
    outcome = reckon(one, *before, *bench.judged(), OPTICS)
    told = one.to_dict()
    assert outcome.promised_mm2 == pytest.approx(one.promised.mm2) == pytest.approx(told["promised_mm2"])
    assert outcome.promised_mm2 + outcome.expected_mm2 == pytest.approx(told["gain_mm2"])
    assert sum(region["gain_mm2"] for region in told["serves"]) == pytest.approx(told["gain_mm2"])
    by_region = {region["region"] or 0: region["gain_mm2"] for region in told["serves"]}
    assert all(region.promised_mm2 <= by_region[region.region] + 1e-9 for region in outcome.regions)
    assert list(outcome.promised_between_mm2) == told["promised_between_mm2"]
    assert Outcome.from_dict(outcome.to_dict()).to_dict() == outcome.to_dict()
    asked = sum(kind.asked_mm2 * FIRST_CHANCES[kind.evidence] for kind in outcome.kinds)
    assert asked == pytest.approx(one.gain_mm2)
    reached = outcome.reached_mm2 + outcome.found_mm2
    assert sum(kind.reached_mm2 for kind in outcome.kinds) == pytest.approx(reached)
    measured = next(kind for kind in outcome.kinds if kind.evidence is Evidence.MEASURED)
    assert measured.reached_mm2 == pytest.approx(measured.asked_mm2, rel=0.1)
    nothing = reckon(one, *before, *before, OPTICS)
    assert (nothing.reached_mm2, nothing.found_mm2, nothing.besides_mm2) == (0.0, 0.0, 0.0)
    assert len(nothing.missed_mm) == len(one.places_mm)
    assert len(nothing.empty_mm) == np.isin(one.place_evidence, HIDDEN_KINDS).sum()


def test_an_outcome_of_a_record_that_told_kinds_otherwise_is_read_and_teaches_nothing_of_them():
    now = Outcome((), np.zeros((1, 3))).to_dict()
    kept = now | {"kinds": [{"evidence": "frontier", "asked_mm2": 4.0, "kept_mm2": 3.0}], "missed_mm": [[1, 2, 3]]}
    for name in ("promised_between_mm2", "expected_between_mm2"):  # nobody told them then
        del kept[name]
    outcome = Outcome.from_dict(kept)
    assert outcome.promised_between_mm2 is None and outcome.to_dict()["expected_between_mm2"] is None
    assert outcome.kinds == () and outcome.missed_mm.tolist() == [[1.0, 2.0, 3.0]]
