"""PCD files of the Point Cloud Library, version 0.7 and its forerunners; believes no size that the header declares."""

import re
import struct
from dataclasses import dataclass, replace

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.storage.formats.clouds import cloud_from
from scanner_service.storage.formats.errors import ContentDamaged, FileEmpty, FileTruncated, HeaderDamaged
from scanner_service.storage.formats.lzf import LzfDamaged, decompressed
from scanner_service.storage.formats.normals_of import normals_of
from scanner_service.storage.formats.recording import Cloud, Units
from scanner_service.storage.formats.text_numbers import CUT_NOTE, numbers_of_text
from scanner_service.storage.formats.units import MILLIMETRES, given_or_named

_MAX_HEADER_BYTES = 1 << 16
_MAX_FIELDS = 512
_KINDS = {"F": "f", "I": "i", "U": "u"}
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_START = re.compile(rb"(?:[ \t]*(?:#[^\n]*)?\r?\n)*[ \t]*(?:VERSION|FIELDS|COLUMNS)[ \t]")
_NORMAL = ("normal_x", "normal_y", "normal_z")


@dataclass(frozen=True, slots=True)
class PcdHeader:
    """What a header declares: `row` is one point (padding fields renamed), `body_at` the first byte behind it."""

    row: np.dtype[np.void]
    points: int
    encoding: str
    comments: tuple[str, ...]
    body_at: int
    header_lines: int


def is_pcd(head: bytes) -> bool:
    """True when the content begins like a PCD file."""
    return _START.match(head) is not None


def read_pcd(data: bytes, name: str, units: Units | None) -> Cloud:
    """Read a PCD file that is whole in `data`: ASCII, binary or compressed.

    Raises
    ------
    FormatError : in one of its kinds, with one sentence that says what is wrong.
    """
    header = parse_header(data, name)
    for axis in "xyz":
        if axis not in (header.row.names or ()):
            raise HeaderDamaged(f"{name}: the PCD header declares no field {axis}")
        if header.row[axis].shape:
            raise HeaderDamaged(f"{name}: the PCD header declares more than one {axis} a point")
    if header.points == 0:
        raise FileEmpty(f"{name} declares no point: there is nothing to read")
    notes: tuple[str, ...] = ()
    if header.encoding == "ascii":
        columns = _ascii(header, data, name)
        if not data.endswith((b"\n", b"\r", b" ")):
            notes = (CUT_NOTE,)
    elif header.encoding == "binary":
        columns = _binary(header, data, name)
    else:
        columns = _compressed(header, data, name)
    points = np.stack([columns[axis] for axis in "xyz"], axis=1)
    normals = np.stack([columns[part] for part in _NORMAL], axis=1) if set(_NORMAL) <= columns.keys() else None
    unit = given_or_named(units, header.comments) or MILLIMETRES
    return replace(cloud_from(name, "pcd", points, normals, unit, None, notes), normals_of=normals_of(header.comments))


def parse_header(data: bytes, name: str) -> PcdHeader:
    """Parse the header at the start of `data`.

    Raises
    ------
    HeaderDamaged : it breaks the rules of the format, or has no end.
    """
    end = re.search(rb"(?:^|\n)[ \t]*DATA[ \t]+(\w+)[ \t]*\r?\n", data[:_MAX_HEADER_BYTES])
    if end is None:
        raise HeaderDamaged(f"{name} has no complete PCD header (no DATA line): it is cut short or not a PCD file")
    encoding = end.group(1).decode("latin-1").lower()
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise HeaderDamaged(f"{name}: the PCD header declares data of an unknown kind: {encoding[:40]!r}")
    said: dict[str, list[str]] = {}
    comments = []
    lines = data[: end.start()].decode("latin-1").splitlines()
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if line.lstrip().startswith("#"):
            comments.append(line.lstrip()[1:].strip())
        elif words:
            key = "FIELDS" if words[0] == "COLUMNS" else words[0]
            if key in said:
                raise HeaderDamaged(f"{name}: line {number} of the PCD header says {key[:40]} again")
            said[key] = words[1:]
    fields = said.get("FIELDS", [])
    if not 0 < len(fields) <= _MAX_FIELDS:
        raise HeaderDamaged(f"{name}: the PCD header declares {len(fields)} fields")
    sizes, counts = (_whole(said.get(key, default), key, len(fields), name) for key, default in (
        ("SIZE", ["4"] * len(fields)), ("COUNT", ["1"] * len(fields)),
    ))  # fmt: skip
    kinds = said.get("TYPE", ["F"] * len(fields))
    if len(kinds) != len(fields):
        raise HeaderDamaged(f"{name}: the PCD header has {len(fields)} fields and {len(kinds)} types")
    width, height = (_whole(said.get(key, ["1"]), key, 1, name)[0] for key in ("WIDTH", "HEIGHT"))
    points = _whole(said.get("POINTS", [str(width * height)]), "POINTS", 1, name)[0]
    if "WIDTH" in said and points != width * height:
        raise HeaderDamaged(f"{name}: the PCD header declares {points} points and {width} x {height} of them")
    row = []
    for place, (field, size, kind, count) in enumerate(zip(fields, sizes, kinds, counts, strict=True)):
        if size not in _SIZES.get(kind, ()) or not 0 < count <= 4096:
            raise HeaderDamaged(f"{name}: the PCD header declares {field[:40]} as {kind[:8]}{size} x {count}")
        label = field if field != "_" and field not in fields[:place] else f"_{place}"
        row.append((label, f"<{_KINDS[kind]}{size}", (count,)) if count > 1 else (label, f"<{_KINDS[kind]}{size}"))
    header_lines = data[: end.end()].count(b"\n")
    return PcdHeader(np.dtype(row), points, encoding, tuple(comments), end.end(), header_lines)


