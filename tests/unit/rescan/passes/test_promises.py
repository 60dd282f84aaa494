"""What of a pass may be promised: laws of its sums and intervals, and how often outcomes drawn by chance keep them."""

from pathlib import Path

import numpy as np
import pytest

from scanner_service.rescan.passes.experience import experience_of
from scanner_service.rescan.passes.needs import FIRST_CHANCES, Evidence
from scanner_service.rescan.passes.outcome import KindOutcome, Outcome
from scanner_service.rescan.passes.promises import (
    FIRST_BRINGS,
    FIRST_SPREADS,
    GRAINS_MM2,
    GUESSED_KINDS,
    NO_EXPERIENCE,
    PROMISED_WITHIN,
    Experience,
    expectation_of,
    promised_places,
)

BRINGS = np.array(FIRST_BRINGS)


def drawn(seed, scale_mm2=1.0):
    """Places of all kinds, some of them tried in vain: what is expected of each, its area, its kind, tried."""
    rng = np.random.default_rng(seed)
    kind = rng.choice(len(Evidence), size=rng.integers(1, 400), p=rng.dirichlet(np.ones(len(Evidence))))
    area = scale_mm2 * rng.uniform(0.05, 0.2, len(kind))
    tried = rng.random(len(kind)) < 0.1
    return area * BRINGS[kind] * np.where(tried, 0.25, 1.0), area, kind.astype(np.float64), tried


def only(places, mine):
    return tuple(one[mine] for one in places)


@pytest.mark.parametrize("seed", range(20))
def test_promised_and_explored_are_all_there_is_and_lie_within_their_intervals(seed):
    places = drawn(seed, scale_mm2=10.0 ** (seed % 3))
    mm2, area, kind, tried = places
    promised = promised_places(*places, NO_EXPERIENCE)
    told = [expectation_of(*only(places, mine), NO_EXPERIENCE) for mine in (promised, ~promised)]
    assert sum(one.mm2 for one in told) == pytest.approx(mm2.sum())
    assert all(0.0 <= one.low_mm2 <= one.mm2 <= one.high_mm2 for one in told)
    assert not promised[tried].any()
    sure = told[0]
    assert sure.high_mm2 - sure.mm2 <= PROMISED_WITHIN * sure.mm2 + 1e-9 >= sure.mm2 - sure.low_mm2
    known = ~np.isin(kind, GUESSED_KINDS)  # what has been seen cannot be more than its area
    of_known = expectation_of(*only(places, known), NO_EXPERIENCE)
    assert of_known.high_mm2 <= area[known].sum() + 1e-9
    assert (mm2[known] <= area[known]).all()


@pytest.mark.parametrize("seed", range(10))
def test_each_kind_is_promised_as_a_whole_and_for_its_own_sake_and_guesses_alone_are_not(seed):
    places = drawn(seed, scale_mm2=10.0)
    kind, tried = places[2:]
    promised = promised_places(*places, NO_EXPERIENCE)
    guessed = np.isin(kind, GUESSED_KINDS)
    assert not promised_places(*only(places, guessed), NO_EXPERIENCE).any()
    for mine in (guessed, tried, guessed | tried):  # what nobody has seen, or passes looked for in vain, may be nothing
        assert expectation_of(*only(places, mine), NO_EXPERIENCE).low_mm2 == 0.0
    many = tuple(np.append(one, more) for one, more in zip(places, (50.0, 50.0, Evidence.MEASURED, False), strict=True))
    many = (*many[:3], many[3].astype(bool))
    with_more = promised_places(*many, NO_EXPERIENCE)
    assert with_more[-1] and with_more[:-1][promised].all()
    for one in Evidence:
        mine = (many[2] == one) & ~many[3]
        if mine.any():
            assert with_more[mine].all() or not with_more[mine].any()
            surely = mine | (np.arange(len(mine)) == len(mine) - 1)  # whatever else there is, but for something known
            assert promised_places(*only(many, surely), NO_EXPERIENCE)[mine[surely]].all() == with_more[mine].all()


def test_a_few_square_millimetres_of_hidden_space_are_explored_and_many_are_promised():
    def is_promised(kind, mm2, learned=NO_EXPERIENCE, tried=False):
        """Beside measured surface."""
        one = np.array([20.0, mm2])
        kinds = np.array([float(Evidence.MEASURED), float(kind)])
        return bool(promised_places(one, one, kinds, np.array([False, tried]), learned)[1])

    assert is_promised(Evidence.MEASURED, 1.0) and is_promised(Evidence.FRONTIER, 100.0)
    assert not is_promised(Evidence.FRONTIER, 10.0) and not is_promised(Evidence.REST, 1000.0)
    assert is_promised(Evidence.FLOOR, 100.0) and not is_promised(Evidence.FLOOR, 3.0)
    assert not is_promised(Evidence.MEASURED, 100.0, tried=True)
    kinds = np.array([0.0, 1.0, 1.0]), np.zeros(3, dtype=bool)
    one_place = np.array([20.0, 25.0, 0.0]), np.array([20.0, 100.0, 1.0]), *kinds  # it is there or not
    assert promised_places(*one_place, NO_EXPERIENCE).tolist() == [True, False, False]
    sure = Experience(spreads=(0.1,) * len(Evidence))  # on this part rests prove as foretold
    assert is_promised(Evidence.REST, 1000.0, sure) and not is_promised(Evidence.REST, 1.0, sure)
    nothing = np.zeros(0)
    assert expectation_of(nothing, nothing, nothing, nothing.astype(bool), NO_EXPERIENCE).between_mm2 == [0.0, 0.0]


