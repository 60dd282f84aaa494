"""Who is a point's neighbour, in bounded pieces: by radius or by number; knows no plane."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.errors import MethodRefused
from scanner_service.analysis.normals.field import Int64Array

PAIRS_AT_ONCE = 2_000_000
MAX_MEAN_NEIGHBOURS = 5_000
PROBE = 200
"""So many points say how crowded a radius is."""


@dataclass(frozen=True, slots=True)
class Neighbourhoods:
    """The neighbourhoods of the points `at` (m,): that of `at[i]` is `rows[starts[i]:starts[i + 1]]`, itself included.

    By number they come sorted by distance. `radius_mm` (m,) reaches the farthest.
    """

    at: Int64Array
    starts: Int64Array
    rows: Int64Array
    radius_mm: Float64Array


def by_radius(tree: cKDTree, points_mm: Float64Array, radius_mm: Float64Array) -> Iterator[Neighbourhoods]:
    """Neighbourhoods of all points (n, 3) within each one's radius (n,), at most PAIRS_AT_ONCE pairs in a piece.

    Raises
    ------
    MethodRefused : the radius reaches so many points that the work would not end.
    """
    n = len(points_mm)
    probe = np.unique(np.linspace(0, n - 1, PROBE).astype(np.int64))
    mean = float(np.mean(tree.query_ball_point(points_mm[probe], radius_mm[probe], return_length=True)))
    refuse_crowds(mean, radius_mm)
    counts = np.asarray(tree.query_ball_point(points_mm, radius_mm, return_length=True), dtype=np.int64)
    ends = np.cumsum(counts)
    first = 0
    while first < n:
        before = int(ends[first - 1]) if first else 0
        last = max(first + 1, int(np.searchsorted(ends, before + PAIRS_AT_ONCE, side="right")))
        found = tree.query_ball_point(points_mm[first:last], radius_mm[first:last], return_sorted=False)
        starts = np.concatenate([[0], np.cumsum(counts[first:last])]).astype(np.int64)
        rows = np.empty(starts[-1], dtype=np.int64)
        for i, some in enumerate(found):
            rows[starts[i] : starts[i + 1]] = some
        yield Neighbourhoods(np.arange(first, last), starts, rows, radius_mm[first:last])
        first = last


def refuse_crowds(mean: float, radius_mm: Float64Array) -> None:
    """Raise MethodRefused when radii (n,) hold more than MAX_MEAN_NEIGHBOURS points on average."""
    if mean > MAX_MEAN_NEIGHBOURS:
        raise MethodRefused(
            f"a radius of {np.median(radius_mm):.4g} mm holds {mean:,.0f} points on average, at most "
            f"{MAX_MEAN_NEIGHBOURS:,} are taken: choose a smaller one, or check the units"
        )


def by_number(tree: cKDTree, points_mm: Float64Array, at: Int64Array, count: int) -> Iterator[Neighbourhoods]:
    """The `count` nearest points of each of the rows `at`, in pieces; fewer when the cloud has fewer."""
    count = min(count, len(points_mm))
    step = max(1, PAIRS_AT_ONCE // count)
    for first in range(0, len(at), step):
        some = at[first : first + step]
        distance, rows = tree.query(points_mm[some], k=np.arange(1, count + 1))
        starts = np.arange(len(some) + 1, dtype=np.int64) * count
        reach = np.asarray(distance)[:, -1]
        yield Neighbourhoods(some, starts, np.ascontiguousarray(rows, dtype=np.int64).ravel(), reach)
