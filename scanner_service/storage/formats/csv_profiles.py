"""Profile tables (CSV) as scanlines: rows are points, grouped by device, pass and line; knows no text.

The rows of a line may stand anywhere in the file. Lines come out in the order of their time where every line has one,
otherwise by device, pass and line number.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import nan

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array, Scanline
from scanner_service.storage.formats.csv_table import LASER, ProfileTable, read_table
from scanner_service.storage.formats.errors import (
    ContentDamaged,
    FileEmpty,
    FileTooLarge,
    LaserUnknown,
    OptionRefused,
    SpacingUnknown,
)
from scanner_service.storage.formats.laser_position import laser_of_lines, shown_laser
from scanner_service.storage.formats.parallel_lines import ParallelLines, fit_parallel_lines
from scanner_service.storage.formats.recording import Cloud, ReadOptions, Recording, finite_rows
from scanner_service.storage.formats.spacing import median_point_spacing_mm
from scanner_service.storage.formats.text_numbers import CUT_NOTE

Int64Array = npt.NDArray[np.int64]
_PLACES_PER_ROW = 64  # an index column may leave this many empty places a row, on the average
_MOST_EMPTY = 1 << 20


@dataclass(frozen=True, slots=True)
class _Groups:
    """Rows of a table by line: `line` (n,) is a row of `device`, `passes`, `number` and `time_s` (L,)."""

    line: Int64Array
    device: Int64Array
    passes: Int64Array
    number: Int64Array
    time_s: Float64Array
    first_row: Int64Array


def read_csv_recording(text: str, name: str, options: ReadOptions) -> Recording:
    """Read a profile table as scanlines.

    Raises
    ------
    ContentDamaged : rows of one line disagree about it, or two claim one place; the message names the row.
    LaserUnknown, SpacingUnknown : neither in the table, nor given, nor derivable.
    FileEmpty : not one row has a finite point.
    OptionRefused : units other than millimetres.
    """
    _refuse_other_units(name, options)
    table = read_table(text, name, options.device_id or name.rsplit(".", 1)[0])
    points = _points(table)
    finite, dropped = _kept(points)
    if not finite.any():
        raise FileEmpty(f"{name} holds no point with finite coordinates: there is nothing to replay")
    groups = _grouped(table)
    place = _places(table, groups, name)
    length = np.zeros(len(groups.number), dtype=np.int64)
    np.maximum.at(length, groups.line, place + 1)
    if length.sum() > _PLACES_PER_ROW * len(place) + _MOST_EMPTY:
        raise FileTooLarge(
            f"{name}: its index column leaves {int(length.sum()) - len(place)} places empty around {len(place)} rows"
        )
    fits = list(_fits(points, finite, groups))
    laser, laser_note = _lasers(table, groups, fits, options, name)
    spacing, spacing_note = _spacings(table, groups, fits, options, name)
    index, index_note = _line_indices(groups)
    cut_note = "" if text.endswith(("\n", "\r")) else CUT_NOTE
    starts = np.cumsum(length) - length
    flat = np.full((int(length.sum()), 3), nan)
    flat[starts[groups.line[finite]] + place[finite]] = points[finite]
    lines: list[Scanline] = []
    unknown = np.full(3, nan)
    position, step, normals = _positions(groups, fits)
    for row in range(len(groups.number)):
        direction = normals[row] if np.isfinite(normals[row]).all() else unknown
        lines.append(
            Scanline(
                device_id=table.devices[groups.device[row]],
                boot_id=0,
                pass_index=int(groups.passes[row]),
                line_index=int(index[row]),
                device_time_s=float(groups.time_s[row]),
                points_mm=flat[starts[row] : starts[row] + length[row]],
                missing=np.zeros(length[row], dtype=np.bool_),
                laser_mm=laser[row],
                plane_normal=direction,
                travel=direction,
                position_mm=float(position[row]),
                line_spacing_mm=float(spacing[row]),
                step_mm=float(step[row]),
            )
        )
    return Recording(
        source=name,
        format="csv profiles",
        lines=tuple(lines),
        points=int(finite.sum()),
        points_declared=len(finite),
        line_spacing_mm=float(np.median(spacing)),
        point_spacing_mm=median_point_spacing_mm(line.points_mm for line in lines),
        dropped=dropped,
        notes=tuple(note for note in (laser_note, spacing_note, index_note, cut_note) if note),
    )


def read_csv_cloud(text: str, name: str, options: ReadOptions) -> Cloud:
    """The points of a profile table without their lines.

    Raises
    ------
    FileEmpty : not one row has a finite point.
    OptionRefused : units other than millimetres.
    """
    _refuse_other_units(name, options)
    points = _points(read_table(text, name, options.device_id or "cloud"))
    finite, dropped = _kept(points)
    if not finite.any():
        raise FileEmpty(f"{name} holds no point with finite coordinates: there is nothing to analyse")
    notes = ("the table's scanlines are left aside: it is read as a plain cloud",)
    return Cloud(name, "csv profiles", points[finite], None, len(finite), dropped, notes)


def _refuse_other_units(name: str, options: ReadOptions) -> None:
    if options.units not in (None, "auto", "mm"):
        raise OptionRefused(f"{name} names its columns x_mm, y_mm, z_mm: they are millimetres, not {options.units}")


def _points(table: ProfileTable) -> Float64Array:
    return np.stack([table.columns[column] for column in ("x_mm", "y_mm", "z_mm")], axis=1)


def _kept(points: Float64Array) -> tuple[npt.NDArray[np.bool_], dict[str, int]]:
    finite = finite_rows(points)
    dropout = int(np.isnan(points).all(axis=1).sum())
    dropped = {"dropout": dropout, "not_finite": int((~finite).sum()) - dropout}
    return finite, {reason: count for reason, count in dropped.items() if count}


def _grouped(table: ProfileTable) -> _Groups:
    keys = np.stack([table.device, table.whole("pass"), table.whole("line")], axis=1)
    unique, first, line = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    line = line.reshape(-1)
    time = table.columns.get("time_s", np.full(len(line), nan))[first]
    order = np.arange(len(unique))
    if np.isfinite(time).all():
        order = np.lexsort((unique[:, 2], unique[:, 1], unique[:, 0], time))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    unique = unique[order]
    return _Groups(rank[line], unique[:, 0], unique[:, 1], unique[:, 2], time[order], first[order])


def _places(table: ProfileTable, groups: _Groups, name: str) -> Int64Array:
    """The place of each row in its line: the index column, or the order of the rows."""
    order = np.argsort(groups.line, kind="stable")
    if "index" not in table.columns:
        count = np.bincount(groups.line)
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
        return place
    place = table.whole("index")
    order = np.lexsort((place, groups.line))
    twice = (np.diff(groups.line[order]) == 0) & (np.diff(place[order]) == 0)
    if twice.any():
        row = order[int(np.argmax(twice)) + 1]
        raise ContentDamaged(
            f"{name}: row {table.row_number[row]} gives index {place[row]} of its line to a second point"
        )
    return place


def _fits(
    points: Float64Array, finite: npt.NDArray[np.bool_], groups: _Groups
) -> Iterator[tuple[Int64Array, ParallelLines | None]]:
    """For each pass of each device: its lines (rows of the groups), and the parallel planes fitted to them."""
    passes, pass_of = np.unique(np.stack([groups.device, groups.passes], axis=1), axis=0, return_inverse=True)
    pass_of = pass_of.reshape(-1)
    for number in range(len(passes)):
        members = np.flatnonzero(pass_of == number)
        local = np.full(len(groups.number), -1, dtype=np.int64)
        local[members] = np.arange(len(members))
        rows = finite & (local[groups.line] >= 0)
        yield members, fit_parallel_lines(points[rows], local[groups.line[rows]], groups.number[members])


def _lasers(
    table: ProfileTable,
    groups: _Groups,
    fits: list[tuple[Int64Array, ParallelLines | None]],
    options: ReadOptions,
    name: str,
) -> tuple[Float64Array, str]:
    if options.laser_mm is not None:
        laser = np.empty((len(groups.number), 3))
        for members, fit in fits:
            laser[members] = laser_of_lines(options.laser_mm, fit, len(members), name)
        instead = " instead of the table's own" if LASER[0] in table.columns else ""
        return laser, f"laser position {shown_laser(options.laser_mm)}, as given{instead}"
    if LASER[0] not in table.columns:
        raise LaserUnknown(
            f"{name} does not say where the laser stood; add columns {', '.join(LASER)} or give --laser x,y,z"
        )
    rows = np.stack([table.columns[column] for column in LASER], axis=1)
    _refuse_disagreement(rows, "another laser position", table, groups, name)
    return rows[groups.first_row], ""


def _spacings(
    table: ProfileTable,
    groups: _Groups,
    fits: list[tuple[Int64Array, ParallelLines | None]],
    options: ReadOptions,
    name: str,
) -> tuple[Float64Array, str]:
    if options.line_spacing_mm is not None:
        instead = " instead of the table's own" if "line_spacing_mm" in table.columns else ""
        note = f"line spacing {options.line_spacing_mm} mm, as given{instead}"
        return np.full(len(groups.number), options.line_spacing_mm), note
    if "line_spacing_mm" in table.columns:
        rows = table.columns["line_spacing_mm"]
        _refuse_disagreement(rows[:, None], "another line spacing", table, groups, name)
        return rows[groups.first_row], ""
    spacing = np.empty(len(groups.number))
    found = []
    for members, fit in fits:
        if fit is None:
            raise SpacingUnknown(
                f"{name}: the lines of pass {groups.passes[members[0]]} do not advance evenly, so their spacing cannot "
                "be derived; add a column line_spacing_mm or give it in millimetres with --line-spacing"
            )
        spacing[members] = fit.spacing_mm
        found.append(fit.spacing_mm)
    note = f"line spacing {found[0]:.4f} mm, fitted to the places of the lines"
    if len(found) > 1:
        note = f"line spacing {min(found):.4f} to {max(found):.4f} mm in {len(found)} passes, fitted to their lines"
    return spacing, note


def _refuse_disagreement(rows: Float64Array, what: str, table: ProfileTable, groups: _Groups, name: str) -> None:
    differs = (rows != rows[groups.first_row[groups.line]]).any(axis=1)
    if differs.any():
        row = int(np.argmax(differs))
        number = groups.number[groups.line[row]]
        raise ContentDamaged(f"{name}: row {table.row_number[row]} gives line {number} {what} than its first row")


def _line_indices(groups: _Groups) -> tuple[Int64Array, str]:
    """Line numbers that are unique for each device: where passes count from anew, they are numbered through."""
    pairs = np.stack([groups.device, groups.number], axis=1)
    if len(np.unique(pairs, axis=0)) == len(pairs):
        return groups.number, ""
    index = groups.number.copy()
    for device in np.unique(groups.device):
        ahead = 0
        for passes in np.unique(groups.passes[groups.device == device]):
            members = (groups.device == device) & (groups.passes == passes)
            index[members] += ahead
            ahead = int(index[members].max()) + 1
    return index, "line numbers begin anew in each pass; they are numbered through"


def _positions(
    groups: _Groups, fits: list[tuple[Int64Array, ParallelLines | None]]
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Place along the travel, step to the line before it (by number) and plane normal of every line, NaN if unknown."""
    lines = len(groups.number)
    position, step, normals = np.full(lines, nan), np.full(lines, nan), np.full((lines, 3), nan)
    for members, fit in fits:
        if fit is None:
            continue
        position[members] = fit.position_mm
        normals[members] = fit.normal
        by_number = np.argsort(groups.number[members])
        step[members[by_number]] = np.diff(fit.position_mm[by_number], prepend=nan)
    return position, step, normals
