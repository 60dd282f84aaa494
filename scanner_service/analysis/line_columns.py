"""The scanlines of a map as growing columns; knows no points and no neighbourhoods."""

from typing import Any

import numpy as np

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
        self._waits: UInt8Array = np.zeros(256, dtype=np.uint8)
        self._first_row: Int32Array = np.zeros(257, dtype=np.int32)
        self._box_q: Int32Array = np.zeros((256, 2, 3), dtype=np.int32)
        self._clearance_q = np.zeros(256)
        self._used = 0
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
        clearance_mm: float,
        origin_mm: Float64Array,
    ) -> int:
        """Add a line whose points are the rows from `first_row` on; returns its row.

        `clearance_mm` is the least r_max of its points.
        """
        if self._used == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
            self._laser_q = np.concatenate([self._laser_q, np.zeros_like(self._laser_q)])
            self._pass_bit = np.concatenate([self._pass_bit, np.zeros_like(self._pass_bit)])
            self._waits = np.concatenate([self._waits, np.zeros_like(self._waits)])
            self._first_row = np.concatenate([self._first_row, np.zeros_like(self._first_row[1:])])
            self._box_q = np.concatenate([self._box_q, np.zeros_like(self._box_q)])
            self._clearance_q = np.concatenate([self._clearance_q, np.zeros_like(self._clearance_q)])
        row = self._used
        self._rows[row] = (
            self._devices.setdefault(line.device_id, len(self._devices)),
            line.boot_id,
            of.number,
            line.line_index,
            line.point_count,
            line.laser_mm,
            line.plane_normal,
            line.travel,
            line.position_mm,
            line.line_spacing_mm,
            line.step_mm,
            point_spacing_mm,
            stationary,
        )
        self._laser_q[row] = (line.laser_mm - origin_mm) / QUANTUM_MM
        self._pass_bit[row] = 1 << of.slot if of.slot >= 0 else 0
        self._waits[row] = 0
        self._first_row[row], self._first_row[row + 1] = first_row, first_row + len(line.index)
        self._clearance_q[row] = clearance_mm / QUANTUM_MM
        self._used = row + 1
        return row

    def drop_pass(self, pass_number: int) -> None:
        """The lines of a closed pass no longer hold anything open."""
        self._pass_bit[: self._used][self._rows["pass_number"][: self._used] == pass_number] = 0

    def set_clearance(self, clearance_mm: float) -> None:
        """Every point has another radius now, and this r_max."""
        self._clearance_q[: self._used] = clearance_mm / QUANTUM_MM

    def ranges(self, used: int, pass_number: int | None = None) -> list[tuple[int, int, int]]:
        """(line, first row, end row) of the lines, or of one pass, whose points are among the first `used` rows."""
        first = self._first_row[: self._used]
        end = np.minimum(self._first_row[1 : self._used + 1], used)
        chosen = end > first
        if pass_number is not None:
            chosen &= self._rows["pass_number"][: self._used] == pass_number
        return [(int(line), int(first[line]), int(end[line])) for line in np.flatnonzero(chosen)]

    def box_q(self, line: int) -> Int32Array:
        """The box (2, 3) of a line's points, to be filled by whoever writes them."""
        box: Int32Array = self._box_q[line]
        return box

    def laser_q(self, line: int) -> Float64Array:
        """Laser position (3,) of a line in quanta from the origin."""
        laser: Float64Array = self._laser_q[line]
        return laser

    def kernel_columns(self) -> tuple[Float64Array, UInt8Array, UInt8Array]:
        """Laser positions (L, 3) in quanta from the origin, pass bits (L,) and what lines wait for, as views.

        The last is as long as what is reserved, which is a multiple of 8.
        """
        return self._laser_q[: self._used], self._pass_bit[: self._used], self._waits

    def extents(self) -> tuple[Int32Array, Int32Array, Float64Array]:
        """Where rows begin (L + 1,), boxes of the points (L, 2, 3) and least r_max (L,) in quanta, as views."""
        used = self._used
        return self._first_row[: used + 1], self._box_q[:used], self._clearance_q[:used]

    def table(self) -> LineTable:
        """A copy of all rows, made once for as many as there are."""
        if self._table is not None and len(self._table) == self._used:
            return self._table
        rows = self._rows[: self._used].copy()

        def column(name: str) -> Any:
            return np.ascontiguousarray(rows[name])

        self._table = LineTable(
            device_ids=tuple(self._devices),
            **{name: column(name) for name in _ROW.names or ()},
        )
        return self._table