def _whole(words: list[str], key: str, wanted: int, name: str) -> list[int]:
    if len(words) != wanted or not all(word.isascii() and word.isdigit() and len(word) <= 15 for word in words):
        raise HeaderDamaged(f"{name}: the PCD header needs {wanted} whole numbers behind {key}, not {words[:6]}")
    return [int(word) for word in words]


def _ascii(header: PcdHeader, data: bytes, name: str) -> dict[str, Float64Array]:
    text = numbers_of_text(data[header.body_at :], name, first_line=header.header_lines + 1)
    if len(text.counts) < header.points:
        raise _too_short(header, name, f"{len(text.counts)} rows are there")
    if len(text.counts) > header.points:
        line = text.line_number(header.points)
        raise ContentDamaged(f"{name} holds more rows than its header declares, from line {line}: the header is wrong")
    width = sum(int(np.prod(header.row[field].shape)) for field in header.row.names or ())
    odd = text.counts != width
    if odd.any():
        row = int(np.argmax(odd))
        raise ContentDamaged(f"{name}: line {text.line_number(row)} has {text.counts[row]} values, not {width}")
    table = text.values.reshape(-1, width)
    columns: dict[str, Float64Array] = {}
    at = 0
    for field in header.row.names or ():
        columns[field] = table[:, at]
        at += int(np.prod(header.row[field].shape))
    return columns


def _binary(header: PcdHeader, data: bytes, name: str) -> dict[str, Float64Array]:
    needed, there = header.points * header.row.itemsize, len(data) - header.body_at
    if needed > there:
        raise _too_short(header, name, f"they need {needed} bytes, and {there} are there")
    if data[header.body_at + needed :].strip(b"\x00\r\n "):
        raise ContentDamaged(f"{name} holds {there - needed} bytes more than its header declares: the header is wrong")
    table = np.frombuffer(data, dtype=header.row, count=header.points, offset=header.body_at)
    return _wanted({field: table[field] for field in header.row.names or ()})


def _compressed(header: PcdHeader, data: bytes, name: str) -> dict[str, Float64Array]:
    """Columns one behind the other, packed by LZF."""
    if len(data) < header.body_at + 8:
        raise _too_short(header, name, "its sizes are missing")
    packed, unpacked = struct.unpack_from("<II", data, header.body_at)
    there = len(data) - header.body_at - 8
    if packed > there:
        raise _too_short(header, name, f"{packed} packed bytes are declared, and {there} are there")
    if unpacked != header.points * header.row.itemsize:
        raise HeaderDamaged(f"{name}: {header.points} points do not take {unpacked} bytes: its header is wrong")
    try:
        body = decompressed(data[header.body_at + 8 : header.body_at + 8 + packed], unpacked)
    except LzfDamaged as error:
        raise ContentDamaged(f"{name}: its packed points are damaged: {error}") from None
    columns = {}
    at = 0
    for field in header.row.names or ():
        kind = header.row[field]
        columns[field] = np.frombuffer(body, dtype=kind, count=header.points, offset=at)
        at += header.points * kind.itemsize
    return _wanted(columns)


def _wanted(columns: "dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]]") -> dict[str, Float64Array]:
    """The fields that are used, as float64."""
    used = ("x", "y", "z", *_NORMAL)
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN
        return {field: column.astype(np.float64) for field, column in columns.items() if field in used}


def _too_short(header: PcdHeader, name: str, why: str) -> FileTruncated:
    return FileTruncated(f"{name} is cut short or its header is wrong: {header.points} points are declared; {why}")
