"""How many neighbours suit a cloud, found out from the cloud alone; knows no truth, and not how risks are told."""

from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.against_balls import AgainstBalls
from scanner_service.analysis.normals.field import MIN_NEIGHBOURS, Int64Array
from scanner_service.analysis.normals.fitting import Weighting
from scanner_service.analysis.normals.halves import SAMPLE, Halves
from scanner_service.analysis.normals.neighbourhoods import by_number
from scanner_service.analysis.radius import mixed


class Judge(Protocol):
    """Whoever can tell the risk of numbers of neighbours (s,) at the `rows` (s,) of a sample, lying `at_mm` (s, 3)."""

    @property
    def rows(self) -> Int64Array: ...
    @property
    def at_mm(self) -> Float64Array: ...
    @property
    def ladder(self) -> tuple[int, ...]:
        """Numbers of neighbours worth trying."""
        ...

    def risk(self, counts: Int64Array) -> float:
        """Mean squared sine of the error, and what does not depend on the counts."""
        ...


def judge_of(points_mm: Float64Array, weighting: Weighting) -> Judge | None:
    """Who judges numbers of neighbours for points (n, 3): two halves of them, big balls where those are too coarse.

    None where there are too few points to choose.
    """
    halves = Halves.deal(points_mm, weighting)
    if halves is None or not halves.too_coarse:
        return halves
    return AgainstBalls.touch(points_mm, weighting) or halves


def best_count(judge: Judge) -> int:
    """The step of the judge's ladder with the least risk, the same number of neighbours for all points."""
    risks = [judge.risk(np.full(len(judge.rows), count)) for count in judge.ladder]
    return judge.ladder[int(np.argmin(risks))]


def choose_count(points_mm: Float64Array, weighting: Weighting = Weighting.EQUAL) -> int:
    """The number of neighbours for which the expected squared error of plane normals at points (n, 3) is least."""
    judge = judge_of(points_mm, weighting)
    return min(len(points_mm), max(MIN_NEIGHBOURS, 8)) if judge is None else best_count(judge)


def radius_of_count(tree: cKDTree, points_mm: Float64Array, count: int) -> float:
    """Median distance in mm to the `count`-th nearest point, itself counted, over a repeatable sample."""
    sample = np.argsort(mixed(np.arange(len(points_mm), dtype=np.uint64)), kind="stable")[: 2 * SAMPLE]
    reach = [some.radius_mm for some in by_number(tree, points_mm, sample, count)]
    return float(np.median(np.concatenate(reach)))
