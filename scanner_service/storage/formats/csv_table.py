"""The text of a profile table (CSV): checked columns of numbers, each row with its line number; knows no scanline."""

import csv
import re
from array import array
from dataclasses import dataclass
from math import isfinite, nan

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array
from scanner_service.storage.formats.errors import ContentDamaged, FileEmpty, HeaderDamaged

Int64Array = npt.NDArray[np.int64]
NEEDED = ("line", "x_mm", "y_mm", "z_mm")
LASER = ("laser_x_mm", "laser_y_mm", "laser_z_mm")
_WHOLE = ("line", "pass", "index")
_NUMBERS = (*NEEDED, *LASER, "line_spacing_mm", "pass", "time_s", "index")
_MAY_BE_EMPTY = ("x_mm", "y_mm", "z_mm", "time_s")


@dataclass(frozen=True, slots=True)
class ProfileTable:
    """Columns (n,) by name as float64, NaN where a cell is empty; `device` (n,) are rows of `devices`.

    `row_number` (n,) is the line of the file, counted from 1, on which a row stands.
    """

    columns: dict[str, Float64Array]
    device: Int64Array
    devices: tuple[str, ...]
    row_number: Int64Array

    def whole(self, name: str) -> Int64Array:
        """A column of whole numbers; zeros when the file has none of that name."""
        if name not in self.columns:
            return np.zeros(len(self.row_number), dtype=np.int64)
        return self.columns[name].astype(np.int64)


def column_names(line: str) -> tuple[str, list[str]]:
    """The delimiter of a header line and the names in it, in small letters."""
    delimiter = next((mark for mark in ",;\t" if mark in line), ",")
    return delimiter, [word.strip().strip('"').strip().lower() for word in line.split(delimiter)]


def is_profile_header(line: str) -> bool:
    """True when a line of text names the columns of a profile table."""
    names = column_names(line)[1]
    return "line" in names and any(re.fullmatch(r"[xyz]_mm", name) for name in names)


def read_table(text: str, name: str, default_device: str) -> ProfileTable:
    """Read a profile table whose first line that is no comment names the columns; other columns are left alone.

    Raises
    ------
    HeaderDamaged : a needed column is absent, or a name stands twice.
    ContentDamaged : a row has too few or too many cells, or a cell is no number where one is needed.
    FileEmpty : no row follows the header.
    """
    numbered = [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        raise FileEmpty(f"{name} is empty: there is nothing to read")
    delimiter, names = column_names(numbered[0][1])
    _check_names(names, name)
    used = [(column, names.index(column), array("d")) for column in _NUMBERS if column in names]
    device_at = names.index("device") if "device" in names else None
    codes: dict[str, int] = {}
    device = array("q")
    row_number = array("q")
    try:
        cells_of = csv.reader((line for _, line in numbered[1:]), delimiter=delimiter, strict=True)
        for (number, _), cells in zip(numbered[1:], cells_of, strict=False):
            if len(cells) != len(names):
                raise ContentDamaged(f"{name}: row {number} has {len(cells)} cells, and the header names {len(names)}")
            for column, at, values in used:
                values.append(_number(cells[at], column, number, name))
            text_of = (cells[device_at].strip() if device_at is not None else "") or default_device
            device.append(codes.setdefault(text_of, len(codes)))
            row_number.append(number)
    except csv.Error as error:
        raise ContentDamaged(f"{name}: the row after row {row_number[-1] if row_number else 1}: {error}") from None
    if len(row_number) < len(numbered) - 1:
        raise ContentDamaged(f"{name}: a quoted cell runs over the end of its row; a row is one line of text")
    if not row_number:
        raise FileEmpty(f"{name} has a header and no row: there is nothing to read")
    order = sorted(codes)
    rank = np.array([order.index(code) for code in codes], dtype=np.int64)
    return ProfileTable(
        columns={column: np.array(values) for column, _, values in used},
        device=rank[np.array(device)],
        devices=tuple(order),
        row_number=np.array(row_number),
    )


def _check_names(names: list[str], name: str) -> None:
    absent = [column for column in NEEDED if column not in names]
    if absent:
        raise HeaderDamaged(f"{name}: the header names no column {' and no '.join(absent)}")
    for column in names:
        if column in (*_NUMBERS, "device") and names.count(column) > 1:
            raise HeaderDamaged(f"{name}: the header names column {column} twice")
    given = [column for column in LASER if column in names]
    if given and len(given) < len(LASER):
        raise HeaderDamaged(f"{name}: a laser position needs all three of {', '.join(LASER)}")


def _number(cell: str, column: str, row: int, name: str) -> float:
    cell = cell.strip()
    if not cell and column in _MAY_BE_EMPTY:
        return nan
    try:
        value = float(cell) if "_" not in cell else None
    except ValueError:
        value = None
    if value is None:
        raise ContentDamaged(f"{name}: row {row} has {cell[:40]!r} in column {column} where a number is needed")
    if column in _WHOLE and not (isfinite(value) and value == int(value) and 0 <= value < 2**53):
        raise ContentDamaged(f"{name}: row {row} has {cell[:40]!r} in column {column} where a whole number is needed")
    if column in LASER and not isfinite(value):
        raise ContentDamaged(f"{name}: row {row} has no finite {column}")
    if column == "line_spacing_mm" and not (isfinite(value) and value > 0):
        raise ContentDamaged(f"{name}: row {row}: line spacing must be greater than 0 mm, not {cell[:40]}")
    return value
