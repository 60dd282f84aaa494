"""Range grids (PLY with `range_grid`) as scanlines: one column, or row, is one line; knows no bytes.

A range grid is an image of num_rows x num_cols cells, stored row by row, each naming the vertex seen there or none.
Every vertex of the file leaves here exactly once: at its place in a line, or counted under one reason.
"""

from dataclasses import dataclass
from math import nan

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array, Scanline
from scanner_service.storage.formats.errors import (
    FileEmpty,
    FileTooLarge,
    HeaderDamaged,
    LaserUnknown,
    SpacingUnknown,
)
from scanner_service.storage.formats.laser_position import laser_of_lines, shown_laser
from scanner_service.storage.formats.parallel_lines import ParallelLines, fit_parallel_lines
from scanner_service.storage.formats.ply import PlyVertices, is_cyberware
from scanner_service.storage.formats.ply_body import Ragged
from scanner_service.storage.formats.recording import ReadOptions, Recording
from scanner_service.storage.formats.spacing import median_point_spacing_mm

Int64Array = npt.NDArray[np.int64]

# A Cyberware 3030 looks along -z; its laser travels with the column at this height and distance.
CYBERWARE_LASER_Y_MM = 178.0
CYBERWARE_LASER_Z_MM = 1330.0
MAX_LINES = 1 << 18


@dataclass(frozen=True, slots=True)
class _Placed:
    """Where each kept vertex lies: `vertex`, `line` and `place` (k,); `dropped` counts the others by reason."""

    vertex: Int64Array
    line: Int64Array
    place: Int64Array
    lines: int
    places: int
    dropped: dict[str, int]
    notes: tuple[str, ...]


def recording_of_grid(vertices: PlyVertices, name: str, options: ReadOptions) -> Recording:
    """Turn a range grid into scanlines.

    Columns follow each other as lines in their order, points within a line in the order of the rows; a cell without a
    vertex is a row of NaN. Laser position, line spacing, travel and laser plane are the options', or derived, and a
    note says how.

    Raises
    ------
    HeaderDamaged : the grid's rows and columns are not declared, or do not multiply to its cells.
    FileEmpty : no cell holds a finite vertex.
    LaserUnknown, SpacingUnknown : neither given nor derivable.
    """
    grid = vertices.grid
    if grid is None:
        raise HeaderDamaged(f"{name} has no range grid")
    placed = _place(vertices, grid, name, options)
    if not len(placed.vertex):
        raise FileEmpty(f"no cell of the range grid of {name} holds a finite vertex: there is nothing to replay")
    points = vertices.points_mm[placed.vertex]
    interlaced = options.line_along == "column" and vertices.header.obj_info.get("is_interlaced", "0").strip() == "1"
    odd = placed.place % 2 == 1 if interlaced else None
    fit = fit_parallel_lines(points, placed.line, np.arange(placed.lines), odd)
    notes = [*vertices.notes, *placed.notes, *_notes_of_fit(fit, options)]
    spacing_mm = _line_spacing(fit, options, name)
    laser_mm, laser_note = _laser_positions(fit, vertices, points, placed.lines, options, name)
    notes.append(laser_note)
    table = np.full((placed.lines, placed.places, 3), nan)
    table[placed.line, placed.place] = points
    empty = placed.lines - len(np.unique(placed.line))
    if empty:
        notes.append(
            f"{empty} of {placed.lines} {options.line_along}s hold no point and are scanlines without a return"
        )
    device = options.device_id or ("cyberware" if is_cyberware(vertices.header) else name.rsplit(".", 1)[0])
    return Recording(
        source=name,
        format="ply range_grid",
        lines=tuple(_scanlines(table, fit, laser_mm, spacing_mm, device)),
        points=len(points),
        points_declared=len(vertices.points_mm),
        line_spacing_mm=spacing_mm,
        point_spacing_mm=median_point_spacing_mm(table),
        dropped=placed.dropped,
        notes=tuple(notes),
    )


def _place(vertices: PlyVertices, grid: Ragged, name: str, options: ReadOptions) -> _Placed:
    """Give each vertex its cell: the first cell that names it, the first vertex of a cell."""
    rows, columns = _shape(vertices, len(grid.counts), name)
    lines, places = (columns, rows) if options.line_along == "column" else (rows, columns)
    if lines > MAX_LINES:
        raise FileTooLarge(f"{name} declares {lines} scanlines; at most {MAX_LINES} are read from one range grid")
    cell = np.repeat(np.arange(len(grid.counts)), grid.counts)
    named = grid.values.astype(np.int64)
    leads = np.ones(len(cell), dtype=np.bool_)  # the first vertex that its cell names
    leads[1:] = cell[1:] != cell[:-1]
    vertex, first = np.unique(named[leads], return_index=True)
    cell_of = cell[leads][first]
    finite = vertices.finite
    count = len(vertices.points_mm)
    has_place = np.zeros(count, dtype=np.bool_)
    has_place[vertex] = True
    is_named = np.zeros(count, dtype=np.bool_)
    is_named[named] = True
    dropped = {
        "not_finite": int((~finite).sum()),
        "unreferenced": int((finite & ~is_named).sum()),
        "place_taken": int((finite & is_named & ~has_place).sum()),
    }
    again = len(named) - int(is_named.sum())
    notes = (f"{again} cells name a vertex that an earlier cell has named: the earlier one holds it",) if again else ()
    kept = finite[vertex]
    row, column = np.divmod(cell_of[kept], columns)
    line, place = (column, row) if options.line_along == "column" else (row, column)
    return _Placed(vertex[kept], line, place, lines, places, {k: v for k, v in dropped.items() if v}, notes)


