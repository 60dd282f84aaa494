"""How far apart points and lines are, from their places alone (pure); knows no file and no laser."""

from collections.abc import Iterable

import numpy as np

from drivers.scanline import Float64Array


def median_point_spacing_mm(lines_mm: Iterable[Float64Array]) -> float:
    """Median distance of consecutive points along their own line, over all lines; NaN when no line has two points.

    Each line is (n, 3); places without a point (NaN) are stepped over, so that a dropout widens one distance instead
    of hiding two.
    """
    gaps = []
    for points in lines_mm:
        present = points[np.isfinite(points).all(axis=1)]
        if len(present) > 1:
            with np.errstate(over="ignore"):  # damaged coordinates; the median does not feel them
                gaps.append(np.linalg.norm(np.diff(present, axis=0), axis=1))
    return float(np.median(np.concatenate(gaps))) if gaps else float("nan")


def nominal_line_spacing_mm(line_number: Float64Array, position_mm: Float64Array) -> float:
    """Slope of the straight line fitted to position against line number: the step of a line to the next.

    Both are (L,); lines whose position is NaN are left out, so that missing lines do not count as a wider step. NaN
    with fewer than two different line numbers. The sign is that of the travel.
    """
    known = np.isfinite(position_mm) & np.isfinite(line_number)
    number = line_number[known] - line_number[known].mean() if known.any() else np.empty(0)
    spread = float(number @ number)
    if spread == 0.0:
        return float("nan")
    return float(number @ (position_mm[known] - position_mm[known].mean())) / spread
