"""LAS and LAZ files (ASPRS LAS 1.0 to 1.4) as clouds; every declared size is compared with the file before it is used.

The header and the points are read here; lazrs unpacks LAZ, a bounded number of points at a time.
"""

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array
from scanner_service.storage.formats.clouds import cloud_from
from scanner_service.storage.formats.errors import (
    ContentDamaged,
    FileEmpty,
    FileTooLarge,
    FileTruncated,
    HeaderDamaged,
    LibraryAbsent,
)
from scanner_service.storage.formats.recording import Cloud, Units
from scanner_service.storage.formats.units import UnitAndWhy, given_or_named

_POINT_BYTES = {0: 20, 1: 28, 2: 26, 3: 34, 4: 57, 5: 63, 6: 30, 7: 36, 8: 38, 9: 59, 10: 67}
_EXTRA_TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "u8", 8: "i8", 9: "f4", 10: "f8"}
_EXTRA_BYTES, _LASZIP, _OURS = ("LASF_Spec", 4), ("laszip encoded", 22204), ("scanner_service", 1)
_BLOCK_POINTS = 1 << 16
_MOST_UNPACKED = 1000  # times the file's size; scans come out 3 to 30 times as large
_METRES: UnitAndWhy = (
    "m",
    "lengths are read as metres, as LAS files usually are; give the units if they are not",
)
_LAYERED = 3
_LAYERS_OF_ITEM = {
    10: 9,
    11: 1,
    12: 2,
    13: 1,
}  # point, colour, colour and infrared, wave packet; extra bytes: one a byte
Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class LasHeader:
    """What a header declares, checked against the size of the file; `notes` are variable length records by key."""

    points: int
    point_format: int
    point_bytes: int
    points_at: int
    is_packed: bool
    scale: Float64Array
    offset: Float64Array
    notes: dict[tuple[str, int], bytes]


def is_las(head: bytes) -> bool:
    """True when the content begins like a LAS or LAZ file."""
    return head.startswith(b"LASF")


def read_las(path: Path, units: Units | None, max_bytes: int) -> Cloud:
    """Read the points of a LAS or LAZ file, and the normals in its extra bytes NormalX, NormalY, NormalZ.

    Lengths are metres unless the file is our own, which says millimetres.

    Raises
    ------
    FormatError : in one of its kinds, with one sentence that says what is wrong.
    """
    name = path.name
    with path.open("rb") as file:
        size = path.stat().st_size
        header = _header(file, size, name)
        if header.points == 0:
            raise FileEmpty(f"{name} declares no point: there is nothing to read")
        if header.points * header.point_bytes > max_bytes:
            raise FileTooLarge(f"{name} declares {header.points} points, which take more than {max_bytes} bytes")
        places = _normal_places(header, name)
        file.seek(header.points_at)
        unpack = _unpacker(file, header, size, name) if header.is_packed else None
        points: list[Float64Array] = []
        normals: list[Float64Array] = []
        left = header.points
        while left:
            count = min(left, _BLOCK_POINTS)
            rows = _rows(file, header, count, name) if unpack is None else unpack(count)
            whole = rows[:, :12].copy().view("<i4").astype(np.float64)
            with np.errstate(over="ignore", invalid="ignore"):  # damaged scales; infinite points are counted as such
                points.append(whole * header.scale + header.offset)
            if places:
                parts = [rows[:, at : at + int(kind[1:])].copy().view(f"<{kind}") for at, kind in places]
                with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
                    normals.append(np.concatenate(parts, axis=1).astype(np.float64))
            left -= count
    ours = ["units mm"] if _OURS in header.notes else []
    return cloud_from(
        name,
        "laz" if header.is_packed else "las",
        np.concatenate(points),
        np.concatenate(normals) if normals else None,
        given_or_named(units, ours) or _METRES,
    )


