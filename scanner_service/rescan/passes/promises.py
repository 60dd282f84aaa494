"""What of a pass may be promised: how much each kind of evidence brings, how surely, and what is said of a pass.

Knows numbers by kind of evidence, no place, no surface and no rig.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import special

from drivers.scanline import BoolArray, Float64Array
from scanner_service.rescan.passes.needs import FIRST_CHANCES, Chances, Evidence

GUESSED_KINDS = (Evidence.FLOOR, Evidence.FRONTIER, Evidence.BEYOND, Evidence.FAR, Evidence.REST)
"""Nobody has seen this surface: it may not be there, or be more than was asked for."""

Spreads = tuple[float, ...]
"""How far what a large pass brings of each kind lies from what was expected, by `Evidence`, as a share of that."""
FIRST_BRINGS: Chances = (0.98, 1.0, 1.2, 0.9, 4.0, 1.5, 5.0)
"""Good surface for each mm² that is asked for, as passes brought it, before one of the session has shown it.

Passes are chosen by `needs.FIRST_CHANCES`, which count on less where hidden space may be empty: by the mean of what
comes they would be chosen for the most hidden space, which brings less than the mean."""
FIRST_SPREADS: Spreads = (0.05, 0.3, 0.16, 0.2, 0.7, 0.18, 0.6)
"""... before a pass has shown it."""
GRAINS_MM2: tuple[float, ...] = (0.08, 2.0, 6.5, 0.5, 32.0, 5.5, 16.0)
"""Surface comes in pieces of about this size, by `Evidence`: who asks for less may find all or nothing."""
_IN_VAIN = 1.0  # so much less sure is a place that a pass was in vain for
_TAILS = (0.1, 0.9)
PROMISED_WITHIN = 0.5
"""A kind is promised where it comes four times in five within this share of what is expected; else it is explored."""


@dataclass(frozen=True, slots=True)
class Experience:
    """What passes teach, by `Evidence`.

    `chances` is what is counted on for each mm² asked for when passes are chosen, `brings` what is expected to come,
    and `spreads` how much that varies.
    """

    chances: Chances = FIRST_CHANCES
    spreads: Spreads = FIRST_SPREADS
    brings: Chances = FIRST_BRINGS

    def told_mm2(self, counted_mm2: Float64Array, evidence: Float64Array) -> Float64Array:
        """(k,) what is expected of places of which so much (k,) was counted on, of kinds `evidence` (k,)."""
        more: Float64Array = np.array(self.brings) / np.array(self.chances)
        return counted_mm2 * more[evidence.astype(np.int64)]

    def deviation_mm2(self, kind: Evidence, mm2: float) -> float:
        """How far what such places bring lies from the `mm2` that are expected of them, one standard deviation.

        In a session whose passes are further off, the pieces are larger, too.
        """
        off = self.spreads[kind] / FIRST_SPREADS[kind]
        return math.hypot(self.spreads[kind] * mm2, off * math.sqrt(GRAINS_MM2[kind] * mm2))


NO_EXPERIENCE = Experience()
"""Before the first pass."""


@dataclass(frozen=True, slots=True)
class Expectation:
    """Area that a pass is to bring, and between what it lies four times in five."""

    mm2: float
    low_mm2: float
    high_mm2: float

    @property
    def between_mm2(self) -> list[float]:
        """The interval, for JSON."""
        return [self.low_mm2, self.high_mm2]


@dataclass(frozen=True, slots=True)
class _Lot:
    """The places of a pass of one kind, those that a pass was in vain for apart.

    `most_mm2` is all they can bring, inf where nobody has seen them; `stands_alone`: what they bring has nothing to do
    with what other kinds do.
    """

    mine: BoolArray
    stands_alone: bool
    mm2: float
    most_mm2: float
    deviation_mm2: float

    @property
    def is_firm(self) -> bool:
        """Whether it may be promised."""
        off_mm2 = max(self.mm2 - self.quantile_mm2(_TAILS[0]), self.quantile_mm2(_TAILS[1]) - self.mm2)
        return self.stands_alone and off_mm2 <= PROMISED_WITHIN * self.mm2

    @property
    def is_known(self) -> bool:
        """Whether it may be promised, and its surface has been seen."""
        return self.is_firm and math.isfinite(self.most_mm2)

    def quantile_mm2(self, share: float) -> float:
        """What it brings less than in this `share` of all cases.

        What is guessed is a gamma variable, skewed as it comes: of a few mm² often nothing, and at times a side of the
        part. What is known lies evenly around what is expected, and ends with its area.
        """
        if math.isinf(self.most_mm2):
            scale = self.deviation_mm2**2 / self.mm2
            return scale * float(special.gammaincinv(self.mm2 / scale, share)) if scale > 0.0 else self.mm2
        return min(max(self.mm2 + float(special.ndtri(share)) * self.deviation_mm2, 0.0), self.most_mm2)


def promised_places(
    mm2: Float64Array, area_mm2: Float64Array, evidence: Float64Array, tried: BoolArray, learned: Experience
) -> BoolArray:
    """(k,) which places a pass promises; the others it explores.

    Kind by kind, where what comes is within `PROMISED_WITHIN`. What a pass was in vain for is never promised, and
    neither are guesses alone.

    Parameters
    ----------
    mm2, area_mm2 : what is expected of each place, and its area.
    evidence : why each is believed in (`Evidence`).
    tried : where passes were in vain.
    """
    lots = _lots(mm2, area_mm2, evidence, tried, learned)
    promised = np.zeros(len(mm2), dtype=np.bool_)
    if any(lot.is_known for lot in lots):
        for lot in lots:
            promised |= lot.mine & lot.is_firm
    return promised


def expectation_of(
    mm2: Float64Array, area_mm2: Float64Array, evidence: Float64Array, tried: BoolArray, learned: Experience
) -> Expectation:
    """What places bring together; arguments as those of `promised_places`.

    Each place is there or not, and each kind as a whole brings more or less than was foretold. Where none of them is
    known for sure there may be nothing: then the interval begins at 0.
    """
    lots = _lots(mm2, area_mm2, evidence, tried, learned)
    total = sum(lot.mm2 for lot in lots)
    off = []
    for share, sign in zip(_TAILS, (-1.0, 1.0), strict=True):
        alone, together = 0.0, 0.0  # the kinds that do not stand alone are there or not as the part has a side there
        for lot in lots:
            by_mm2 = sign * (lot.quantile_mm2(share) - lot.mm2)
            if lot.stands_alone:
                alone = math.hypot(alone, max(by_mm2, 0.0))
            else:
                together += by_mm2
        off.append(math.hypot(alone, max(together, 0.0)))
    low = max(0.0, total - off[0]) if any(lot.is_known for lot in lots) else 0.0
    return Expectation(total, low, total + off[1])


def _lots(
    mm2: Float64Array, area_mm2: Float64Array, evidence: Float64Array, tried: BoolArray, learned: Experience
) -> list[_Lot]:
    found = []
    for kind in Evidence:
        for in_vain in (False, True):
            mine = (evidence == kind) & (tried == in_vain)
            total = float(mm2[mine].sum())
            if total <= 0.0:
                continue
            area = area_mm2[mine]
            there = np.minimum(mm2[mine] / area, 1.0)
            deviation = learned.deviation_mm2(kind, total) + (_IN_VAIN * total if in_vain else 0.0)
            deviation = math.hypot(deviation, math.sqrt(float((area**2 * there * (1.0 - there)).sum())))
            most = math.inf if kind in GUESSED_KINDS else max(total, float(area.sum()))
            stands_alone = not in_vain and learned.spreads[kind] <= PROMISED_WITHIN
            found.append(_Lot(mine, stands_alone, total, most, deviation))
    return found
