"""What the passes of a session teach about promises: how much good surface each kind of evidence brings, how surely."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.rescan.passes.needs import FIRST_CHANCES, HIDDEN_KINDS, Chances, Evidence
from scanner_service.rescan.passes.outcome import KindOutcome, Outcome
from scanner_service.rescan.passes.promises import (
    FIRST_BRINGS,
    FIRST_SPREADS,
    GUESSED_KINDS,
    NO_EXPERIENCE,
    Experience,
)

_FADING = 0.9  # what a pass taught of a kind weighs this much less after each further one that had places of it
_FIRST_MM2 = 40.0  # the first chance weighs as much as a pass that asked for so much
_FIRST_TOLD_MM2 = 20.0  # ... and what is told at first as one that asked for so much
_ENOUGH_MM2 = 50.0  # a pass that asked for so much counts half of that, and none counts as more than this
_FIRST_PASSES = 3.0  # the first spread weighs as many passes
_HALF_MM2 = 2.0  # of how a kind varies a pass that expected so much tells half as much as a large one ...
_FURTHEST = 3.0  # ... and a pass that was further off than so many deviations no more than that
_LEAST = 0.05  # nothing is ruled out for good
_WORN_PASSES = 10.0  # what is left of hidden space when so many passes have looked is surface 1/e as often ...
_WORN_OUT = 0.4  # ... but is looked at, so that a loop does not end before it was


def experience_of(earlier: Sequence[Outcome]) -> Experience:
    """What a mm² of each kind of evidence brings, and how much that varies, after some passes, the oldest first.

    The spread is the first one, times how far the passes were from the mean beside how far they should have been, small
    areas further than large ones.
    """
    chances = _means(earlier, FIRST_CHANCES, _FIRST_MM2, HIDDEN_KINDS)
    brings = _means(earlier, FIRST_BRINGS, _FIRST_TOLD_MM2, GUESSED_KINDS)
    weight = np.full(len(Evidence), _FIRST_PASSES)
    square = weight.copy()
    for one, counts, asked_mm2 in _passes(earlier):
        kind, foretold_mm2 = one.evidence, float(brings[one.evidence]) * asked_mm2
        off = (one.reached_mm2 - foretold_mm2) / NO_EXPERIENCE.deviation_mm2(kind, foretold_mm2)
        tells = counts * foretold_mm2 / (foretold_mm2 + _HALF_MM2)
        square[kind] += tells * min(off**2, _FURTHEST**2)
        weight[kind] += tells
    spreads = np.array(FIRST_SPREADS) * np.sqrt(square / weight)
    return Experience(tuple(chances.tolist()), tuple(spreads.tolist()), tuple(brings.tolist()))


def _means(earlier: Sequence[Outcome], first: Chances, first_mm2: float, unbounded: Sequence[Evidence]) -> Float64Array:
    """By `Evidence`, the mean of what was reached for what was asked for.

    One large pass over a side that is unlike the others does not decide; a place that is known brings no more than its
    area. What is left of hidden space where passes looked in vain is surface the less often the more passes there were.
    """
    begun_with = np.array(first) * _worn(len(earlier))
    asked, more = np.full(len(Evidence), first_mm2), np.zeros(len(Evidence))
    for one, counts, asked_mm2 in _passes(earlier):
        less = counts / (1.0 + one.asked_mm2 / _ENOUGH_MM2)
        asked[one.evidence] += less * asked_mm2
        more[one.evidence] += less * (one.reached_mm2 - begun_with[one.evidence] * asked_mm2)
    means: Float64Array = np.maximum(begun_with + more / asked, _LEAST)
    known = [kind for kind in Evidence if kind not in unbounded]
    means[known] = np.minimum(means[known], 1.0)
    return means


def _passes(earlier: Sequence[Outcome]) -> Iterator[tuple[KindOutcome, float, float]]:
    """What became of each kind in each pass, how much that counts, and what was asked for as it would be now."""
    faded, worn = np.ones(len(Evidence)), _worn(len(earlier))
    for number in reversed(range(len(earlier))):
        for one in earlier[number].kinds:
            if one.asked_mm2 > 0:
                asked_mm2 = one.asked_mm2 * float(_worn(number)[one.evidence] / worn[one.evidence])
                yield one, float(faded[one.evidence]), asked_mm2
                faded[one.evidence] *= _FADING


def _worn(passes: int) -> Float64Array:
    """By `Evidence`, how much less it brings after some passes than at first."""
    worn = np.ones(len(Evidence))
    worn[Evidence.REST] = max(math.exp(-passes / _WORN_PASSES), _WORN_OUT)
    return worn
