"""Open a file as scanlines or as a plain cloud, told by its content and not by its name alone."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from scanner_service.storage.formats.csv_profiles import read_csv_cloud, read_csv_recording
from scanner_service.storage.formats.csv_table import is_profile_header
from scanner_service.storage.formats.e57 import is_e57, read_e57
from scanner_service.storage.formats.errors import (
    FileEmpty,
    FileNotReadable,
    FileTooLarge,
    FormatUnknown,
    NoScanlines,
)
from scanner_service.storage.formats.joescan import is_joescan, read_joescan
from scanner_service.storage.formats.las import is_las, read_las
from scanner_service.storage.formats.pcd import is_pcd, read_pcd
from scanner_service.storage.formats.ply import cloud_of, read_vertices
from scanner_service.storage.formats.ply_header import is_ply
from scanner_service.storage.formats.range_grid import recording_of_grid
from scanner_service.storage.formats.recording import Cloud, ReadOptions, Recording
from scanner_service.storage.formats.xyz import names_of_line, read_xyz

Kind = Literal["ply", "pcd", "las", "e57", "joescan", "csv profiles", "xyz", "record"]
_HEAD_BYTES = 1 << 16


def open_recording(path: Path, options: ReadOptions | None = None) -> Recording:
    """Read the scanlines of a file: PLY with a range grid, or a profile table (CSV).

    Raises
    ------
    FormatError : in one of its kinds; the message is one sentence that says what is wrong and what to do.
    """
    options = options or ReadOptions()
    kind = _kind_of_file(path, options)
    if kind in ("pcd", "las", "e57"):
        raise _plain_cloud(path.name)
    data = _content(path, options)
    if kind == "ply":
        vertices = read_vertices(data, path.name, options.units)
        if vertices.grid is None:
            raise _plain_cloud(path.name, " (no range_grid)")
        return recording_of_grid(vertices, path.name, options)
    if kind == "csv profiles":
        return read_csv_recording(_text(data, path.name), path.name, options)
    if kind == "joescan":
        return read_joescan(data, path.name, options)
    if kind == "xyz":
        raise _plain_cloud(path.name)
    raise _is_a_record(path.name)


def open_cloud(path: Path, options: ReadOptions | None = None) -> Cloud:
    """Read the points of a file without their scanlines: PLY, PCD, LAS, LAZ, E57, XYZ text, or a profile table (CSV).

    Raises
    ------
    FormatError : in one of its kinds; the message is one sentence that says what is wrong and what to do.
    """
    options = options or ReadOptions()
    kind = _kind_of_file(path, options)
    if kind in ("las", "e57"):
        with _readable(path):
            return (read_las if kind == "las" else read_e57)(path, options.units, options.max_bytes)
    data = _content(path, options)
    if kind == "pcd":
        return read_pcd(data, path.name, options.units)
    if kind == "ply":
        return cloud_of(read_vertices(data, path.name, options.units), path.name)
    if kind == "csv profiles":
        return read_csv_cloud(_text(data, path.name), path.name, options)
    if kind == "xyz":
        return read_xyz(data, path.name, options.units)
    if kind == "joescan":
        raise FormatUnknown(f"{path.name} is a recording of profiles with an encoder, not a cloud; replay it")
    raise _is_a_record(path.name)


def kind_of_content(head: bytes, name: str) -> Kind:
    """Tell the format from the first bytes of a file.

    Raises
    ------
    FileEmpty : there is nothing.
    FormatUnknown : it is of no kind that is read here.
    """
    if head.startswith(b"SQLite format 3\x00"):
        return "record"
    if is_ply(head):
        return "ply"
    if is_joescan(head):
        return "joescan"
    if is_las(head):
        return "las"
    if is_e57(head):
        return "e57"
    if is_pcd(head):
        return "pcd"
    if not head.strip():
        raise FileEmpty(f"{name} is empty: there is nothing to read")
    unknown = FormatUnknown(
        f"{name} is none of the kinds that are read: PLY, PCD, LAS, LAZ, E57, profile table (CSV with columns line, "
        "x_mm, y_mm, z_mm), text cloud (x y z)"
    )
    if b"\x00" in head:
        raise unknown
    for line in head.removeprefix(b"\xef\xbb\xbf").decode("latin-1").splitlines():
        plain = line.strip()
        if is_profile_header(plain):
            return "csv profiles"
        if names_of_line(plain) is not None:
            return "xyz"
        if not plain or plain.startswith(("#", "//", ";")):
            continue
        first = plain.replace(",", " ").replace(";", " ").split()
        try:
            float(first[0] if first else "none")
        except ValueError:
            raise unknown from None
        return "xyz"
    return "xyz"


def _plain_cloud(name: str, why: str = "") -> NoScanlines:
    return NoScanlines(
        f"{name} is a plain cloud without scanlines{why}, which cannot be played: analyse it as a cloud, "
        "with `scanner analyse` or over REST (POST /api/v1/analyses), which also give it back as a PLY"
    )


def _is_a_record(name: str) -> FormatUnknown:
    return FormatUnknown(f"{name} is a record of this service; open it as a record and choose a session")


def _kind_of_file(path: Path, options: ReadOptions) -> Kind:
    """The format of a file that can be read and is not too large."""
    with _readable(path):
        size = path.stat().st_size
        if not path.is_file():
            raise FileNotReadable(f"{path} is not a file; give the path of a scan")
        if size > options.max_bytes:
            raise FileTooLarge(f"{path.name} has {size} bytes; at most {options.max_bytes} are read")
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    return kind_of_content(head, path.name)


def _content(path: Path, options: ReadOptions) -> bytes:
    with _readable(path):
        data = path.read_bytes()
    if len(data) > options.max_bytes:  # it grew meanwhile
        raise FileTooLarge(f"{path.name} has more than {options.max_bytes} bytes, which is as much as is read")
    return data


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Say in one sentence what the file system refuses."""
    try:
        yield
    except FileNotFoundError:
        raise FileNotReadable(f"{path} does not exist; check the path") from None
    except PermissionError:
        raise FileNotReadable(f"{path} may not be read by this user") from None
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL
        raise FileNotReadable(f"{path} cannot be read: {error}") from None


def _text(data: bytes, name: str) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatUnknown(f"{name} is not UTF-8 text (byte {error.start}); save it as UTF-8") from None
