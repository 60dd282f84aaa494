"""What of a pass may be promised: laws of its sums and intervals, and how often outcomes drawn by chance keep them."""

from pathlib import Path

import numpy as np
import pytest

from scanner_service.rescan.passes.experience import experience_of
from scanner_service.rescan.passes.needs import FIRST_CHANCES, HIDDEN_KINDS, Evidence
from scanner_service.rescan.passes.outcome import KindOutcome, Outcome
from scanner_service.rescan.passes.promises import (
    FIRST_SPREADS,
    GRAINS_MM2,
    NO_EXPERIENCE,
    PROMISED_WITHIN,
    Experience,
    expectation_of,
    promised_places,
)

CHANCES = np.array(FIRST_CHANCES)


def drawn(seed, scale_mm2=1.0):
    """Places of all kinds, some of them tried in vain: what is expected of each, its area, its kind, tried."""
    rng = np.random.default_rng(seed)
    kind = rng.choice(len(Evidence), size=rng.integers(1, 400), p=rng.dirichlet(np.ones(len(Evidence))))
    area = scale_mm2 * rng.uniform(0.05, 0.2, len(kind))
    tried = rng.random(len(kind)) < 0.1
    return area * CHANCES[kind] * np.where(tried, 0.25, 1.0), area, kind.astype(np.float64), tried


@pytest.mark.parametrize("seed", range(20))
def test_promised_and_explored_are_all_there_is_and_lie_within_their_intervals(seed):
    places = drawn(seed, scale_mm2=10.0 ** (seed % 3))
    mm2, area, kind, tried = places
    promised = promised_places(*places, NO_EXPERIENCE)
    told = [expectation_of(*(one[mine] for one in places), NO_EXPERIENCE) for mine in (promised, ~promised)]
    assert sum(one.mm2 for one in told) == pytest.approx(mm2.sum())
    assert all(0.0 <= one.low_mm2 <= one.mm2 <= one.high_mm2 for one in told)
    assert not promised[tried].any()
    sure = told[0]
    assert sure.high_mm2 - sure.mm2 <= PROMISED_WITHIN * sure.mm2 + 1e-9 >= sure.mm2 - sure.low_mm2
    known = ~np.isin(kind, HIDDEN_KINDS)  # where the place is known it cannot be more than its area
    of_known = expectation_of(*(one[known] for one in places), NO_EXPERIENCE)
    assert of_known.high_mm2 <= area[known].sum() + 1e-9
    assert (mm2[known] <= area[known]).all()


@pytest.mark.parametrize("seed", range(10))
def test_the_surer_kinds_are_promised_first_and_more_of_them_makes_a_promise_no_smaller(seed):
    places = drawn(seed, scale_mm2=10.0)
    mm2, area, kind, tried = places
    promised = promised_places(*places, NO_EXPERIENCE)

    def share(one):
        mine = (kind == one) & ~tried
        told = expectation_of(*(column[mine] for column in places), NO_EXPERIENCE)
        return (told.mm2 - told.low_mm2) / told.mm2

    present = [one for one in Evidence if ((kind == one) & ~tried).any()]
    told = [one for one in present if promised[(kind == one) & ~tried].any()]
    left = [one for one in present if one not in told and FIRST_SPREADS[one] <= PROMISED_WITHIN]
    assert all(FIRST_SPREADS[one] <= PROMISED_WITHIN for one in told)  # such a kind is explored, however sure the rest
    assert all(promised[(kind == one) & ~tried].all() for one in told)  # a kind as a whole, or not
    assert max(map(share, told), default=0.0) <= min(map(share, left), default=np.inf)
    more = np.append(mm2, 50.0), np.append(area, 50.0), np.append(kind, float(Evidence.MEASURED)), np.append(tried, 0)
    more = (*more[:3], more[3].astype(bool))
    with_more = promised_places(*more, NO_EXPERIENCE)
    assert with_more[-1] and with_more[:-1][promised].all()


