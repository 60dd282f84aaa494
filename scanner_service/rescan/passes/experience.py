"""What the passes of a session teach about promises: how much good surface each kind of evidence brings, how surely."""

import math
from collections.abc import Sequence

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.rescan.passes.needs import FIRST_CHANCES, HIDDEN_KINDS, Evidence
from scanner_service.rescan.passes.outcome import Outcome
from scanner_service.rescan.passes.promises import FIRST_SPREADS, GRAINS_MM2, Experience

_FADING = 0.9  # what a pass taught of a kind weighs this much less after each further one that had places of it
_FIRST_MM2 = 40.0  # the first chance weighs as much as a pass that asked for so much
_ENOUGH_MM2 = 50.0  # a pass that asked for so much counts half of that, and none counts as more than this
_HALF_MM2 = 20.0  # of how a kind varies a pass that asked for so much tells half as much as a very large one ...
_FIRST_PASSES = 3.0  # ... of which the first spread weighs as many
_LEAST = 0.05  # nothing is ruled out for good
_WORN_PASSES = 10.0  # what is left of hidden space when so many passes have looked is surface 1/e as often ...
_WORN_OUT = 0.4  # ... but is looked at, so that a loop does not end before it was


def experience_of(earlier: Sequence[Outcome]) -> Experience:
    """What a mm² of each kind of evidence brings, and how much that varies, after some passes, the oldest first.

    The mean of what was reached for what was asked for, in which one large pass over a side that is unlike the others
    does not decide; of a place that is known no more than its area. The spread is that of the passes around the mean,
    less what small areas vary anyway. What is left of hidden space where passes looked in vain is the less likely
    surface the more passes there were.
    """
    worn = _worn(len(earlier))
    asked = np.full(len(Evidence), _FIRST_MM2)
    reached = asked * np.array(FIRST_CHANCES) * worn
    faded = np.ones(len(Evidence))
    passes: list[list[tuple[float, float, float]]] = [[] for _ in Evidence]
    for number in reversed(range(len(earlier))):
        for one in earlier[number].kinds:
            if one.asked_mm2 > 0:
                asked_mm2 = one.asked_mm2 * (_worn(number)[one.evidence] / worn[one.evidence])
                counts = faded[one.evidence] / (1.0 + one.asked_mm2 / _ENOUGH_MM2)
                asked[one.evidence] += counts * asked_mm2
                reached[one.evidence] += counts * one.reached_mm2
                tells = faded[one.evidence] * one.asked_mm2 / (one.asked_mm2 + _HALF_MM2)
                passes[one.evidence].append((tells, one.reached_mm2 / asked_mm2, one.asked_mm2))
                faded[one.evidence] *= _FADING
    chances = np.maximum(reached / asked, _LEAST)
    known = [kind for kind in Evidence if kind not in HIDDEN_KINDS]
    chances[known] = np.minimum(chances[known], 1.0)
    spreads = []
    for kind in Evidence:
        first = FIRST_SPREADS[kind]
        square, weight = _FIRST_PASSES, _FIRST_PASSES
        for tells, ratio, asked_mm2 in passes[kind]:
            square += tells * max((ratio / chances[kind] - 1.0) ** 2 - GRAINS_MM2[kind] / asked_mm2, 0.0) / first**2
            weight += tells
        spreads.append(first * math.sqrt(square / weight))
    return Experience(tuple(chances.tolist()), tuple(spreads))


def _worn(passes: int) -> Float64Array:
    """By `Evidence`, how much less it brings after some passes than at first."""
    worn = np.ones(len(Evidence))
    worn[Evidence.REST] = max(math.exp(-passes / _WORN_PASSES), _WORN_OUT)
    return worn