def test_four_of_five_outcomes_of_such_a_world_lie_within_the_interval_and_the_median_is_near():
    """The oracle: each kind's pass brings what a gamma variable of the stated spread says, in pieces by Poisson.

    Of a place that has been seen it brings no more than its area.
    """
    rng = np.random.default_rng(5)
    within, errors, explored = [], [], []
    for seed in range(400):
        mm2, area, kind, tried = drawn(seed, scale_mm2=10.0)
        places = mm2, area, kind, np.zeros(len(tried), dtype=bool)
        came = np.zeros(len(mm2))
        for one in Evidence:
            mine = kind == one
            if mine.any():
                shape = 1.0 / FIRST_SPREADS[one] ** 2
                factor = rng.gamma(shape, 1.0 / shape)
                pieces = rng.poisson(factor * mm2[mine].sum() / GRAINS_MM2[one])
                all_there_is = np.inf if one in GUESSED_KINDS else max(area[mine].sum(), mm2[mine].sum())
                came[np.flatnonzero(mine)[0]] = min(pieces * GRAINS_MM2[one], all_there_is)
        promised = promised_places(*places, NO_EXPERIENCE)
        for mine, hits in ((promised, within), (~promised, explored)):
            told = expectation_of(*only(places, mine), NO_EXPERIENCE)
            if told.mm2 >= 1.0:
                hits.append(told.low_mm2 - 1e-9 <= came[mine].sum() <= told.high_mm2 + 1e-9)
                if mine is promised:
                    errors.append(abs(came[mine].sum() / told.mm2 - 1.0))
    assert 0.72 < np.mean(within) < 0.92 and 0.75 < np.mean(explored) < 0.97
    assert np.median(errors) < 0.15


def test_a_session_in_which_passes_are_further_off_tells_wider_intervals():
    """A part on which a kind varies twice as much as at first: intervals are too narrow, and then less so."""
    rng = np.random.default_rng(8)
    first, last = [], []
    for _ in range(60):
        earlier = []
        for number in range(14):
            learned = experience_of(earlier)
            asked = rng.uniform(800.0, 4000.0)
            shape = 1.0 / (2.0 * FIRST_SPREADS[Evidence.FAR]) ** 2
            came = asked * FIRST_BRINGS[Evidence.FAR] * rng.gamma(shape, 1.0 / shape)
            place = np.array([asked * learned.brings[Evidence.FAR]])
            many = np.repeat(place / 200.0, 200), np.full(200, asked / 200.0), np.full(200, float(Evidence.FAR))
            measured = np.full(1, 2.0), np.full(1, 2.0), np.zeros(1)
            mm2, area, kind = (np.concatenate(pair) for pair in zip(many, measured, strict=True))
            told = expectation_of(mm2, area, kind, np.zeros(len(mm2), dtype=bool), learned)
            (first if number == 0 else last if number > 6 else []).append(told.low_mm2 <= came + 2.0 <= told.high_mm2)
            earlier.append(became(asked, came, Evidence.FAR))
    assert np.mean(first) < 0.6 and np.mean(first) + 0.1 < np.mean(last) < 0.9


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


def test_what_is_told_is_learned_beside_what_is_counted_on():
    learned = experience_of([became(30.0, 30.0 * FIRST_BRINGS[Evidence.REST], Evidence.REST)] * 6)
    assert learned.brings[Evidence.REST] > learned.chances[Evidence.REST] > FIRST_CHANCES[Evidence.REST]
    others = [one for one in Evidence if one is not Evidence.REST]
    assert [learned.brings[one] for one in others] == pytest.approx([FIRST_BRINGS[one] for one in others])
    counted, kinds = np.ones(len(Evidence)), np.array([float(one) for one in Evidence])
    assert learned.told_mm2(counted, kinds) == pytest.approx(np.array(learned.brings) / np.array(learned.chances))
    of_measured = experience_of([became(100.0, 130.0, Evidence.MEASURED)] * 9).brings[Evidence.MEASURED]
    assert FIRST_BRINGS[Evidence.MEASURED] < of_measured <= 1.0  # it is no more than its area


def test_a_kind_that_brings_now_much_now_nothing_is_believed_in_less_surely_than_one_that_does_not():
    def spread(*ratios, kind=Evidence.FAR, asked_mm2=300.0):
        return experience_of([became(asked_mm2, asked_mm2 * ratio, kind) for ratio in ratios]).spreads[kind]

    first, brings = FIRST_SPREADS[Evidence.FAR], FIRST_BRINGS[Evidence.FAR]
    assert spread(*[brings] * 4) < first < spread(0.0, 2.5, 0.1, 1.9)
    assert spread(*[brings] * 12) < spread(brings, brings) < first
    assert spread(0.0, asked_mm2=0.3) == pytest.approx(first, rel=0.05)  # a piece was not there: that was foretold
    once = spread(30.0)  # a pass that nobody can account for makes intervals wide, and not endless
    assert first < once == pytest.approx(spread(300.0), rel=0.15) and once < 2.0 * first
    assert experience_of([became(0.0, 0.0)]).spreads == pytest.approx(FIRST_SPREADS)


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
        first = (FIRST_CHANCES[kind], FIRST_BRINGS[kind], 100.0 * FIRST_SPREADS[kind], GRAINS_MM2[kind])
        assert told == pytest.approx(first)
