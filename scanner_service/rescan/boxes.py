"""Boxes along the axes, and which of them meet; knows no points but those it is given."""

from dataclasses import dataclass

import numpy as np

from drivers.scanline import BoolArray, Float64Array
from scanner_service.rescan.stations import IntArray

_MANY = 64  # so many boxes are compared one by one; more are joined to so many, each with those that follow it


@dataclass(frozen=True, slots=True)
class Boxes:
    """Boxes from `low_mm` to `high_mm`, (b, 3) each; one without a point is upside down, and meets nothing."""

    low_mm: Float64Array
    high_mm: Float64Array

    def __len__(self) -> int:
        return len(self.low_mm)

    def grown(self, by_mm: Float64Array) -> "Boxes":
        """Each larger by so much on every side, (b,)."""
        return Boxes(self.low_mm - by_mm[:, None], self.high_mm + by_mm[:, None])

    def part(self, rows: IntArray | BoolArray) -> "Boxes":
        """Some of them."""
        return Boxes(self.low_mm[rows], self.high_mm[rows])

    def meet(self, others: "Boxes") -> BoolArray:
        """(b,) True for those that meet one of the others; for some that only come near to many others, too."""
        meets = np.zeros(len(self), dtype=bool)
        full = others.part(np.flatnonzero((others.low_mm <= others.high_mm).all(axis=1)))
        if not len(full):
            return meets
        start = np.unique(np.linspace(0, len(full), _MANY, endpoint=False).astype(np.int64))
        low, high = np.minimum.reduceat(full.low_mm, start), np.maximum.reduceat(full.high_mm, start)
        for a, b in zip(low, high, strict=True):
            meets |= ((self.low_mm <= b) & (self.high_mm >= a)).all(axis=1)
        return meets


def boxes_of(points_mm: Float64Array, owner: IntArray, count: int) -> Boxes:
    """The boxes of `count` owners around their points (n, 3); `owner` (n,) rises."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    if len(owner):
        start = np.flatnonzero(np.diff(owner, prepend=owner[0] - 1))
        low[owner[start]] = np.minimum.reduceat(points_mm, start)
        high[owner[start]] = np.maximum.reduceat(points_mm, start)
    return Boxes(low, high)
