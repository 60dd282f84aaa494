"""Which scanline follows which within a pass, and how far on; knows the line table only, no points."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array, read_only
from scanner_service.analysis.snapshot import LineTable

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Stations:
    """The scanlines in the order of the travel; arrays of L rows like the line table.

    `group` numbers the passes; `rank` is the line's place among the moving lines of its pass (-1: stationary).
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

    def __post_init__(self) -> None:
        for array in (self.group, self.rank, self.adjacent, self.gap_mm, self.missing, self.stride_mm):
            read_only(array)


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
        moving = moving[np.argsort(along, kind="stable")]
        rank[moving] = np.arange(len(moving))
        first, second = moving[:-1], moving[1:]
        steps = np.abs(np.diff(lines.line_index[moving]))
        lost = np.maximum(steps - np.abs(arrived[second] - arrived[first]), 0)
        apart = np.diff(lines.position_mm[moving]) if placed else np.full(len(first), np.nan)
        for rows_here, rows_there, side in ((second, first, 0), (first, second, 1)):
            adjacent[rows_here, side] = rows_there
            gap[rows_here, side] = apart
            missing[rows_here, side] = lost
    assumed = lines.line_spacing_mm[:, None] * (1 + missing)
    return Stations(group, rank, adjacent, gap, missing, np.where(np.isfinite(gap), gap, assumed))
