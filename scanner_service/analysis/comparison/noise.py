"""The noise of the comparison: each coordinate by itself, uniform, as large as a share of something; judges nothing."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array

Kind = Literal["box", "spacing"]
BOX_SHARES = (0.0, 0.005, 0.01, 0.02)
SPACING_SHARES = (0.5, 1.0, 2.0)
_NEIGHBOURS = 5


@dataclass(frozen=True, slots=True)
class NoiseLevel:
    """Noise whose amplitude is `share` of the longest box side, or of a point's mean distance to five neighbours."""

    kind: Kind
    share: float

    @property
    def label(self) -> str:
        """A short name, such as `0.01 box`; noise of nothing has one name."""
        return "none" if self.share == 0.0 else f"{self.share:g} {self.kind}"


LEVELS = (
    *(NoiseLevel("box", share) for share in BOX_SHARES),
    *(NoiseLevel("spacing", share) for share in SPACING_SHARES),
)
"""Noise 0 is the same for both kinds, and stands once."""


def add_noise(points_mm: Float64Array, level: NoiseLevel, rng: np.random.Generator) -> Float64Array:
    """The points (n, 3), every coordinate moved by a number drawn uniformly from ± the amplitude.

    Its standard deviation is the amplitude over √3.
    """
    if level.share == 0.0:
        return points_mm.copy()
    amplitude: Float64Array
    if level.kind == "box":
        amplitude = np.full((1, 1), level.share * float(np.ptp(points_mm, axis=0).max()))
    else:
        count = min(_NEIGHBOURS + 1, len(points_mm))
        distance = np.asarray(cKDTree(points_mm).query(points_mm, k=np.arange(1, count + 1))[0])
        amplitude = level.share * distance[:, 1:].mean(axis=1, keepdims=True)
    return np.asarray(points_mm + amplitude * rng.uniform(-1.0, 1.0, points_mm.shape))
