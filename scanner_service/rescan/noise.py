"""How noisy the returns are along their own scanline; knows no surface, so that curvature and edges are not noise.

A plane's residual rises on a sphere and at an edge as it does under noise. The third difference of four consecutive
points, p(i-1) - 3 p(i) + 3 p(i+1) - p(i+2), is free of any straight or parabolic course and has 20 times the variance
of one point, so sigma = |third difference| / sqrt(20); the median over a window of the line is not moved by the few
differences that an edge spoils. Jitter between scanlines (a shaking stage) is not seen here.
"""

import numpy as np
from scipy.ndimage import median_filter

from drivers.scanline import Float64Array
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.stations import IntArray

_WINDOW = 21
_PIECE = 100_000  # values filtered at once
_MEDIAN_OF_NORMAL = 0.6745  # median of |standard normal|


def noise_along_lines(snapshot: MapSnapshot, order: IntArray) -> Float64Array:
    """(n,) standard deviation of the returns along the laser ray, millimetres; NaN where the line is too short.

    `order` (n,) are the points by line and place in the line.
    """
    noise = np.full(len(snapshot), np.nan)
    if len(order) < _WINDOW:
        return noise
    points = snapshot.points_mm[order]
    line, index = snapshot.line[order].astype(np.int64), snapshot.index[order].astype(np.int64)
    ray = points - snapshot.lines.laser_mm[line]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    third = points[:-3] - 3 * points[1:-2] + 3 * points[2:-1] - points[3:]
    size = np.abs(np.einsum("ij,ij->i", third, ray[1:-2])) / (np.sqrt(20.0) * _MEDIAN_OF_NORMAL)
    consecutive = (line[:-3] == line[3:]) & (index[3:] - index[:-3] == 3)
    rows = np.flatnonzero(consecutive)
    if len(rows) < _WINDOW:
        return noise
    level = _running_median(size[rows])
    owner = line[rows]
    half = _WINDOW // 2
    same_line = np.zeros(len(rows), dtype=bool)
    same_line[half:-half] = owner[2 * half :] == owner[: -2 * half]
    # towards the ends of a line the window would reach into the next one: take the nearest whole window instead
    whole = np.flatnonzero(same_line)
    if not len(whole):
        return noise
    place = np.arange(len(rows))
    after = np.minimum(np.searchsorted(whole, place), len(whole) - 1)
    before = np.maximum(np.searchsorted(whole, place, side="right") - 1, 0)
    pick = np.where(owner[whole[after]] == owner, whole[after], whole[before])
    known = owner[pick] == owner
    for place_in_four in (0, 3, 1, 2):
        noise[order[rows[known] + place_in_four]] = level[pick[known]]
    return noise


def _running_median(values: Float64Array) -> Float64Array:
    """(n,) median over a window, the ends repeated; in pieces, for the filter keeps other threads from their turn."""
    half = _WINDOW // 2
    level = np.empty_like(values)
    for start in range(0, len(values), _PIECE):
        end = min(start + _PIECE, len(values))
        first, last = max(start - half, 0), min(end + half, len(values))
        level[start:end] = median_filter(values[first:last], size=_WINDOW, mode="nearest")[start - first : end - first]
    return level