def test_a_few_square_millimetres_of_hidden_space_are_explored_and_many_are_promised():
    def is_promised(kind, mm2, learned=NO_EXPERIENCE, tried=False):
        one = np.array([mm2])
        return bool(promised_places(one, one, np.array([float(kind)]), np.array([tried]), learned)[0])

    assert is_promised(Evidence.MEASURED, 1.0) and is_promised(Evidence.FRONTIER, 100.0)
    assert not is_promised(Evidence.FRONTIER, 3.0) and not is_promised(Evidence.REST, 1000.0)
    assert not is_promised(Evidence.MEASURED, 100.0, tried=True)
    assert not promised_places(np.array([500.0, 50.0]), np.array([500.0, 50.0]), np.array([0.0, 6.0]),
                               np.zeros(2, dtype=bool), NO_EXPERIENCE)[1]  # fmt: skip
    floor = np.full(2, float(Evidence.FLOOR)), np.zeros(2, dtype=bool)
    one_place = np.array([25.0, 0.0]), np.array([100.0, 1.0]), *floor  # it is there or not
    assert not promised_places(*one_place, NO_EXPERIENCE).any()
    many = tuple(np.repeat(column, 50) for column in (np.ones(2), np.full(2, 4.0), *floor))
    assert promised_places(*many, NO_EXPERIENCE).all()
    sure = Experience(spreads=(0.1,) * len(Evidence))  # on this part rests prove as foretold
    assert is_promised(Evidence.REST, 1000.0, sure)
    nothing = np.zeros(0)
    assert expectation_of(nothing, nothing, nothing, nothing.astype(bool), NO_EXPERIENCE).between_mm2 == [0.0, 0.0]


def test_four_of_five_outcomes_of_such_a_world_lie_within_the_interval_and_the_median_is_near():
    """The oracle: each kind's pass brings what a gamma variable of the stated spread says, in pieces by Poisson.

    Of a place that is known it brings no more than its area.
    """
    rng = np.random.default_rng(5)
    within, errors, explored = [], [], []
    for seed in range(400):
        places = drawn(seed, scale_mm2=10.0)
        mm2, area, kind, _ = places
        came = np.zeros(len(mm2))
        for one in Evidence:
            mine = kind == one
            if mine.any():
                shape = 1.0 / FIRST_SPREADS[one] ** 2
                factor = rng.gamma(shape, 1.0 / shape)
                pieces = rng.poisson(factor * mm2[mine].sum() / (FIRST_CHANCES[one] * GRAINS_MM2[one]))
                all_there_is = np.inf if one in HIDDEN_KINDS else max(area[mine].sum(), mm2[mine].sum())
                came[np.flatnonzero(mine)[0]] = min(pieces * FIRST_CHANCES[one] * GRAINS_MM2[one], all_there_is)
        untried = tuple(np.zeros(len(mm2), dtype=bool) if one.dtype == bool else one for one in places)
        promised = promised_places(*untried, NO_EXPERIENCE)
        for mine, hits in ((promised, within), (~promised, explored)):
            told = expectation_of(*(one[mine] for one in untried), NO_EXPERIENCE)
            if told.mm2 >= 1.0:
                hits.append(told.low_mm2 - 1e-9 <= came[mine].sum() <= told.high_mm2 + 1e-9)
                if mine is promised:
                    errors.append(abs(came[mine].sum() / told.mm2 - 1.0))
    assert 0.72 < np.mean(within) < 0.92 and 0.7 < np.mean(explored) < 0.95
    assert np.median(errors) < 0.2


def became(asked_mm2, reached_mm2, kind=Evidence.FRONTIER):
    return Outcome((), np.zeros((0, 3)), (KindOutcome(kind, asked_mm2, reached_mm2),))


