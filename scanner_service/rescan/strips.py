"""How far apart the scanlines lie on the surface, measured at each point; knows points and stations, judges nothing.

Between a scanline and the next lies a strip of surface. Its width at a point is the distance of the point to the
adjacent scanline, taken as a chain of segments, so that the spacing along the line does not enter. Where the adjacent
line ends before it passes the point, the strip ends too: the border of the part, not a wide strip.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import Int32Array, MapSnapshot
from scanner_service.rescan.frames import Frames
from scanner_service.rescan.requirement import Requirement
from scanner_service.rescan.stations import IntArray, Stations

_CHAIN_BREAK = 3.0  # points further apart than this many point spacings do not belong to one chain
_LOST = 3  # places without a return that points of one surface may have between them
_END_SLACK = 0.6  # a chain is taken to reach this many point spacings beyond its last point


@dataclass(frozen=True, slots=True)
class Strips:
    """The strip before (column 0) and after (column 1) each point; arrays of n rows like the snapshot.

    `chain` (n, 2) are the points before and after it in its own line, as long as the line is unbroken there (-1: not).
    `link` (n, 2) is the nearest point of the adjacent scanline (-1: none beside the point), `width_mm` (n, 2) the
    distance to that scanline on the surface (NaN: none). `point_spacing_mm` (n,) is the mean distance of the
    consecutive points around the point in its own line (NaN: it stands alone), `line_spacing_mm` (n,) the nominal Δs,
    `nominal_point_spacing_mm` (n,) the median spacing of the line, or of its pass where the line has one point only.
    `reach_mm` (n,) is the radius of the point's rule before any growing. `group` (n,) numbers the point's pass,
    `order` (n,) are the points by line and place in the line, `beside` (n, 2) those before and after each in its line,
    however far (-1: none).
    """

    chain: IntArray
    link: IntArray
    width_mm: Float64Array
    point_spacing_mm: Float64Array
    line_spacing_mm: Float64Array
    nominal_point_spacing_mm: Float64Array
    reach_mm: Float64Array
    group: IntArray
    order: IntArray
    beside: IntArray

    def __post_init__(self) -> None:
        for name in self.__slots__:
            read_only(getattr(self, name))


@dataclass(frozen=True, slots=True)
class Spacings:
    """What strips say of the scanlines around each point; arrays of n rows, as in `Strips`."""

    point_spacing_mm: Float64Array
    line_spacing_mm: Float64Array
    nominal_point_spacing_mm: Float64Array
    reach_mm: Float64Array
    group: IntArray

    def __post_init__(self) -> None:
        for name in self.__slots__:
            read_only(getattr(self, name))


def strips_of(snapshot: MapSnapshot, stations: Stations, frames: Frames, requirement: Requirement) -> Strips:
    """Measure the strips on both sides of every counted point."""
    lines, line = snapshot.lines, snapshot.line
    spacing = stations.point_spacing_mm
    order = np.lexsort((snapshot.index, line)).astype(np.int64)
    c = requirement.radius_constant_mm
    grown = np.sqrt(2.0) * np.fmax(lines.line_spacing_mm, spacing)[line] + c
    reach = np.fmin(snapshot.radius_mm, grown)
    search = requirement.search_mm
    r_max = np.maximum(20.0 * c, 3.0 * reach) if search is None else np.full(len(snapshot), search)
    counted = snapshot.neighbours > 0
    link = np.full((len(snapshot), 2), -1, dtype=np.int64)
    width = np.full((len(snapshot), 2), np.nan)
    u = (snapshot.points_mm * frames.along[stations.group[line]]).sum(axis=1) if len(snapshot) else np.zeros(0)
    rows = np.flatnonzero(counted)
    rows = rows[np.lexsort((u[rows], line[rows]))]
    start = np.searchsorted(line[rows], np.arange(len(lines) + 1)).astype(np.int64)
    points, u_sorted = np.ascontiguousarray(snapshot.points_mm[rows]), u[rows]
    for side in (0, 1):
        target = stations.adjacent[line[rows], side]
        bound = np.maximum(r_max[rows], 2.0 * stations.stride_mm[line[rows], side])
        found = np.full(len(rows), -1, dtype=np.int64)
        distance = np.full(len(rows), np.nan)
        _nearest_in_line(points, u_sorted, start, target, bound, spacing, found, distance)
        link[rows, side] = np.where(found >= 0, rows[found], -1)
        width[rows, side] = distance
    chain, point_spacing = _along_the_line(snapshot, order, spacing, reach)
    return Strips(
        chain=chain,
        link=link,
        width_mm=width,
        point_spacing_mm=point_spacing,
        line_spacing_mm=lines.line_spacing_mm[line],
        nominal_point_spacing_mm=spacing[line],
        reach_mm=reach,
        group=stations.group[line],
        order=order,
        beside=_beside(line, order),
    )


def in_a_row(snapshot: MapSnapshot, strips: Strips, rows: IntArray, across: BoolArray) -> BoolArray:
    """Whether points have a near neighbour on both sides: along their line where `across`, in the lines beside else."""
    before, after = strips.beside[rows].T
    near: BoolArray = (before >= 0) & (after >= 0)
    for first, second in ((before, rows), (rows, after)):
        step = np.linalg.norm(snapshot.points_mm[second] - snapshot.points_mm[first], axis=1)
        near &= step <= strips.reach_mm[second]
    over_lines = np.all(strips.width_mm[rows] <= strips.reach_mm[rows, None], axis=1)
    row: BoolArray = np.where(across, near, over_lines)
    return row


def _beside(line: Int32Array, order: IntArray) -> IntArray:
    """(n, 2) points before and after each in its own line."""
    beside = np.full((len(order), 2), -1, dtype=np.int64)
    same = np.diff(line[order]) == 0
    beside[order[1:][same], 0] = order[:-1][same]
    beside[order[:-1][same], 1] = order[1:][same]
    return beside


def _along_the_line(
    snapshot: MapSnapshot, order: IntArray, spacing: Float64Array, reach: Float64Array
) -> tuple[IntArray, Float64Array]:
    """(n, 2) neighbours over unbroken segments; (n,) mean length of up to four segments, lost places counted."""
    chain = np.full((len(order), 2), -1, dtype=np.int64)
    result = np.full(len(order), np.nan)
    if len(order) < 2:
        return chain, result
    points, line = snapshot.points_mm[order], snapshot.line[order]
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    broken_beyond = np.fmax(_CHAIN_BREAK * spacing[line[1:]], reach[order[1:]])
    whole = (np.diff(line) == 0) & (length <= broken_beyond)
    chain[order[1:][whole], 0] = order[:-1][whole]
    chain[order[:-1][whole], 1] = order[1:][whole]
    # over a few lost places the surface goes on: what did not return makes the points sparser, however steep it is
    places = np.maximum(np.diff(snapshot.index[order]), 1)
    as_steep = np.fmax(_CHAIN_BREAK * spacing[line[1:]] * places, reach[order[1:]])
    spaced = (np.diff(line) == 0) & (places <= _LOST + 1) & (length <= as_steep)
    total, segments = np.zeros(len(order)), np.zeros(len(order))
    right1 = np.append(spaced, False)
    right2 = right1 & np.append(right1[1:], False)
    left1 = np.insert(spaced, 0, False)
    left2 = left1 & np.insert(left1[:-1], 0, False)
    step = np.append(length, 0.0)
    for has, shift in ((right1, 0), (right2, -1), (left1, 1), (left2, 2)):
        total += np.where(has, np.roll(step, shift), 0.0)
        segments += has
    with np.errstate(invalid="ignore", divide="ignore"):
        result[order] = np.where(segments > 0, total / segments, np.nan)
    return chain, result


@njit(cache=True, nogil=True)
def _nearest_in_line(
    points: npt.NDArray[np.float64],
    u: npt.NDArray[np.float64],
    start: npt.NDArray[np.int64],
    target: npt.NDArray[np.int64],
    bound: npt.NDArray[np.float64],
    spacing: npt.NDArray[np.float64],
    found: npt.NDArray[np.int64],
    distance: npt.NDArray[np.float64],
) -> None:
    """Nearest point of the target line, and the distance to its chain; points sorted by line, then by u.

    |u - u'| never exceeds the distance, so the outward walk may stop there.
    """
    for i in range(len(points)):
        row = target[i]
        if row < 0:
            continue
        lo, hi = start[row], start[row + 1]
        if lo == hi:
            continue
        right = lo + np.searchsorted(u[lo:hi], u[i])
        left = right - 1
        best, best_sq = -1, bound[i] * bound[i]
        while left >= lo or right < hi:
            if left >= lo:
                if (u[i] - u[left]) ** 2 >= best_sq:
                    left = lo - 1
                else:
                    sq = 0.0
                    for k in range(3):
                        sq += (points[left, k] - points[i, k]) ** 2
                    if sq < best_sq:
                        best, best_sq = left, sq
                    left -= 1
            if right < hi:
                if (u[right] - u[i]) ** 2 >= best_sq:
                    right = hi
                else:
                    sq = 0.0
                    for k in range(3):
                        sq += (points[right, k] - points[i, k]) ** 2
                    if sq < best_sq:
                        best, best_sq = right, sq
                    right += 1
        if best < 0:
            continue
        sides, inside, beyond, nearest_sq = 0, False, abs(u[i] - u[best]), best_sq
        for step in (-1, 1):
            other = best + step
            if other < lo or other >= hi:
                continue
            length_sq, dot = 0.0, 0.0
            for k in range(3):
                v = points[other, k] - points[best, k]
                length_sq += v * v
                dot += v * (points[i, k] - points[best, k])
            if length_sq == 0.0 or length_sq > (_CHAIN_BREAK * spacing[row]) ** 2:
                continue
            sides += 1
            if dot > 0.0:
                inside = True
                nearest_sq = min(nearest_sq, max(best_sq - dot * dot / length_sq, 0.0))
            else:
                beyond = -dot / np.sqrt(length_sq)
        if inside or sides == 2 or beyond <= _END_SLACK * spacing[row]:
            found[i] = best
            distance[i] = np.sqrt(nearest_sq)
