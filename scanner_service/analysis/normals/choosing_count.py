"""How many neighbours suit a cloud, found out from the cloud alone by comparing its two halves; knows no truth."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.field import MAX_NEIGHBOURS, MIN_NEIGHBOURS, Int64Array
from scanner_service.analysis.normals.fitting import plane_fits
from scanner_service.analysis.normals.neighbourhoods import Neighbourhoods, by_number
from scanner_service.analysis.radius import mixed

LADDER = (8, 10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 100, 130, 160, 200, 250, 320, 400, MAX_NEIGHBOURS)
"""Numbers of neighbours that are tried."""

SAMPLE = 2000
_SAME = 0.95
STEADY = 0.15
"""Normals of the two halves that differ by less than this (mean squared sine) serve as a reference."""


def choose_count(points_mm: Float64Array) -> int:
    """The number of neighbours, one of LADDER, for which the expected squared error of plane normals is least.

    The cloud is dealt into two halves that share no point, so the noise in them is independent. Let n(r) be the normal
    at a point from one half, with half of k points within its radius r. Two halves differ by twice the variance v(r)
    of such a normal; the variance with all points is a half of it. A normal of one half at r and of the other at a
    small reference radius s differ by v(r) + v(s) + b², b being how far the normals turn between s and r: the bias
    that smoothing brings. The number with the least v(r)/2 + b² is taken, over a repeatable sample of SAMPLE points.

    Two halves at the smallest radii may disagree by more than STEADY; the reference is then the first that does not.
    Its own bias hides a part of b². Where edges rule, b² grows with the share of points that have one within r, hence
    with the square root of the number k, and the part that is seen is 1 - √(k of s / k of r).
    """
    halves = Halves.deal(points_mm)
    ladder = halves.ladder
    if len(ladder) < 2:
        return min(len(points_mm), max(MIN_NEIGHBOURS, LADDER[0]))
    reference = halves.reference()
    return ladder[int(np.argmin([halves.risk(np.full(len(halves.rows), count), reference) for count in ladder]))]


@dataclass(frozen=True, slots=True)
class Reference:
    """Axes (s, 3) of both halves at a small radius, by how much they differ, and the number of neighbours there."""

    axes: tuple[Float64Array, Float64Array]
    apart: float
    count: int


@dataclass(frozen=True, slots=True)
class Halves:
    """A cloud dealt into two halves, and a sample of its `rows` (s,) at which their normals are compared."""

    rows: Int64Array
    at_mm: Float64Array
    halves: tuple[Float64Array, Float64Array]
    nearest: tuple[Int64Array, Int64Array]

    @classmethod
    def deal(cls, points_mm: Float64Array, sample: int = SAMPLE) -> "Halves":
        """The same halves and sample of points (n, 3) every time."""
        key = mixed(np.arange(len(points_mm), dtype=np.uint64))
        in_first = (key & np.uint64(1)).astype(np.bool_)
        rows = np.argsort(key, kind="stable")[:sample]
        at_mm = points_mm[rows]
        halves = points_mm[in_first], points_mm[~in_first]
        return cls(rows, at_mm, halves, (_nearest(halves[0], at_mm), _nearest(halves[1], at_mm)))

    @property
    def ladder(self) -> list[int]:
        """The steps of LADDER for which either half has points enough."""
        return [count for count in LADDER if count // 2 <= min(map(len, self.halves)) // 4]

    def reference(self) -> Reference:
        """The first step of the ladder whose halves agree to STEADY, or the one where they agree best."""
        best: Reference | None = None
        for count in self.ladder:
            axes = self._axes(np.full(len(self.rows), count))
            found = Reference(axes, _mean_squared_sine(*axes), count)
            if found.apart < STEADY:
                return found
            if best is None or found.apart < best.apart:
                best = found
        assert best is not None, "only clouds with a ladder are asked for a reference"
        return best

    def risk(self, counts: Int64Array, reference: Reference) -> float:
        """Expected mean squared sine of the error with `counts` (s,) neighbours in the whole cloud (`choose_count`)."""
        first, second = self._axes(counts)
        apart = _mean_squared_sine(first, second)
        hidden = float(np.mean(np.sqrt(reference.count / counts)))
        if hidden > _SAME:
            return 0.25 * apart
        crossed = 0.5 * (_mean_squared_sine(first, reference.axes[1]) + _mean_squared_sine(second, reference.axes[0]))
        return 0.25 * apart + max(crossed - 0.5 * (apart + reference.apart), 0.0) / (1.0 - hidden)

    def _axes(self, counts: Int64Array) -> tuple[Float64Array, Float64Array]:
        """Plane axes (s, 3) of either half, from half of each number of neighbours (s,)."""
        first, second = (
            _axes_of_half(half, self.at_mm, near, counts // 2)
            for half, near in zip(self.halves, self.nearest, strict=True)
        )
        return first, second


def _nearest(half_mm: Float64Array, at_mm: Float64Array) -> Int64Array:
    """Rows (s, k) of the points of a half nearest to each place (s, 3), as many as are ever asked for."""
    count = min(MAX_NEIGHBOURS // 2, len(half_mm))
    if count == 0:
        return np.zeros((len(at_mm), 0), dtype=np.int64)
    return np.asarray(cKDTree(half_mm).query(at_mm, k=np.arange(1, count + 1))[1], dtype=np.int64)


def _axes_of_half(half_mm: Float64Array, at_mm: Float64Array, nearest: Int64Array, counts: Int64Array) -> Float64Array:
    """Plane axes (s, 3) at the places (s, 3) from so many (s,) of the nearest points of a half."""
    everything = np.concatenate([at_mm, half_mm])  # places first: offsets are taken from them, neighbours from the rest
    counts = np.minimum(counts, nearest.shape[1])
    taken = nearest[np.arange(nearest.shape[1]) < counts[:, None]] + len(at_mm)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    given = Neighbourhoods(np.arange(len(at_mm)), starts, taken, np.zeros(len(at_mm)))
    return plane_fits(everything, given)[0]


def _mean_squared_sine(a: Float64Array, b: Float64Array) -> float:
    cosine = (a * b).sum(axis=1)
    return float(np.mean(1.0 - np.minimum(cosine * cosine, 1.0)))


def radius_of_count(tree: cKDTree, points_mm: Float64Array, count: int) -> float:
    """Median distance in mm to the `count`-th nearest point, itself counted, over a repeatable sample."""
    sample = np.argsort(mixed(np.arange(len(points_mm), dtype=np.uint64)), kind="stable")[:SAMPLE]
    reach = [some.radius_mm for some in by_number(tree, points_mm, sample, count)]
    return float(np.median(np.concatenate(reach)))
