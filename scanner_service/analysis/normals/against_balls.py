"""How far planes lie from the directions of big Delaunay balls, for clouds too coarse for halves; knows no truth."""

import math
from dataclasses import dataclass

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.analysis.errors import MethodRefused
from scanner_service.analysis.normals.big_balls import big_delaunay_balls
from scanner_service.analysis.normals.field import Int64Array, NormalOptions
from scanner_service.analysis.normals.fitting import Weighting
from scanner_service.analysis.normals.parts import LADDER, MAX_ALIKE, Part, mean_squared_sine
from scanner_service.analysis.radius import mixed

MOST_POINTS = 50_000
"""Larger clouds are not triangulated to choose a number."""

SAMPLE = 2000
_LADDER = (8, *LADDER)


@dataclass(frozen=True, slots=True)
class AgainstBalls:
    """A cloud, and at a sample of its points the directions of their big Delaunay balls.

    Such a ball lies clear of the surface and touches it where the point is, however thin the wall and near the edge:
    its direction errs by noise, and hardly by what smoothing does to a plane. So a plane and a ball differ by the sum
    of their squared errors, of which the ball's does not depend on the number of neighbours. The noise of the point
    itself acts on both, which favours few: where halves can judge they judge better.

    `rows` (s,) is the sample, `at_mm` (s, 3) its places, `ladder` the numbers for which there are points.
    """

    rows: Int64Array
    at_mm: Float64Array
    ladder: tuple[int, ...]
    weighting: Weighting
    cloud: Part
    towards: Float64Array

    @classmethod
    def touch(cls, points_mm: Float64Array, weighting: Weighting) -> "AgainstBalls | None":
        """The same sample of points (n, 3) every time; None if they are too many, or cannot be triangulated."""
        n = len(points_mm)
        if n > MOST_POINTS:
            return None
        try:
            balls = big_delaunay_balls(points_mm, NormalOptions(max_error_rad=math.inf))
        except MethodRefused:
            return None
        order = np.argsort(mixed(np.arange(n, dtype=np.uint64)), kind="stable")
        rows = order[balls.reliable[order]][:SAMPLE]
        if not len(rows):
            return None
        at_mm = points_mm[rows]
        ladder = tuple(count for count in _LADDER if count <= min(n // 2, MAX_ALIKE))
        cloud = Part.around(points_mm, at_mm, ladder[-1])
        return cls(rows, at_mm, ladder, weighting, cloud, balls.normals[rows])

    def risk(self, counts: Int64Array) -> float:
        """Mean squared sine between planes through `counts` (s,) neighbours and the balls' directions."""
        return mean_squared_sine(self.cloud.axes(counts, self.weighting), self.towards)
