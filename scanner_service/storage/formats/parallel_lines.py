"""Scanlines as cuts of a surface by parallel planes: their common normal, places and spacing (pure); knows no file.

The points of one line differ from each other only within its laser plane, so the direction in which they do not
differ is the planes' normal: the eigenvector of the smallest eigenvalue of the moments pooled over all lines, each
line about its own centroid. Where the lines are straight (a flat part) that leaves a whole circle of directions, and
the one in which the lines follow each other is taken. What moves within the plane cannot be seen in the points, so
the travel is taken along the normal.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array
from scanner_service.storage.formats.spacing import nominal_line_spacing_mm

Int64Array = npt.NDArray[np.int64]

_STRAIGHT = 1e-4  # variance across a line over variance along it, below which its plane is not seen
_SNAP_RAD = np.radians(0.5)  # a normal this close to an axis of the part is that axis: stages are built so
_FAR_MM = 1e6  # a point this far from the others is damage, and would decide the fit alone
_THICK = 0.5  # a line thicker than this share of the spacing is no plane


@dataclass(frozen=True, slots=True)
class ParallelLines:
    """`normal` (3,) unit and towards higher line numbers; `position_mm` (L,) is each line's place along it.

    A line without points has the place that the straight fit gives it. `spacing_mm` > 0 is the slope of that fit.
    `half_line_mm` is how far the lines' odd places lie ahead of the even ones (0 when the scanner does not interlace).
    """

    normal: Float64Array
    position_mm: Float64Array
    spacing_mm: float
    half_line_mm: float


def fit_parallel_lines(
    points_mm: Float64Array, line: Int64Array, line_number: Int64Array, odd: npt.NDArray[np.bool_] | None = None
) -> ParallelLines | None:
    """Fit parallel planes to points (n, 3) of which point i belongs to line `line[i]`, a row of `line_number` (L,).

    `odd` (n,) marks the points of an interlaced scanner's second half-lines; the place of a line is then midway
    between its halves. Returns None when there are fewer than two lines with points, when the lines lie in no common
    direction (hand-guided), or when they do not advance.
    """
    if not len(points_mm):
        return None
    near = np.asarray((np.abs(points_mm - np.median(points_mm, axis=0)) < _FAR_MM).all(axis=1))
    points_mm, line, odd = points_mm[near], line[near], None if odd is None else odd[near]
    count = np.bincount(line, minlength=len(line_number))
    present = count > 0
    if present.sum() < 2:
        return None
    sums = np.stack([np.bincount(line, points_mm[:, axis], len(line_number)) for axis in range(3)], axis=1)
    centroid = sums / np.maximum(count, 1)[:, None]
    within = points_mm - centroid[line]
    advance = _advance(centroid[present], line_number[present])
    normal = _snapped(_common_normal(within, advance))
    if normal is None:
        return None
    if normal @ advance < 0:
        normal = -normal
    along = points_mm @ normal
    half_line_mm = 0.0
    if odd is not None and odd.any():
        half_line_mm = _half_line(along, line, odd, len(line_number))
        along = along - np.where(odd, half_line_mm / 2, -half_line_mm / 2)
    position = _medians(along, line, len(line_number))
    spacing = nominal_line_spacing_mm(line_number.astype(np.float64), position)
    if not spacing > 0:
        return None
    thickness = float(np.sqrt(np.mean((along - position[line]) ** 2)))
    if thickness > _THICK * spacing:
        return None
    offset = float(np.median(position[present] - spacing * line_number[present]))
    position = np.where(present, position, offset + spacing * line_number)
    return ParallelLines(normal, position, spacing, half_line_mm)


def _advance(centroid: Float64Array, number: Int64Array) -> Float64Array:
    """Direction and size in which the lines' centroids move from one number to the next (3,)."""
    return np.array([nominal_line_spacing_mm(number.astype(np.float64), centroid[:, axis]) for axis in range(3)])


def _common_normal(within: Float64Array, advance: Float64Array) -> Float64Array | None:
    moments = within.T @ within
    values, vectors = np.linalg.eigh(moments)
    if values[2] <= 0:  # one point a line: nothing but the advance is known
        normal = advance
    elif values[1] <= _STRAIGHT * values[2]:
        course = vectors[:, 2]
        normal = advance - (advance @ course) * course
    else:
        normal = vectors[:, 0]
    length = float(np.linalg.norm(normal))
    return normal / length if np.isfinite(length) and length > 0 else None


def _snapped(normal: Float64Array | None) -> Float64Array | None:
    if normal is None:
        return None
    axis = int(np.argmax(np.abs(normal)))
    if np.hypot(*np.delete(normal, axis)) > np.sin(_SNAP_RAD):
        return normal
    return np.asarray(np.eye(3)[axis] * np.sign(normal[axis]))


def _half_line(along: Float64Array, line: Int64Array, odd: npt.NDArray[np.bool_], lines: int) -> float:
    """Median over the lines of how far their odd places lie ahead of their even ones; 0 when no line has both."""
    ahead = _medians(along[odd], line[odd], lines) - _medians(along[~odd], line[~odd], lines)
    ahead = ahead[np.isfinite(ahead)]
    return float(np.median(ahead)) if len(ahead) else 0.0


def _medians(values: Float64Array, group: Int64Array, groups: int) -> Float64Array:
    """Median of each group (groups,), NaN for an empty one."""
    order = np.lexsort((values, group))
    count = np.bincount(group, minlength=groups)
    start = np.cumsum(count) - count
    result = np.full(groups, np.nan)
    some = count > 0
    low, high = start[some] + (count[some] - 1) // 2, start[some] + count[some] // 2
    ordered = values[order]
    result[some] = (ordered[low] + ordered[high]) / 2
    return result