def _shape(vertices: PlyVertices, cells: int, name: str) -> tuple[int, int]:
    shape = []
    for key in ("num_rows", "num_cols"):
        text = vertices.header.obj_info.get(key, "")
        if not (text.isascii() and text.isdigit() and len(text) < 10 and int(text) > 0):
            raise HeaderDamaged(f"{name}: the range grid needs a line 'obj_info {key} N' in the PLY header")
        shape.append(int(text))
    if shape[0] * shape[1] != cells:
        raise HeaderDamaged(
            f"{name}: the header says {shape[0]} rows of {shape[1]} columns, but the range grid has {cells} cells"
        )
    return shape[0], shape[1]


def _notes_of_fit(fit: ParallelLines | None, options: ReadOptions) -> list[str]:
    if fit is None:
        return [
            f"the {options.line_along}s lie on no parallel planes: laser plane, travel and place of a line are unknown"
        ]
    normal = ", ".join(f"{value:.4g}" for value in fit.normal)
    notes = [f"laser planes and travel along ({normal}), fitted to the {options.line_along}s"]
    if options.line_spacing_mm is None:
        notes.append(
            f"line spacing {fit.spacing_mm:.4f} mm, fitted to the places of the {options.line_along}s; rows interlaced "
            f"by {fit.half_line_mm:.4f} mm count as one line"
            if fit.half_line_mm
            else f"line spacing {fit.spacing_mm:.4f} mm, fitted to the places of the {options.line_along}s"
        )
    elif abs(fit.spacing_mm / options.line_spacing_mm - 1) > 0.1:
        notes.append(
            f"line spacing {options.line_spacing_mm} mm as given, although the data say {fit.spacing_mm:.4f} mm"
        )
    return notes


def _line_spacing(fit: ParallelLines | None, options: ReadOptions, name: str) -> float:
    if options.line_spacing_mm is not None:
        return options.line_spacing_mm
    if fit is None:
        raise SpacingUnknown(
            f"the line spacing of {name} cannot be derived from its {options.line_along}s; give it in millimetres with "
            "--line-spacing"
        )
    return fit.spacing_mm


def _laser_positions(
    fit: ParallelLines | None,
    vertices: PlyVertices,
    points_mm: Float64Array,
    lines: int,
    options: ReadOptions,
    name: str,
) -> tuple[Float64Array, str]:
    """The laser position of every line (L, 3), part frame, and the sentence that says where it comes from."""
    if options.laser_mm is None and not is_cyberware(vertices.header):
        raise LaserUnknown(
            f"{name} does not say where the laser stood; give its position in millimetres with --laser x,y,z"
        )
    laser = options.laser_mm or (nan, CYBERWARE_LASER_Y_MM, CYBERWARE_LASER_Z_MM)
    shown = shown_laser(laser)
    note = f"laser position {shown}, as given"
    if options.laser_mm is None:
        note = f"laser position {shown}, by the rule for Cyberware scanners; give it with --laser if it was elsewhere"
    if options.laser_mm is None and fit is None:  # one column: the laser stood in its plane
        laser = (float(np.median(points_mm[:, 0])), laser[1], laser[2])
    return laser_of_lines(laser, fit, lines, name), note


def _scanlines(
    table: Float64Array, fit: ParallelLines | None, laser_mm: Float64Array, spacing_mm: float, device: str
) -> list[Scanline]:
    lines, places, _ = table.shape
    unknown = np.full(3, nan)
    direction = fit.normal if fit is not None else unknown
    position = fit.position_mm if fit is not None else np.full(lines, nan)
    step = np.diff(position, prepend=nan)
    missing: npt.NDArray[np.bool_] = np.zeros(places, dtype=np.bool_)
    return [
        Scanline(
            device_id=device,
            boot_id=0,
            pass_index=0,
            line_index=index,
            device_time_s=nan,
            points_mm=table[index],
            missing=missing,
            laser_mm=laser_mm[index],
            plane_normal=direction,
            travel=direction,
            position_mm=float(position[index]),
            line_spacing_mm=spacing_mm,
            step_mm=float(step[index]),
        )
        for index in range(lines)
    ]
