"""Which scanline follows which within a pass, and how far on; knows the line table only, no points."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import LineTable

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Stations:
    """The scanlines in the order of the travel; arrays of L rows like the line table.

    `group` numbers the passes; `rank` is the line's place among the moving lines of its pass (-1: stationary), counted
    the way the pass began to go. `point_spacing_mm` is the line's point spacing, or the median of its pass where it
    has none itself (NaN: nobody has one).
    Column 0 of the (L, 2) arrays is the line before, column 1 the line after: `adjacent` its row (-1: none), `gap_mm`
    the station gap (NaN without positions), `missing` the line indices that never arrived in between, `stride_mm` the
    gap, or where it is unknown the nominal spacing times the index steps.
    """

    group: IntArray
    rank: IntArray
    adjacent: IntArray
    gap_mm: Float64Array
    missing: IntArray
    stride_mm: Float64Array
    point_spacing_mm: Float64Array

    def __post_init__(self) -> None:
        for name in self.__slots__:
            read_only(getattr(self, name))

    def part(self, lines: IntArray) -> "Stations":
        """Some of the lines (rising rows) by themselves; what is adjacent to them and left out is none."""
        place = np.full(len(self.group) + 1, -1, dtype=np.int64)  # the last entry answers for -1
        place[lines] = np.arange(len(lines))
        values = {name: getattr(self, name)[lines] for name in self.__slots__}
        return Stations(**values | {"adjacent": place[self.adjacent[lines]]})

    def differs(self, earlier: "Stations") -> BoolArray:
        """(L,) True for the lines that stand otherwise than in `earlier`, or that it did not have."""
        count = len(earlier.group)
        other = np.ones(len(self.group), dtype=bool)
        other[:count] = False
        for name in self.__slots__:
            now, then = getattr(self, name)[:count], getattr(earlier, name)
            changed = (now != then) & ~(np.isnan(now) & np.isnan(then))
            other[:count] |= changed.any(axis=1) if changed.ndim > 1 else changed
        return other


def stations_of(lines: LineTable) -> Stations:
    """Order the lines of each pass by position, or by line index where a pass has lines without a position."""
    count = len(lines)
    rank = np.full(count, -1, dtype=np.int64)
    arrived = np.zeros(count, dtype=np.int64)
    adjacent = np.full((count, 2), -1, dtype=np.int64)
    gap = np.full((count, 2), np.nan)
    missing = np.zeros((count, 2), dtype=np.int64)
    keys = np.column_stack([lines.device, lines.boot_id, lines.pass_number])
    group = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)
    for number in range(int(group.max(initial=-1)) + 1):
        rows = np.flatnonzero(group == number)
        arrived[rows[np.argsort(lines.line_index[rows], kind="stable")]] = np.arange(len(rows))
        moving = rows[~lines.stationary[rows]]
        placed = bool(np.isfinite(lines.position_mm[moving]).all())
        along = lines.position_mm[moving] if placed else lines.line_index[moving]
        moving = moving[np.argsort(along if _rises(along) else -along, kind="stable")]
        rank[moving] = np.arange(len(moving))
        first, second = moving[:-1], moving[1:]
        steps = np.abs(np.diff(lines.line_index[moving]))
        lost = np.maximum(steps - np.abs(arrived[second] - arrived[first]), 0)
        apart = np.abs(np.diff(lines.position_mm[moving])) if placed else np.full(len(first), np.nan)
        for rows_here, rows_there, side in ((second, first, 0), (first, second, 1)):
            adjacent[rows_here, side] = rows_there
            gap[rows_here, side] = apart
            missing[rows_here, side] = lost
    assumed = lines.line_spacing_mm[:, None] * (1 + missing)
    stride = np.where(np.isfinite(gap), gap, assumed)
    return Stations(group, rank, adjacent, gap, missing, stride, _point_spacing(lines, group))


def _rises(along: Float64Array | IntArray) -> bool:
    """Whether the first two different values rise: lines that follow in the same direction then change no rank."""
    other = np.flatnonzero(along != along[0]) if len(along) else np.zeros(0, dtype=np.int64)
    return not len(other) or bool(along[other[0]] > along[0])


def _point_spacing(lines: LineTable, group: IntArray) -> Float64Array:
    """(L,) the line's point spacing, or the median of its pass where the line itself has none (or 0); else NaN."""
    spacing = np.where(lines.point_spacing_mm > 0, lines.point_spacing_mm, np.nan)
    for number in np.unique(group[np.isnan(spacing)]):
        rows = group == number
        known = spacing[rows & np.isfinite(spacing)]
        if len(known):
            spacing[rows & np.isnan(spacing)] = np.median(known)
    return spacing
