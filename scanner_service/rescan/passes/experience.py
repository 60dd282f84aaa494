"""What the passes of a session teach about promises: how much good surface a mm² of each kind of evidence brings."""

import math
from collections.abc import Sequence

import numpy as np

from scanner_service.rescan.passes.needs import FIRST_CHANCES, Chances, Evidence
from scanner_service.rescan.passes.outcome import Outcome

_FADING = 0.9  # what a pass taught of a kind weighs this much less after each further one that had places of it
_HALF_MM2 = (
    20.0  # a pass that asked for so much counts half as much as a very large one; the first chance counts as that
)
_RATIO = (0.1, 3.0)  # one pass says no more than this


def chances_of(earlier: Sequence[Outcome]) -> Chances:
    """How much good surface a mm² of each kind of evidence brings, after some passes, the oldest first.

    The geometric mean of what was reached for what was asked for, pass by pass, and of the first chance: one large pass
    over a side that is unlike the others must not decide.
    """
    weight = np.ones(len(Evidence))
    logarithm = np.log(FIRST_CHANCES)
    faded = np.ones(len(Evidence))
    for outcome in reversed(earlier):
        for one in outcome.kinds:
            if one.asked_mm2 > 0:
                counts = faded[one.evidence] * one.asked_mm2 / (one.asked_mm2 + _HALF_MM2)
                ratio = min(max(one.reached_mm2 / one.asked_mm2, _RATIO[0]), _RATIO[1])
                weight[one.evidence] += counts
                logarithm[one.evidence] += counts * math.log(ratio)
                faded[one.evidence] *= _FADING
    return tuple(np.exp(logarithm / weight).tolist())
