"""How many neighbours suit a cloud, found out from the cloud alone by comparing its two halves; knows no truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.field import MIN_NEIGHBOURS, Int64Array
from scanner_service.analysis.normals.fitting import Weighting, plane_fits
from scanner_service.analysis.normals.neighbourhoods import Neighbourhoods, by_number
from scanner_service.analysis.radius import mixed

LADDER = (10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 100, 130, 160, 200, 250, 320, 400, 500, 640, 800, 1000)
"""Numbers of neighbours that are tried; points that weigh alike need no more than MAX_ALIKE."""

MAX_ALIKE = 500
SAMPLE = 1000
DEALS = 8
DEALT = 20_000
"""A small cloud is dealt several times, or chance would choose: as often as makes up so many points, at most DEALS."""

_SAME = 0.95
STEADY = 0.1
"""Normals of the two halves that differ by less than this (mean squared sine) serve as a reference."""


def choose_count(points_mm: Float64Array, weighting: Weighting = Weighting.EQUAL) -> int:
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
    deals = Deals.deal(points_mm, weighting)
    if len(deals.ladder) < 2:
        return min(len(points_mm), max(MIN_NEIGHBOURS, 8))
    return deals.best(deals.reference())


@dataclass(frozen=True, slots=True)
class Reference:
    """Axes (s, 3) of both halves of every deal at a small radius, by how much they differ, the number of neighbours."""

    axes: tuple[tuple[Float64Array, Float64Array], ...]
    apart: float
    count: int


@dataclass(frozen=True, slots=True)
class Half:
    """Points (h, 3) of one half, and its rows (s, k) nearest to each place of the sample with their distances."""

    points_mm: Float64Array
    nearest: Int64Array
    distance_mm: Float64Array


@dataclass(frozen=True, slots=True)
class Deals:
    """A cloud dealt into two halves, several times if it is small, and a sample at which their normals are compared.

    `rows` (s,) is the sample, `at_mm` (s, 3) its places, `count` the number of points of the cloud.
    """

    count: int
    rows: Int64Array
    at_mm: Float64Array
    halves: tuple[tuple[Half, Half], ...]
    weighting: Weighting

    @classmethod
    def deal(cls, points_mm: Float64Array, weighting: Weighting, sample: int = SAMPLE) -> "Deals":
        """The same halves and sample of points (n, 3) every time."""
        n = len(points_mm)
        key = mixed(np.arange(n, dtype=np.uint64))
        rows = np.argsort(key, kind="stable")[:sample]
        at_mm = points_mm[rows]
        most = (MAX_ALIKE if weighting == Weighting.EQUAL else LADDER[-1]) // 2
        halves = []
        for deal in range(min(max(DEALT // max(n, 1), 1), DEALS)):
            in_first = ((key >> np.uint64(deal)) & np.uint64(1)).astype(np.bool_)
            first, second = (_half(points_mm[part], at_mm, most) for part in (in_first, ~in_first))
            halves.append((first, second))
        return cls(n, rows, at_mm, tuple(halves), weighting)

    @property
    def ladder(self) -> list[int]:
        """The steps of LADDER for which the halves have points enough."""
        least = min(half.nearest.shape[1] for pair in self.halves for half in pair)
        return [count for count in LADDER if count <= min(self.count // 2, 2 * least)]

    def reference(self) -> Reference:
        """The first step of the ladder whose halves agree to STEADY, or the one where they agree best."""
        best: Reference | None = None
        for count in self.ladder:
            axes = self._axes(np.full(len(self.rows), count))
            found = Reference(axes, _apart(axes), count)
            if found.apart < STEADY:
                return found
            if best is None or found.apart < best.apart:
                best = found
        assert best is not None, "only clouds with a ladder are asked for a reference"
        return best

    def best(self, reference: Reference) -> int:
        """The step of the ladder with the least risk, the same number of neighbours for all points."""
        ladder = self.ladder
        return ladder[int(np.argmin([self.risk(np.full(len(self.rows), count), reference) for count in ladder]))]

    def risk(self, counts: Int64Array, reference: Reference) -> float:
        """Expected mean squared sine of the error with `counts` (s,) neighbours in the whole cloud (`choose_count`)."""
        axes = self._axes(counts)
        apart = _apart(axes)
        hidden = float(np.mean(np.sqrt(reference.count / counts)))
        if hidden > _SAME:
            return 0.25 * apart
        crossed = float(
            np.mean(
                [
                    0.5 * (_mean_squared_sine(one, small_other) + _mean_squared_sine(other, small_one))
                    for (one, other), (small_one, small_other) in zip(axes, reference.axes, strict=True)
                ]
            )
        )
        return 0.25 * apart + max(crossed - 0.5 * (apart + reference.apart), 0.0) / (1.0 - hidden)

    def _axes(self, counts: Int64Array) -> tuple[tuple[Float64Array, Float64Array], ...]:
        """Plane axes (s, 3) of either half of every deal, from half of each number of neighbours (s,)."""
        return tuple(
            (
                _axes_of_half(one, self.at_mm, counts // 2, self.weighting),
                _axes_of_half(other, self.at_mm, counts // 2, self.weighting),
            )
            for one, other in self.halves
        )


def _half(half_mm: Float64Array, at_mm: Float64Array, most: int) -> Half:
    """The points of a half nearest to each place (s, 3), as many as are ever asked for."""
    count = min(most, len(half_mm))
    if count == 0:
        return Half(half_mm, np.zeros((len(at_mm), 0), dtype=np.int64), np.zeros((len(at_mm), 0)))
    distance, rows = cKDTree(half_mm).query(at_mm, k=np.arange(1, count + 1))
    return Half(half_mm, np.asarray(rows, dtype=np.int64), np.asarray(distance))


def _axes_of_half(half: Half, at_mm: Float64Array, counts: Int64Array, weighting: Weighting) -> Float64Array:
    """Plane axes (s, 3) at the places (s, 3) from so many (s,) of the nearest points of a half."""
    everything = np.concatenate([at_mm, half.points_mm])  # places first: offsets are from them, neighbours the rest
    counts = np.minimum(counts, half.nearest.shape[1])
    taken = half.nearest[np.arange(half.nearest.shape[1]) < counts[:, None]] + len(at_mm)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    reach_mm = half.distance_mm[np.arange(len(at_mm)), counts - 1]
    given = Neighbourhoods(np.arange(len(at_mm)), starts, taken, reach_mm)
    return plane_fits(everything, given, weighting)[0]


def _apart(axes: Sequence[tuple[Float64Array, Float64Array]]) -> float:
    return float(np.mean([_mean_squared_sine(one, other) for one, other in axes]))


def _mean_squared_sine(a: Float64Array, b: Float64Array) -> float:
    cosine = (a * b).sum(axis=1)
    return float(np.mean(1.0 - np.minimum(cosine * cosine, 1.0)))


def radius_of_count(tree: cKDTree, points_mm: Float64Array, count: int) -> float:
    """Median distance in mm to the `count`-th nearest point, itself counted, over a repeatable sample."""
    sample = np.argsort(mixed(np.arange(len(points_mm), dtype=np.uint64)), kind="stable")[: 2 * SAMPLE]
    reach = [some.radius_mm for some in by_number(tree, points_mm, sample, count)]
    return float(np.median(np.concatenate(reach)))
