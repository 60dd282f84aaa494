"""The scanlines of a map as growing columns; knows no points and no neighbourhoods."""

from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array
from scanner_service.analysis.intake import QUANTUM_MM, StoredLine
from scanner_service.analysis.passes import Pass
from scanner_service.analysis.snapshot import Int32Array, LineTable, UInt8Array

_ROW = np.dtype(
    [
        ("device", np.int32),
        ("boot_id", np.int64),
        ("pass_number", np.int32),
        ("line_index", np.int64),
        ("point_count", np.int32),
        ("first_row", np.int32),
        ("laser_mm", np.float64, 3),
        ("plane_normal", np.float64, 3),
        ("travel", np.float64, 3),
        ("position_mm", np.float64),
        ("line_spacing_mm", np.float64),
        ("step_mm", np.float64),
        ("point_spacing_mm", np.float64),
        ("stationary", np.bool_),
    ]
)


class LineColumns:
    """One row a scanline, in the order of acceptance; grows by doubling, a line being small beside its points."""

    def __init__(self) -> None:
        self._rows = np.zeros(256, dtype=_ROW)
        self._laser_q = np.zeros((256, 3))
        self._pass_bit: UInt8Array = np.zeros(256, dtype=np.uint8)
        self._used = 0
        self.laser_box_q = np.array([[np.inf] * 3, [-np.inf] * 3])
        self._table: LineTable | None = None
        self._devices: dict[str, int] = {}

    def __len__(self) -> int:
        return self._used

    def append(
        self,
        line: StoredLine,
        of: Pass,
        point_spacing_mm: float,
        stationary: bool,
        first_row: int,
        origin_mm: Float64Array,
    ) -> int:
        """Add a line whose points begin at `first_row`; returns its row."""
        if self._used == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
            self._laser_q = np.concatenate([self._laser_q, np.zeros_like(self._laser_q)])
            self._pass_bit = np.concatenate([self._pass_bit, np.zeros_like(self._pass_bit)])
        row = self._used
        self._rows[row] = (
            self._devices.setdefault(line.device_id, len(self._devices)),
            line.boot_id,
            of.number,
            line.line_index,
            line.point_count,
            first_row,
            line.laser_mm,
            line.plane_normal,
            line.travel,
            line.position_mm,
            line.line_spacing_mm,
            line.step_mm,
            point_spacing_mm,
            stationary,
        )
        laser_q = (line.laser_mm - origin_mm) / QUANTUM_MM
        self._laser_q[row] = laser_q
        self.laser_box_q[0] = np.minimum(self.laser_box_q[0], laser_q)
        self.laser_box_q[1] = np.maximum(self.laser_box_q[1], laser_q)
        self._pass_bit[row] = 1 << of.slot if of.slot >= 0 else 0
        self._used = row + 1
        return row

    def drop_pass(self, pass_number: int) -> None:
        """The lines of a closed pass no longer hold anything open."""
        self._pass_bit[: self._used][self._rows["pass_number"][: self._used] == pass_number] = 0

    def ranges(self, used: int, pass_number: int | None = None) -> list[tuple[int, int, int]]:
        """(line, first row, end row) of the lines, or of one pass, whose points are among the first `used` rows."""
        rows = self._rows[: self._used]
        first = rows["first_row"]
        end = np.minimum(np.append(first[1:], used), used)
        chosen = (end > first) if pass_number is None else (end > first) & (rows["pass_number"] == pass_number)
        return [(int(line), int(first[line]), int(end[line])) for line in np.flatnonzero(chosen)]

    def line_of(self, rows: Int32Array) -> Int32Array:
        """(m,) line of each row of points."""
        found = np.searchsorted(self._rows["first_row"][: self._used], rows, side="right") - 1
        return found.astype(np.int32)

    def kernel_columns(self) -> tuple[npt.NDArray[np.float64], UInt8Array]:
        """Laser positions (L, 3) in quanta from the origin and pass bits (L,), as views."""
        return self._laser_q[: self._used], self._pass_bit[: self._used]

    def table(self) -> LineTable:
        """A copy of all rows, made once for as many as there are."""
        if self._table is not None and len(self._table) == self._used:
            return self._table
        rows = self._rows[: self._used].copy()

        def column(name: str) -> Any:
            return np.ascontiguousarray(rows[name])

        self._table = LineTable(
            device_ids=tuple(self._devices),
            **{name: column(name) for name in _ROW.names or () if name != "first_row"},
        )
        return self._table