def _header(file: BinaryIO, size: int, name: str) -> LasHeader:
    head = file.read(375)
    if len(head) < 227:
        raise FileTruncated(f"{name} is cut short: its LAS header is not complete")
    major, minor = head[24], head[25]
    header_bytes, points_at, note_count, kind, point_bytes, points = struct.unpack_from("<HIIBHI", head, 94)
    if major != 1 or minor > 4 or header_bytes < (375 if minor == 4 else 235 if minor == 3 else 227):
        raise HeaderDamaged(f"{name}: LAS {major}.{minor} with a header of {header_bytes} bytes is not known here")
    if minor == 4 and len(head) == 375:
        points = struct.unpack_from("<Q", head, 247)[0] or points
    is_packed, point_format = kind & 0xC0 != 0, kind & 0x3F
    if point_bytes < _POINT_BYTES.get(point_format, 1 << 16):
        raise HeaderDamaged(f"{name}: points of format {point_format} do not fit {point_bytes} bytes")
    scale, offset = np.array(struct.unpack_from("<3d", head, 131)), np.array(struct.unpack_from("<3d", head, 155))
    if not (np.isfinite(scale).all() and np.isfinite(offset).all() and (scale != 0).all()):
        raise HeaderDamaged(f"{name}: the scale and offset of its coordinates are no numbers")
    if not header_bytes <= points_at <= size:
        raise FileTruncated(
            f"{name} is cut short or its header is wrong: its points begin at byte {points_at} of {size}"
        )
    notes = _notes(file, header_bytes, points_at, note_count, name)
    if not is_packed and points * point_bytes > size - points_at:
        raise FileTruncated(
            f"{name} is cut short or its header is wrong: {points} points are declared and need {points * point_bytes} "
            f"bytes, and {size - points_at} are there"
        )
    return LasHeader(points, point_format, point_bytes, points_at, is_packed, scale, offset, notes)


def _notes(file: BinaryIO, start: int, end: int, count: int, name: str) -> dict[tuple[str, int], bytes]:
    """The variable length records between the header and the points."""
    wrong = HeaderDamaged(f"{name}: its {count} variable length records do not fit in front of the points")
    if count * 54 > end - start:
        raise wrong
    file.seek(start)
    body = file.read(end - start)
    notes, at = {}, 0
    for _ in range(count):
        if at + 54 > len(body):
            raise wrong
        user, record, length = struct.unpack_from("<2x16sHH", body, at)
        at += 54
        if at + length > len(body):
            raise wrong
        notes[(user.split(b"\0")[0].decode("latin-1"), record)] = body[at : at + length]
        at += length
    return notes


