"""What the passes of a session teach about promises: how often a place is what it seems, and how much lies there."""

from collections.abc import Sequence

import numpy as np

from scanner_service.rescan.passes.needs import FIRST_CHANCES, Chances, Evidence
from scanner_service.rescan.passes.outcome import Outcome

_BELIEF_MM2 = 40.0  # the first chances weigh as much as this area
_FADING = 0.6  # what a pass taught of a kind weighs this much less after each further one that had places of it
_RECENT = 3
_TRUST = (0.6, 1.6)
_LEAST_MM2 = 10.0  # less surface than this says little
_CHANCE = (0.05, 1.6)  # above 1 where edges of hidden space proved better than they are counted


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
            kept[one.evidence] += weight[one.evidence] * one.kept_mm2
            weight[one.evidence] *= _FADING
    return tuple(np.clip(kept / asked, *_CHANCE).tolist())


def trust_of(earlier: Sequence[Outcome]) -> float:
    """How much good surface there is for each mm² of places that were there as foretold.

    The median of the last few passes, so that one pass in vain does not spoil it, within bounds.
    """
    ratios = [one.reached_mm2 / one.kept_mm2 for one in earlier if one.kept_mm2 > _LEAST_MM2]
    return float(np.clip(np.median(ratios[-_RECENT:]), *_TRUST)) if ratios else 1.0
