"""What the normals of a cloud's two halves, which have no noise in common, say of the error of each; knows no truth."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.field import Int64Array
from scanner_service.analysis.normals.fitting import Weighting
from scanner_service.analysis.normals.parts import LADDER, Part, longest, mean_squared_sine
from scanner_service.analysis.radius import mixed

SAMPLE = 1000
DEALS = 8
DEALT = 20_000
"""A small cloud is dealt several times, or chance would choose: as often as makes up so many points, at most DEALS."""

STEADY = 0.1
"""Normals of the two halves that differ by less than this (mean squared sine) serve as a reference."""

NOISE_FALLS = 3.5
"""From half as many neighbours to all of them the difference falls by more than this where noise alone makes it.

The variance of a plane's normal is σ²/(N r²): a fourth for twice the points.
"""

_AT_RANDOM = 0.45
"""Above this two normals have little to do with each other (2/3 is chance), and how it falls tells nothing."""

_SAME = 0.95

Axes = tuple[tuple[Float64Array, Float64Array], ...]


@dataclass(frozen=True, slots=True)
class Reference:
    """Axes (s, 3) of both halves of every deal at a small radius, by how much they differ, the number of neighbours.

    `falls` is the least factor by which the difference falls up to there when neighbours double; infinite if unknown.
    """

    axes: Axes
    apart: float
    count: int
    falls: float


@dataclass(frozen=True, slots=True)
class Halves:
    """A cloud dealt into two halves, several times if it is small, and a sample at which their normals are compared.

    The halves share no point, so the noise in them is independent. Let n(r) be the normal at a point from one half,
    with half of k points within its radius r. Two halves differ by twice the variance v(r) of such a normal; the
    variance with all points is a half of it. A normal of one half at r and of the other at a small reference radius s
    differ by v(r) + v(s) + b², b being how far the normals turn between s and r: the bias that smoothing brings. The
    risk is v(r)/2 + b².

    Two halves at the smallest radii may disagree by more than STEADY; the reference is then the first that does not.
    Its own bias hides a part of b². Where edges rule, b² grows with the share of points that have one within r, hence
    with the square root of the number k, and the part that is seen is 1 - √(k of s / k of r).

    `rows` (s,) is the sample, `at_mm` (s, 3) its places, `ladder` the steps of LADDER for which there are points.
    """

    rows: Int64Array
    at_mm: Float64Array
    ladder: tuple[int, ...]
    weighting: Weighting
    halves: tuple[tuple[Part, Part], ...]
    reference: Reference

    @classmethod
    def deal(cls, points_mm: Float64Array, weighting: Weighting) -> "Halves | None":
        """The same halves and sample of points (n, 3) every time; None if they are too few for two steps."""
        n = len(points_mm)
        key = mixed(np.arange(n, dtype=np.uint64))
        rows = np.argsort(key, kind="stable")[:SAMPLE]
        at_mm = points_mm[rows]
        halves = []
        for deal in range(min(max(DEALT // max(n, 1), 1), DEALS)):
            in_first = ((key >> np.uint64(deal)) & np.uint64(1)).astype(np.bool_)
            first, second = (
                Part.around(points_mm[part], at_mm, longest(weighting) // 2) for part in (in_first, ~in_first)
            )
            halves.append((first, second))
        least = min(half.most for pair in halves for half in pair)
        ladder = tuple(count for count in LADDER if count <= min(n // 2, 2 * least))
        if len(ladder) < 2:
            return None
        return cls(rows, at_mm, ladder, weighting, tuple(halves), _reference(tuple(halves), ladder, weighting))

    @property
    def too_coarse(self) -> bool:
        """Whether the surface itself, and not noise alone, keeps the halves apart up to the reference.

        Bending within so small a radius, it hides from the reference what smoothing does to it.
        """
        return self.reference.falls < NOISE_FALLS

    def risk(self, counts: Int64Array) -> float:
        """Expected mean squared sine of the error with `counts` (s,) neighbours in the whole cloud."""
        axes = _axes(self.halves, counts, self.weighting)
        apart = _apart(axes)
        hidden = float(np.mean(np.sqrt(self.reference.count / counts)))
        if hidden > _SAME:
            return 0.25 * apart
        crossed = float(
            np.mean(
                [
                    0.5 * (mean_squared_sine(one, small_other) + mean_squared_sine(other, small_one))
                    for (one, other), (small_one, small_other) in zip(axes, self.reference.axes, strict=True)
                ]
            )
        )
        return 0.25 * apart + max(crossed - 0.5 * (apart + self.reference.apart), 0.0) / (1.0 - hidden)


def _reference(halves: tuple[tuple[Part, Part], ...], ladder: tuple[int, ...], weighting: Weighting) -> Reference:
    """The first step of the ladder whose halves agree to STEADY, or the one where they agree best."""
    tried: dict[int, Reference] = {}
    falls = math.inf
    for count in ladder:
        axes = _axes(halves, np.full(len(halves[0][0].at_mm), count), weighting)
        apart = _apart(axes)
        half = max((step for step in tried if 2 * step <= count), default=None)
        if half is not None and tried[half].apart < _AT_RANDOM:
            falls = min(falls, tried[half].apart / apart if apart > 0.0 else math.inf)
        tried[count] = Reference(axes, apart, count, falls)
        if apart < STEADY:
            return tried[count]
    return min(tried.values(), key=lambda one: one.apart)


def _axes(halves: tuple[tuple[Part, Part], ...], counts: Int64Array, weighting: Weighting) -> Axes:
    """Plane axes (s, 3) of either half of every deal, from half of each number of neighbours (s,)."""
    return tuple((one.axes(counts // 2, weighting), other.axes(counts // 2, weighting)) for one, other in halves)


def _apart(axes: Sequence[tuple[Float64Array, Float64Array]]) -> float:
    return float(np.mean([mean_squared_sine(one, other) for one, other in axes]))
