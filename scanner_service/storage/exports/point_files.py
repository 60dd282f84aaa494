"""The formats that points are written in, by name: one table, from which CLI, API and viewer offer the same."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO

from scanner_service.storage.exports import optional
from scanner_service.storage.exports.about import About
from scanner_service.storage.exports.errors import ExtraMissing, FormatNotWritten
from scanner_service.storage.exports.point_stream import PointStream
from scanner_service.storage.exports.points_csv import write_csv
from scanner_service.storage.exports.points_e57 import write_e57
from scanner_service.storage.exports.points_las import write_las
from scanner_service.storage.exports.points_parquet import write_parquet
from scanner_service.storage.exports.points_pcd import write_pcd
from scanner_service.storage.exports.points_ply import write_ply
from scanner_service.storage.exports.whole_file import whole_file, whole_path

ToFile = Callable[[BinaryIO, PointStream, About], None]


@dataclass(frozen=True, slots=True)
class PointFormat:
    """One format: its name, which is also the ending, and what people should know of it."""

    name: str
    media_type: str
    what: str
    write: Callable[[Path, PointStream, About], None]
    needs: Callable[[], object] = lambda: None

    @property
    def file_name(self) -> str:
        """The name of the file in a folder of exports."""
        return f"points.{self.name}"

    def missing(self) -> str | None:
        """Why the format cannot be written here, as one sentence; None when it can."""
        try:
            self.needs()
        except ExtraMissing as error:
            return str(error)
        return None


def _whole(write: ToFile) -> Callable[[Path, PointStream, About], None]:
    def to_path(path: Path, stream: PointStream, about: About) -> None:
        with whole_file(path) as file:
            write(file, stream, about)

    return to_path


def _e57(path: Path, stream: PointStream, about: About) -> None:
    optional.pye57_module()  # before a file is made
    with whole_path(path) as beside:
        write_e57(beside, stream, about)


_BYTES = "application/octet-stream"
POINT_FORMATS: dict[str, PointFormat] = {
    one.name: one
    for one in (
        PointFormat("ply", _BYTES, "binary PLY, scalars as CloudCompare keeps them", _whole(write_ply)),
        PointFormat("laz", _BYTES, "compressed LAS 1.4 with extra bytes", _whole(write_las), optional.laspy_module),
        PointFormat(
            "las",
            _BYTES,
            "LAS 1.4 with extra bytes",
            _whole(partial(write_las, compressed=False)),
            optional.laspy_module,
        ),
        PointFormat("e57", _BYTES, "ASTM E2807, metres, with surface normals", _e57, optional.pye57_module),
        PointFormat("pcd", _BYTES, "binary PCD 0.7 for PCL and Open3D", _whole(write_pcd)),
        PointFormat("csv", "text/csv; charset=utf-8", "profile table, which can be replayed", _whole(write_csv)),
        PointFormat(
            "parquet", _BYTES, "columns for pandas and others", _whole(write_parquet), optional.parquet_modules
        ),
    )
}


def point_format(name: str) -> PointFormat:
    """The format of that name.

    Raises
    ------
    FormatNotWritten : there is none.
    """
    found = POINT_FORMATS.get(name)
    if found is None:
        raise FormatNotWritten(f"points are not written as {name}; the formats are {', '.join(POINT_FORMATS)}")
    return found
