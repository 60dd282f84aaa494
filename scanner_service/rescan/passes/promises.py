"""What of a pass may be promised: how much each kind of evidence brings, how surely, and what is said of a pass.

Knows numbers by kind of evidence, no place, no surface and no rig.
"""

import math
from dataclasses import dataclass

import numpy as np

from drivers.scanline import BoolArray, Float64Array
from scanner_service.rescan.passes.needs import FIRST_CHANCES, HIDDEN_KINDS, Chances, Evidence

Spreads = tuple[float, ...]
"""How far what a large pass brings of each kind lies from what was expected, by `Evidence`, as a share of that."""
FIRST_SPREADS: Spreads = (0.05, 0.3, 0.2, 0.2, 1.0, 0.4, 1.0)
"""... before a pass has shown it."""
GRAINS_MM2: tuple[float, ...] = (0.05, 2.0, 3.0, 0.5, 6.0, 6.0, 6.0)
"""Surface comes in pieces of about this size, by `Evidence`: who asks for less may find all or nothing."""
_IN_VAIN = 1.0  # so much less sure is a place that a pass was in vain for
EIGHTY_PERCENT = 1.2816
"""Standard deviations to either side within which a normal variable lies four times in five."""
PROMISED_WITHIN = 0.5
"""What is promised comes four times in five within this share of it; what would widen that is explored, and so is a
kind that varies by more than this itself."""


@dataclass(frozen=True, slots=True)
class Experience:
    """What passes teach: good surface for each mm² asked for, and how much that varies, by `Evidence`."""

    chances: Chances = FIRST_CHANCES
    spreads: Spreads = FIRST_SPREADS


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
    """The places of a pass of one kind, those that a pass was in vain for apart."""

    mine: BoolArray
    may_be_promised: bool
    mm2: float
    most_mm2: float
    deviation_mm2: float


def promised_places(
    mm2: Float64Array, area_mm2: Float64Array, evidence: Float64Array, tried: BoolArray, learned: Experience
) -> BoolArray:
    """(k,) which places a pass promises; the others it explores.

    Kinds that vary by less than `PROMISED_WITHIN` are promised from the surest on, as long as the interval of all that
    is promised stays within that, too. What a pass was in vain for is never promised.

    Parameters
    ----------
    mm2, area_mm2 : what is expected of each place, and its area.
    evidence : why each is believed in (`Evidence`).
    tried : where passes were in vain.
    """
    lots = [lot for lot in _lots(mm2, area_mm2, evidence, tried, learned) if lot.may_be_promised]
    lots.sort(key=lambda lot: lot.deviation_mm2 / lot.mm2)
    promised = np.zeros(len(mm2), dtype=np.bool_)
    total, variance = 0.0, 0.0
    for lot in lots:
        total += lot.mm2
        variance += lot.deviation_mm2**2
        if EIGHTY_PERCENT * math.sqrt(variance) > PROMISED_WITHIN * total:
            break
        promised |= lot.mine
    return promised


def expectation_of(
    mm2: Float64Array, area_mm2: Float64Array, evidence: Float64Array, tried: BoolArray, learned: Experience
) -> Expectation:
    """What places bring together; arguments as those of `promised_places`.

    Each place is there or not, and each kind as a whole brings more or less than was foretold. What may be promised
    does so kind by kind, so that squares add up; the other kinds, which are there or not as the part has a side there,
    rise and fall together. Surface whose place is known cannot be more than its area.
    """
    low, high, less, more = 0.0, 0.0, 0.0, 0.0
    for lot in _lots(mm2, area_mm2, evidence, tried, learned):
        half = EIGHTY_PERCENT * lot.deviation_mm2
        down, up = min(half, lot.mm2), min(half, lot.most_mm2 - lot.mm2)
        if lot.may_be_promised:
            low, high = math.hypot(low, down), math.hypot(high, up)
        else:
            less, more = less + down, more + up
    total = float(mm2.sum())
    return Expectation(total, max(0.0, total - math.hypot(low, less)), total + math.hypot(high, more))


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
            area, spread = area_mm2[mine], learned.spreads[kind]
            there = np.minimum(mm2[mine] / area, 1.0)
            share = math.sqrt(spread**2 + GRAINS_MM2[kind] * learned.chances[kind] / total)
            share += _IN_VAIN if in_vain else 0.0
            deviation = math.hypot(share * total, math.sqrt(float((area**2 * there * (1.0 - there)).sum())))
            most = math.inf if kind in HIDDEN_KINDS else max(total, float(area.sum()))
            found.append(_Lot(mine, not in_vain and spread <= PROMISED_WITHIN, total, most, deviation))
    return found
