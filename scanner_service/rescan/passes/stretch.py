"""Which stretch of a motion, at which line spacing, brings most for its time; knows no part."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.scanline import BoolArray, Float64Array

BINS = 48
RUN_MM = 0.6  # a pass begins and ends this much, or two lines, beyond what it serves
SPACINGS = 7
_FIRST, _LAST = np.indices((BINS + 1, BINS + 1))
_IS_FORWARD = _LAST > _FIRST
_LENGTH = np.maximum(_LAST - _FIRST, 0)


@dataclass(frozen=True, slots=True)
class Stretch:
    """From `start_mm` to `end_mm` in lines `line_spacing_mm` apart: `gain_mm2` in `seconds`, the way there included."""

    start_mm: float
    end_mm: float
    line_spacing_mm: float
    gain_mm2: float
    seconds: float

    @property
    def gain_per_s(self) -> float:
        """What it brings for its time."""
        return self.gain_mm2 / self.seconds

    def serves(self, position_mm: Float64Array, coarsest_mm: Float64Array) -> BoolArray:
        """(n,) which places it covers finely enough."""
        inside = (position_mm >= self.start_mm) & (position_mm <= self.end_mm)
        served: BoolArray = inside & (coarsest_mm >= self.line_spacing_mm * (1.0 - 1e-9))
        return served


def best_stretch(
    position_mm: Float64Array,
    coarsest_mm: Float64Array,
    gain_mm2: Float64Array,
    spacing_mm: tuple[float, float],
    travel_mm: tuple[float, float],
    seconds: Callable[[Float64Array, float], Float64Array],
    overhead_s: float,
    least_mm2: float = 0.0,
) -> Stretch | None:
    """The stretch with the highest gain per second; None when there is no gain at all.

    Parameters
    ----------
    position_mm, coarsest_mm, gain_mm2 : (n,) where each place is met, the coarsest spacing that is enough, its worth.
    spacing_mm, travel_mm : what the rig can do.
    seconds : times (n,) of lengths (n,) at a spacing.
    overhead_s : time before the first line.
    least_mm2 : what brings less is no stretch.
    """
    finest, coarsest = spacing_mm
    usable = (coarsest_mm >= finest) & (gain_mm2 > 0) & (position_mm >= travel_mm[0]) & (position_mm <= travel_mm[1])
    if not usable.any():
        return None
    at, limit, gain = position_mm[usable], np.minimum(coarsest_mm[usable], coarsest), gain_mm2[usable]
    low, high = float(at.min()), float(at.max())
    width = max((high - low) / BINS, 1e-6)
    bin_of = np.minimum(((at - low) / width).astype(np.int64), BINS - 1)
    best: Stretch | None = None
    for spacing in np.unique(np.quantile(limit, np.linspace(0.0, 0.85, SPACINGS))).tolist():
        fine = limit >= spacing
        total = np.concatenate([[0.0], np.cumsum(np.bincount(bin_of[fine], gain[fine], BINS))])
        worth = total[None, :] - total[:, None]  # from bin i to bin j
        run_mm = max(RUN_MM, 2.0 * float(spacing))
        lengths = np.asarray(width * np.arange(BINS + 1) + 2.0 * run_mm, dtype=np.float64)
        times = overhead_s + seconds(lengths, float(spacing))
        rate = np.where(_IS_FORWARD & (worth >= least_mm2), worth / times[_LENGTH], 0.0)
        i, j = np.unravel_index(int(rate.argmax()), rate.shape)
        if rate[i, j] > 0 and (best is None or rate[i, j] > best.gain_per_s):
            start = max(travel_mm[0], low + float(i) * width - run_mm)
            end = min(travel_mm[1], low + float(j) * width + run_mm)
            best = Stretch(start, end, float(spacing), float(worth[i, j]), float(times[j - i]))
    return best
