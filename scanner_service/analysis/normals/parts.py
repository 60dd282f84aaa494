"""Axes of planes at a sample of places, from some of the points of a cloud; knows not why those were picked."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.field import Int64Array
from scanner_service.analysis.normals.fitting import Weighting, plane_fits
from scanner_service.analysis.normals.neighbourhoods import Neighbourhoods

LADDER = (10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 100, 130, 160, 200, 250, 320, 400, 500, 640, 800, 1000)
"""Numbers of neighbours that are tried; points that weigh alike need no more than MAX_ALIKE."""

MAX_ALIKE = 500


def longest(weighting: Weighting) -> int:
    """The largest number of neighbours that is tried with such weights."""
    return MAX_ALIKE if weighting == Weighting.EQUAL else LADDER[-1]


@dataclass(frozen=True, slots=True)
class Part:
    """Points (h, 3) of a part of a cloud, and its rows (s, k) nearest to each place (s, 3) with their distances."""

    points_mm: Float64Array
    at_mm: Float64Array
    nearest: Int64Array
    distance_mm: Float64Array

    @classmethod
    def around(cls, points_mm: Float64Array, at_mm: Float64Array, most: int) -> "Part":
        """The points of the part nearest to each place, as many as are ever asked for."""
        count = min(most, len(points_mm))
        if count == 0:
            return cls(points_mm, at_mm, np.zeros((len(at_mm), 0), dtype=np.int64), np.zeros((len(at_mm), 0)))
        distance, rows = cKDTree(points_mm).query(at_mm, k=np.arange(1, count + 1))
        return cls(points_mm, at_mm, np.asarray(rows, dtype=np.int64), np.asarray(distance))

    @property
    def most(self) -> int:
        """How many neighbours can be asked for."""
        return int(self.nearest.shape[1])

    def axes(self, counts: Int64Array, weighting: Weighting) -> Float64Array:
        """Plane axes (s, 3) from so many (s,) of the nearest points."""
        s = len(self.at_mm)
        everything = np.concatenate([self.at_mm, self.points_mm])  # places first: offsets are from them
        counts = np.minimum(counts, self.most)
        taken = self.nearest[np.arange(self.most) < counts[:, None]] + s
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        reach_mm = self.distance_mm[np.arange(s), counts - 1]
        return plane_fits(everything, Neighbourhoods(np.arange(s), starts, taken, reach_mm), weighting)[0]


def mean_squared_sine(a: Float64Array, b: Float64Array) -> float:
    """Of the angles between the lines of unit vectors (s, 3)."""
    cosine = (a * b).sum(axis=1)
    return float(np.mean(1.0 - np.minimum(cosine * cosine, 1.0)))