def _normal_places(header: LasHeader, name: str) -> list[tuple[int, str]]:
    """Where in a point the parts of its normal lie, and of which type; nothing when there is none."""
    described = header.notes.get(_EXTRA_BYTES, b"")
    at = _POINT_BYTES[header.point_format]
    found: dict[str, tuple[int, str]] = {}
    for start in range(0, len(described) - len(described) % 192, 192):
        kind, options = described[start + 2], described[start + 3]
        label = described[start + 4 : start + 36].split(b"\0")[0].decode("latin-1")
        if kind == 0:
            width = options
        elif kind in _EXTRA_TYPES:
            width = int(_EXTRA_TYPES[kind][1:])
            if kind in (9, 10) and not options & 0x18:  # a scaled one would need its scale
                found[label] = (at, _EXTRA_TYPES[kind])
        elif kind <= 30:
            width = int(_EXTRA_TYPES[(kind - 1) % 10 + 1][1:]) * ((kind - 1) // 10 + 1)
        else:
            raise HeaderDamaged(f"{name}: its extra bytes have the unknown type {kind}")
        at += width
    if at > header.point_bytes:
        raise HeaderDamaged(f"{name}: its extra bytes need {at} bytes a point, and a point has {header.point_bytes}")
    places = [found.get(f"Normal{axis}") for axis in "XYZ"]
    return [place for place in places if place is not None] if all(places) else []


def _rows(file: BinaryIO, header: LasHeader, count: int, name: str) -> Bytes:
    data = file.read(count * header.point_bytes)
    if len(data) < count * header.point_bytes:
        raise FileTruncated(f"{name} is cut short: it ends within its points")
    return np.frombuffer(data, dtype=np.uint8).reshape(count, header.point_bytes)


def _unpacker(file: BinaryIO, header: LasHeader, size: int, name: str) -> Any:
    """A function that unpacks the next points, after the sizes that lazrs would believe have been checked."""
    note = header.notes.get(_LASZIP)
    if note is None or len(note) < 34:
        raise HeaderDamaged(f"{name}: its points are packed, and it does not say how (no LASzip record)")
    (items,) = struct.unpack_from("<H", note, 32)
    if len(note) != 34 + 6 * items:
        raise HeaderDamaged(f"{name}: its LASzip record declares {items} items and has {len(note)} bytes")
    sizes = [struct.unpack_from("<H", note, 34 + 6 * item + 2)[0] for item in range(items)]
    if sum(sizes) != header.point_bytes:
        raise HeaderDamaged(
            f"{name}: its LASzip record describes points of {sum(sizes)} bytes, not {header.point_bytes}"
        )
    if header.points * header.point_bytes > _MOST_UNPACKED * size:
        raise FileTruncated(
            f"{name} is cut short or its header is wrong: {header.points} points are declared, and {size} bytes can "
            "hardly hold them; write it as LAS if it is right"
        )
    table_at = _check_chunk_table(file, header, size, name)
    try:
        import lazrs  # noqa: PLC0415 - an extra
    except ImportError:
        raise LibraryAbsent(
            f"{name} is packed, and lazrs, which unpacks it, is not installed: in the checkout, run "
            "`.venv/bin/pip install -e '.[las]'`"
        ) from None
    if struct.unpack_from("<H", note)[0] == _LAYERED:
        _check_layers(file, header, note, table_at, lazrs, name)
    file.seek(header.points_at)
    with _refusing(name):
        source = lazrs.LasZipDecompressor(file, note)

    def unpack(count: int) -> Bytes:
        out = np.zeros((count, header.point_bytes), dtype=np.uint8)
        with _refusing(name):
            source.decompress_many(out.reshape(-1))
        return out

    return unpack


@contextmanager
def _refusing(name: str) -> Iterator[None]:
    """Say in one sentence what lazrs refuses; its panics are not even an Exception."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:
        raise ContentDamaged(f"{name}: its packed points are damaged or cut short") from error


def _check_chunk_table(file: BinaryIO, header: LasHeader, size: int, name: str) -> int:
    """Where the table is that says how many chunks there are; each holds at least one point as it is."""
    wrong = FileTruncated(f"{name} is cut short or damaged: its table of chunks is not where it should be")
    file.seek(header.points_at)
    place = file.read(8)
    if len(place) < 8:
        raise wrong
    (table_at,) = struct.unpack("<q", place)
    if table_at == -1:
        file.seek(size - 8)
        (table_at,) = struct.unpack("<q", file.read(8))
    if not header.points_at + 8 <= table_at <= size - 8:
        raise wrong
    file.seek(table_at)
    _, chunks = struct.unpack("<II", file.read(8))
    if chunks * header.point_bytes > table_at - header.points_at:
        raise wrong
    return int(table_at)


def _check_layers(file: BinaryIO, header: LasHeader, note: bytes, table_at: int, lazrs: Any, name: str) -> None:
    """Every chunk of a newer LAZ file says how long its layers are, and lazrs makes room for as much."""
    wrong = ContentDamaged(f"{name}: its packed points are damaged or cut short")
    layers = 0
    for at in range(34, len(note), 6):
        kind, width = struct.unpack_from("<HH", note, at)
        layers += width if kind == 14 else _LAYERS_OF_ITEM.get(kind, 0)
    file.seek(header.points_at)
    with _refusing(name):
        table = lazrs.read_chunk_table(file, lazrs.LazVlr(note)) or ()
    at = header.points_at + 8
    if sum(chunk_bytes for _, chunk_bytes in table) != table_at - at:
        raise wrong
    for _, chunk_bytes in table:
        file.seek(at + header.point_bytes + 4)
        sizes = file.read(4 * layers)
        if len(sizes) < 4 * layers:
            raise wrong
        if sum(struct.unpack(f"<{layers}I", sizes)) + len(sizes) + 4 + header.point_bytes > chunk_bytes:
            raise wrong
        at += chunk_bytes
