"""A PLY file as vertices in millimetres with their range grid, if it has one; knows no laser and no spacing."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array
from scanner_service.storage.formats.errors import ContentDamaged, FileEmpty, HeaderDamaged
from scanner_service.storage.formats.normals_of import normals_of
from scanner_service.storage.formats.ply_body import Ragged, read_rows
from scanner_service.storage.formats.ply_header import PlyHeader, check_size, parse_header
from scanner_service.storage.formats.recording import MM_PER_UNIT, Cloud, Units, finite_rows
from scanner_service.storage.formats.text_numbers import CUT_NOTE
from scanner_service.storage.formats.units import MILLIMETRES, given_or_named

Int64Array = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PlyVertices:
    """Vertices in the order of the file: `points_mm` (n, 3), NaN and infinity as they stand there.

    `normals` (n, 3) or None; `grid` lists, for every cell, the vertices it holds, or None without a range grid.
    """

    header: PlyHeader
    points_mm: Float64Array
    normals: Float64Array | None
    grid: Ragged | None
    notes: tuple[str, ...]

    @property
    def finite(self) -> BoolArray:
        """True where a vertex has three finite coordinates."""
        return finite_rows(self.points_mm)


def read_vertices(data: bytes, name: str, units: Units | None) -> PlyVertices:
    """Read a PLY file that is whole in `data`; `name` is used in messages.

    Raises
    ------
    FormatError : in one of its kinds, with one sentence that says what is wrong.
    """
    header = parse_header(data, name)
    vertex = header.element("vertex")
    if vertex is None:
        raise HeaderDamaged(f"{name}: the PLY header declares no vertex element")
    for axis in "xyz":
        if not any(item.name == axis and item.count_type is None for item in vertex.properties):
            raise HeaderDamaged(f"{name}: the PLY header declares no vertex property {axis}")
    check_size(header, len(data) - header.body_at, name)
    if vertex.count == 0:
        raise FileEmpty(f"{name} declares no vertex: there is nothing to read")
    rows = read_rows(header, data, name)
    scalars = rows["vertex"].scalars
    unit, note = _decide_units(header, units)
    notes: tuple[str, ...] = (note,)
    if header.byte_order is None and not data.endswith((b"\n", b"\r", b" ")):
        notes += (CUT_NOTE,)
    with np.errstate(over="ignore", invalid="ignore"):
        points_mm = np.stack([scalars[axis] for axis in "xyz"], axis=1) * MM_PER_UNIT[unit]
    normals = None
    if {"nx", "ny", "nz"} <= scalars.keys():
        normals = np.stack([scalars[axis] for axis in ("nx", "ny", "nz")], axis=1)
    grid = rows["range_grid"].lists.get("vertex_indices") if "range_grid" in rows else None
    if "range_grid" in rows and grid is None:
        raise HeaderDamaged(f"{name}: the range grid has no list vertex_indices, so its cells cannot be read")
    if grid is not None:
        _check_indices(grid, vertex.count, name)
    return PlyVertices(header, points_mm, normals, grid, notes)


def cloud_of(vertices: PlyVertices, name: str) -> Cloud:
    """The vertices without their grid; those with NaN or infinite coordinates are counted as `not_finite`.

    Raises
    ------
    FileEmpty : not one vertex is finite.
    """
    kept = vertices.finite
    if not kept.any():
        raise FileEmpty(f"{name} holds no vertex with finite coordinates: there is nothing to analyse")
    lost = int((~kept).sum())
    notes = vertices.notes
    if vertices.grid is not None:
        notes += ("the file's range grid is left aside: it is read as a plain cloud",)
    return Cloud(
        source=name,
        format="ply",
        points_mm=vertices.points_mm[kept],
        normals=None if vertices.normals is None else vertices.normals[kept],
        points_declared=len(kept),
        dropped={"not_finite": lost} if lost else {},
        notes=notes,
        normals_of=normals_of(vertices.header.comments),
    )


def is_cyberware(header: PlyHeader) -> bool:
    """True when the header says that the file comes from a Cyberware scanner."""
    return header.obj_info.get("is_cyberware_data", "0").strip() not in ("", "0")


def _decide_units(header: PlyHeader, given: Units | None) -> tuple[str, str]:
    """The unit and the sentence that says why: given, named in the header, usual for the scanner, or millimetres."""
    told = given_or_named(given, (*header.comments, *(f"{key} {value}" for key, value in header.obj_info.items())))
    if told is not None:
        return told
    if is_cyberware(header) or header.element("range_grid") is not None:
        return (
            "m",
            "lengths are read as metres, as range grids of the Stanford kind are; give the units if they are not",
        )
    return MILLIMETRES


def _check_indices(grid: Ragged, vertices: int, name: str) -> None:
    values = grid.values
    bad = ~((values >= 0) & (values < vertices) & (values == np.floor(values)))
    if bad.any():
        first = int(np.argmax(bad))
        cell = int(np.searchsorted(np.cumsum(grid.counts), first, side="right"))
        raise ContentDamaged(
            f"{name}: cell {cell} of the range grid names vertex {values[first]:g}, and there are {vertices} vertices"
        )
