"""What comes out of a file: scanlines or a plain cloud, and what was derived on the way; knows no file format."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite, isinf
from typing import Literal, get_args

import numpy as np

from drivers.scanline import BoolArray, Float64Array, Scanline, read_only
from scanner_service.storage.formats.errors import OptionRefused
from scanner_service.storage.formats.normals_of import NormalsOf

Units = Literal["mm", "m", "inch", "auto"]
LineAlong = Literal["column", "row"]
MM_PER_UNIT: Mapping[str, float] = {"mm": 1.0, "m": 1000.0, "inch": 25.4}


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """What the user says about a file that the file does not say itself; everything may be left out.

    Parameters
    ----------
    units : length unit of the file; "auto" and None let the documented rule decide, and a note says what it decided.
    laser_mm : laser position in the part frame, the same for every line. One coordinate may be NaN when it is the one
        that the scanner travels along: it is then each line's own place.
    line_spacing_mm : nominal line spacing; None derives it from the data.
    line_along : whether a scanline is a column or a row of a range grid.
    device_id : name of the scanner where the file names none; None takes the file's own name.
    max_bytes : a larger file is refused before it is read.

    Raises
    ------
    OptionRefused : for a value that cannot be meant, such as a line spacing of 0.
    """

    units: Units | None = None
    laser_mm: tuple[float, float, float] | None = None
    line_spacing_mm: float | None = None
    line_along: LineAlong = "column"
    device_id: str | None = None
    max_bytes: int = 2**31

    def __post_init__(self) -> None:
        if self.units is not None and self.units not in get_args(Units):
            raise OptionRefused(f"units must be mm, m, inch or auto, not {self.units!r}")
        if self.line_along not in get_args(LineAlong):
            raise OptionRefused(f"a scanline is a column or a row of the range grid, not {self.line_along!r}")
        spacing = self.line_spacing_mm
        if spacing is not None and not (isfinite(spacing) and spacing > 0):
            raise OptionRefused(f"line spacing must be greater than 0 mm, not {spacing}")
        laser = self.laser_mm
        if laser is not None and (
            len(laser) != 3 or any(isinf(value) for value in laser) or sum(not isfinite(value) for value in laser) > 1
        ):
            raise OptionRefused(f"a laser position is x,y,z in millimetres with at most one of them open, not {laser}")


@dataclass(frozen=True, slots=True)
class Recording:
    """The scanlines of a file, in the order they were taken.

    Each line's `points_mm` has one row for every place of the line, NaN where there is no point. `line_spacing_mm` is
    the nominal spacing (the median, where lines have their own), `point_spacing_mm` the median distance of consecutive
    points along the lines (NaN when no line has two). `points_declared` is what the file holds, and
    `points_declared == points + sum(dropped.values())`, each dropped point under exactly one reason: `not_finite`,
    `unreferenced` (no cell of the range grid names it), `place_taken` (its cell already holds a point), `dropout`
    (a row of a table that says itself that there was no return). `notes` are sentences: what was derived, and how.
    """

    source: str
    format: str
    lines: tuple[Scanline, ...]
    points: int
    points_declared: int
    line_spacing_mm: float
    point_spacing_mm: float
    dropped: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Cloud:
    """The points of a file without their scanlines.

    `points_mm` (n, 3) are finite; `normals` (n, 3) are the file's own, of any length and possibly NaN, or None;
    `normals_of` says whose they are, by the file's header.
    `points_declared == len(points_mm) + sum(dropped.values())`.
    """

    source: str
    format: str
    points_mm: Float64Array
    normals: Float64Array | None
    points_declared: int
    dropped: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    normals_of: NormalsOf = "file"

    def __post_init__(self) -> None:
        read_only(self.points_mm)
        if self.normals is not None:
            read_only(self.normals)


def finite_rows(points_mm: Float64Array) -> BoolArray:
    """True where a row of (n, 3) has three finite coordinates."""
    return np.asarray(np.isfinite(points_mm).all(axis=1))