def test_each_kind_of_evidence_is_believed_as_far_as_it_proved_true():
    assert experience_of([]) == NO_EXPERIENCE

    def chance(*outcomes):
        return experience_of(outcomes).chances[Evidence.FRONTIER]

    first = FIRST_CHANCES[Evidence.FRONTIER]
    learned = experience_of([became(400.0, 40.0)]).chances
    assert learned[Evidence.FRONTIER] < 0.7 * first
    assert learned[Evidence.MEASURED] == FIRST_CHANCES[Evidence.MEASURED]
    ratios = [chance(*[became(400.0, 800.0)] * n) for n in range(12)]
    assert np.all(np.diff(ratios) > 0) and ratios[-1] == pytest.approx(2.0, rel=0.12)  # what comes again is learned
    assert 1.1 < chance(*[became(50.0, 55.0)] * 4, became(1e4, 3e4)) < 1.7  # one large pass does not decide
    assert chance(became(0.5, 0.0)) > 0.9 * first  # too small to learn from
    beyond = became(400.0, 0.0, Evidence.BEYOND)
    later = [became(100.0, 100.0)] * 5  # passes that had no such places teach nothing of them
    assert experience_of([beyond, *later]).chances[Evidence.BEYOND] == experience_of([beyond]).chances[Evidence.BEYOND]
    assert chance(*[became(1e6, 0.0)] * 50) > 0.04  # nothing is ruled out for good
    floor = experience_of([became(100.0, 400.0, Evidence.FLOOR)] * 9)
    assert floor.chances[Evidence.FLOOR] == 1.0  # a place that is known is no more than its area


def test_a_kind_that_brings_now_much_now_nothing_is_believed_in_less_surely_than_one_that_does_not():
    def spread(*ratios, kind=Evidence.FAR, asked_mm2=300.0):
        return experience_of([became(asked_mm2, asked_mm2 * ratio, kind) for ratio in ratios]).spreads[kind]

    first = FIRST_SPREADS[Evidence.FAR]
    assert spread(1.0, 1.0, 1.0, 1.0) < first < spread(0.0, 2.5, 0.1, 1.9)
    assert spread(*[1.0] * 12) < spread(1.0, 1.0) < first
    assert spread(0.0, asked_mm2=0.3) == pytest.approx(first, rel=0.05)  # a piece was not there: that was foretold
    assert experience_of([became(0.0, 0.0)]).spreads == FIRST_SPREADS


def test_the_more_passes_have_looked_the_less_is_expected_of_what_is_left_and_of_nothing_else():
    def rest(*outcomes):
        return experience_of(outcomes).chances[Evidence.REST]

    idle = became(0.0, 0.0)
    chances = np.array([rest(*[idle] * n) for n in range(17)])
    assert chances == pytest.approx(FIRST_CHANCES[Evidence.REST] * np.maximum(np.exp(-np.arange(17) / 10.0), 0.4))
    others = [one for one in Evidence if one is not Evidence.REST]
    assert [experience_of([idle] * 9).chances[one] for one in others] == [FIRST_CHANCES[one] for one in others]
    as_foretold = became(50.0, 50.0 * rest(idle), Evidence.REST)
    assert rest(idle, as_foretold) == pytest.approx(rest(idle, idle))  # what came as foretold changes nothing
    assert rest(idle, became(50.0, 0.0, Evidence.REST)) < rest(idle, idle) < rest(idle, became(50, 500, Evidence.REST))


def test_the_page_says_with_what_numbers_a_session_begins():
    page = (Path(__file__).resolve().parents[4] / "docs" / "passes.md").read_text(encoding="utf-8")
    for kind in Evidence:
        row = next(line for line in page.splitlines() if line.startswith(f"| `{kind.name.lower()}`:"))
        told = [float(column.split()[0]) for column in row.strip("| ").split("|")[1:]]
        assert told == pytest.approx([FIRST_CHANCES[kind], 100.0 * FIRST_SPREADS[kind], GRAINS_MM2[kind]])
