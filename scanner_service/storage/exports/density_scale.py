"""Which colour a density has: an absolute scale that most points are within, with what is required in its middle.

Knows densities, no picture. Shares of the scale run from 0 to 1; what lies beyond its ends has the colour of the end.
"""

from dataclasses import dataclass

import numpy as np

from drivers.scanline import Float64Array

_LOW, _HIGH = 1.0, 99.0
"""Percentiles: a few points at rims and where passes overlap must not make one colour of all others."""

_LEAST_SPAN = 0.25
"""The scale reaches at least so much beyond what is required, on both sides, as a share of it."""

_NOTHING_PER_MM2 = 1e-9  # no density that is worth a digit


@dataclass(frozen=True, slots=True)
class DensityScale:
    """From `bottom` to `top`, points per mm²; up to `middle` half of the colours, and beyond it the other half.

    Where nothing is required `middle` is half way, so that the scale is even.
    """

    bottom: float
    middle: float
    top: float

    def share(self, density_per_mm2: Float64Array) -> Float64Array:
        """Where densities are on the scale, 0 to 1; NaN stays NaN."""
        return np.asarray(np.interp(density_per_mm2, [self.bottom, self.middle, self.top], [0.0, 0.5, 1.0]))


def scale_of(densities_per_mm2: Float64Array, required_per_mm2: float = float("nan")) -> DensityScale:
    """The scale that suits these densities (n,), which may be none, and what is required, NaN if that is unknown."""
    found = densities_per_mm2[np.isfinite(densities_per_mm2)]
    low, high = np.percentile(found, (_LOW, _HIGH)) if len(found) else (0.0, 1.0)
    if np.isfinite(required_per_mm2):
        low = min(low, (1.0 - _LEAST_SPAN) * required_per_mm2)
        high = max(high, (1.0 + _LEAST_SPAN) * required_per_mm2)
    top = _two_digits(float(high), np.ceil) or 1.0
    bottom = _two_digits(float(low), np.floor)
    if bottom > 0.8 * top:  # one density everywhere: it has a place on the scale all the same
        bottom = _two_digits(0.5 * top, np.floor)
    middle = required_per_mm2 if np.isfinite(required_per_mm2) else 0.5 * (bottom + top)
    return DensityScale(bottom, float(middle), top)


def _two_digits(value: float, towards: np.ufunc) -> float:
    """The next number of two digits, below or above; 0 for what is as good as nothing."""
    if not value > _NOTHING_PER_MM2:
        return 0.0
    unit = 10.0 ** (np.floor(np.log10(value)) - 1.0)
    return float(towards(round(value / unit, 6)) * unit)
