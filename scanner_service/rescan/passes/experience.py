"""What the passes of a session teach about promises: how often a place is what it seems, and how much lies there."""

from collections.abc import Sequence

import numpy as np

from scanner_service.rescan.passes.needs import FIRST_CHANCES, Chances, Evidence
from scanner_service.rescan.passes.outcome import Outcome

_BELIEF_MM2 = 40.0  # the first chances weigh as much as this area
_FADING = 0.6  # what a pass taught of a kind weighs this much less after each further one that had places of it
_CHANCE = (0.05, 2.0)  # above 1 where more lies behind the border of hidden space than the border has area


def chances_of(earlier: Sequence[Outcome]) -> Chances:
    """How likely a place of each kind of evidence is what it seems, after some passes, the oldest first.

    The share of the area asked for that was good afterwards, the recent passes first, and the first chances as if an
    area had shown them.
    """
    asked = np.full(len(Evidence), _BELIEF_MM2)
    kept = _BELIEF_MM2 * np.array(FIRST_CHANCES)
    weight = np.ones(len(Evidence))
    for outcome in reversed(earlier):
        for one in outcome.kinds:
            asked[one.evidence] += weight[one.evidence] * one.asked_mm2
            kept[one.evidence] += weight[one.evidence] * one.reached_mm2
            weight[one.evidence] *= _FADING
    return tuple(np.clip(kept / asked, *_CHANCE).tolist())
