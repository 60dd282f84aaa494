"""How many neighbours suit a cloud, found out from the cloud alone by comparing its two halves; knows no truth."""

import math

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.field import MAX_NEIGHBOURS, MIN_NEIGHBOURS, Int64Array
from scanner_service.analysis.normals.fitting import plane_fits
from scanner_service.analysis.normals.neighbourhoods import Neighbourhoods, by_number
from scanner_service.analysis.radius import mixed

LADDER = (8, 10, 12, 15, 20, 25, 30, 40, 50, 60, 80, 100, 130, 160, 200, 250, 320, 400, 500, 700, MAX_NEIGHBOURS)
"""Numbers of neighbours that are tried."""

SAMPLE = 2000
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
    n = len(points_mm)
    key = mixed(np.arange(n, dtype=np.uint64))
    in_first = (key & np.uint64(1)).astype(np.bool_)
    halves = points_mm[in_first], points_mm[~in_first]
    smaller = min(map(len, halves))
    ladder = [count for count in LADDER if count // 2 <= max(smaller // 4, 0)]
    if len(ladder) < 2:
        return min(n, max(MIN_NEIGHBOURS, LADDER[0]))
    sample = np.argsort(key, kind="stable")[:SAMPLE]
    axes = [_axes_of_half(half, points_mm[sample], ladder) for half in halves]
    apart = np.array([_mean_squared_sine(a, b) for a, b in zip(*axes, strict=True)])
    steady = np.flatnonzero(apart < STEADY)
    ref = int(steady[0]) if len(steady) else int(np.argmin(apart))
    risk = np.empty(len(ladder))
    for j in range(len(ladder)):
        crossed = 0.5 * (_mean_squared_sine(axes[0][j], axes[1][ref]) + _mean_squared_sine(axes[1][j], axes[0][ref]))
        turned = crossed - 0.5 * (apart[j] + apart[ref]) if j > ref else 0.0
        seen = 1.0 - math.sqrt(ladder[ref] / ladder[j]) if j > ref else 1.0
        risk[j] = 0.25 * apart[j] + max(turned, 0.0) / seen
    return ladder[int(np.argmin(risk))]


def _axes_of_half(half_mm: Float64Array, at_mm: Float64Array, ladder: list[int]) -> list[Float64Array]:
    """Plane axes (s, 3) at the places (s, 3), for half of each number of neighbours in the ladder."""
    tree = cKDTree(half_mm)
    found: list[Float64Array] = []
    everything = np.concatenate([at_mm, half_mm])  # places first: offsets are taken from them, neighbours from the rest
    rows: Int64Array = np.arange(len(at_mm))
    largest = max(ladder) // 2
    nearest = np.asarray(tree.query(at_mm, k=np.arange(1, largest + 1))[1], dtype=np.int64) + len(at_mm)
    for count in ladder:
        some = np.ascontiguousarray(nearest[:, : count // 2]).ravel()
        starts = np.arange(len(rows) + 1, dtype=np.int64) * (count // 2)
        given = Neighbourhoods(rows, starts, some, np.zeros(len(rows)))
        found.append(plane_fits(everything, given, np.zeros(len(rows)))[0])
    return found


def _mean_squared_sine(a: Float64Array, b: Float64Array) -> float:
    cosine = (a * b).sum(axis=1)
    return float(np.mean(1.0 - np.minimum(cosine * cosine, 1.0)))


def radius_of_count(tree: cKDTree, points_mm: Float64Array, count: int) -> float:
    """Median distance in mm to the `count`-th nearest point, itself counted, over a repeatable sample."""
    sample = np.argsort(mixed(np.arange(len(points_mm), dtype=np.uint64)), kind="stable")[:SAMPLE]
    reach = [some.radius_mm for some in by_number(tree, points_mm, sample, count)]
    return float(np.median(np.concatenate(reach)))
