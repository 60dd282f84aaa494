"""E57 files (ASTM E2807) as clouds, through pye57; what the header declares is compared with the file beforehand.

libE57 checks the CRC of every page. Before it is given the file, its header and its XML are read here: sizes that the
file cannot hold are refused, and nothing is allocated by them.
"""

import math
import struct
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from drivers.scanline import BoolArray, Float64Array
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

_E57 = "{http://www.astm.org/COMMIT/E57/2010-e57-v1.0}"
_NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
_NORMALS = f"{{{_NORMALS_URI}}}"
_MAX_XML_BYTES = 16 << 20
_MAX_SCANS = 4096
_BLOCK_POINTS = 1 << 16
_METRES: UnitAndWhy = ("m", "lengths are read as metres, as E57 says")
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


@dataclass(frozen=True, slots=True)
class _Scan:
    """One scan as the XML declares it: which fields its points have, how many there are, and where they stand."""

    number: int
    points: int
    is_spherical: bool
    invalid: str | None
    has_normals: bool
    rotation: Float64Array
    translation_m: Float64Array


def is_e57(head: bytes) -> bool:
    """True when the content begins like an E57 file."""
    return head.startswith(b"ASTM-E57")


def read_e57(path: Path, units: Units | None, max_bytes: int) -> Cloud:
    """Read the points of all scans of an E57 file, each moved by its own pose, and their normals where all have some.

    Points that the file marks as invalid are counted as such.

    Raises
    ------
    FormatError : in one of its kinds, with one sentence that says what is wrong.
    """
    name = path.name
    with path.open("rb") as file:
        scans = _scans(_xml(file, path.stat().st_size, name), path.stat().st_size, name)
    total = sum(scan.points for scan in scans)
    if total == 0:
        raise FileEmpty(f"{name} holds no point: there is nothing to read")
    if total * 48 > max_bytes:
        raise FileTooLarge(f"{name} declares {total} points, which take more than {max_bytes} bytes")
    try:
        import pye57  # noqa: PLC0415 - an extra
    except ImportError:
        raise LibraryAbsent(
            f"{name} is an E57 file, and pye57, which reads them, is not installed: "
            "in the checkout, run `.venv/bin/pip install -e '.[e57]'`"
        ) from None
    lib = pye57.libe57
    parts: list[tuple[Float64Array, Float64Array | None, BoolArray]] = []
    try:
        image = lib.ImageFile(str(path), "r")
        try:
            for scan in scans:
                if scan.points:
                    parts.append(_read_scan(lib, image, scan))
        finally:
            image.close()
    except (lib.E57Exception, RuntimeError, ValueError, IndexError, MemoryError) as error:
        said = " ".join(str(error).split())[:120]
        raise ContentDamaged(f"{name} is damaged: libE57 says {said or type(error).__name__}") from error
    normals = [part[1] for part in parts]
    notes: tuple[str, ...] = (f"{len(parts)} scans are read as one cloud",) if len(parts) > 1 else ()
    if any(one is None for one in normals) and any(one is not None for one in normals):
        notes += ("the normals are left aside, since not all scans have them",)
    return cloud_from(
        name,
        "e57",
        np.concatenate([part[0] for part in parts]),
        None if any(one is None for one in normals) else np.concatenate([one for one in normals if one is not None]),
        given_or_named(units, ()) or _METRES,
        np.concatenate([part[2] for part in parts]),
        notes,
    )


def _xml(file: BinaryIO, size: int, name: str) -> ET.Element:
    """The XML section, put together from its pages."""
    head = file.read(48)
    if len(head) < 48:
        raise FileTruncated(f"{name} is cut short: its E57 header is not complete")
    major, _, length, xml_at, xml_bytes, page_bytes = struct.unpack_from("<IIQQQQ", head, 8)
    if major != 1 or page_bytes != 1024:
        raise HeaderDamaged(f"{name}: E57 version {major} with pages of {page_bytes} bytes is not known here")
    if length != size:
        raise FileTruncated(f"{name} is cut short or its header is wrong: it has {size} bytes, not {length}")
    pages = math.ceil((xml_bytes + xml_at % 1024) / 1020) + 1
    if not 48 <= xml_at < size or xml_bytes > min(size, _MAX_XML_BYTES):
        raise HeaderDamaged(f"{name}: its XML of {xml_bytes} bytes cannot lie at byte {xml_at} of {size}")
    file.seek(xml_at - xml_at % 1024)
    raw = file.read(pages * 1024)
    text = b"".join(raw[start : start + 1020] for start in range(0, len(raw), 1024))
    text = text[xml_at % 1024 : xml_at % 1024 + xml_bytes]
    if len(text) < xml_bytes:
        raise FileTruncated(f"{name} is cut short: its XML is not complete")
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise HeaderDamaged(f"{name}: its XML declares entities, which no E57 file needs")
    try:
        return ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise HeaderDamaged(f"{name}: its XML is damaged: {error}") from None


def _scans(root: ET.Element, size: int, name: str) -> list[_Scan]:
    data3d = root.find(f"{_E57}data3D")
    if data3d is None:
        raise HeaderDamaged(f"{name}: its XML has no data3D: it is damaged, or not an E57 file")
    children = list(data3d)
    if len(children) > _MAX_SCANS:
        raise HeaderDamaged(f"{name} declares {len(children)} scans; at most {_MAX_SCANS} are read")
    return [_scan(number, child, size, name) for number, child in enumerate(children)]


def _scan(number: int, node: ET.Element, size: int, name: str) -> _Scan:
    points = node.find(f"{_E57}points")
    prototype = None if points is None else points.find(f"{_E57}prototype")
    if points is None or prototype is None:
        raise HeaderDamaged(f"{name}: scan {number} declares no points")
    try:
        count = int(points.get("recordCount", ""))
        bits = sum(_bits(field) for field in prototype)
        rotation, translation = _pose(node.find(f"{_E57}pose"))
    except ValueError:
        raise HeaderDamaged(f"{name}: scan {number} declares something that is no number") from None
    if count < 0 or count * max(bits, 1) > 8 * size:
        raise FileTruncated(
            f"{name} is cut short or its header is wrong: scan {number} declares {count} points, and {size} bytes "
            "cannot hold them"
        )
    names = {field.tag for field in prototype}
    is_spherical = not {_E57 + part for part in _CARTESIAN} <= names
    if is_spherical and not {_E57 + part for part in _SPHERICAL} <= names:
        raise HeaderDamaged(f"{name}: scan {number} has neither cartesian nor spherical coordinates")
    state = "sphericalInvalidState" if is_spherical else "cartesianInvalidState"
    return _Scan(
        number=number,
        points=count,
        is_spherical=is_spherical,
        invalid=state if _E57 + state in names else None,
        has_normals={f"{_NORMALS}normal{axis}" for axis in "XYZ"} <= names,
        rotation=rotation,
        translation_m=translation,
    )


def _bits(field: ET.Element) -> int:
    """Bits that one value takes in the file."""
    if field.get("type") == "Float":
        return 32 if field.get("precision") == "single" else 64
    low, high = int(field.get("minimum", -(2**63))), int(field.get("maximum", 2**63 - 1))
    if high < low:
        raise ValueError
    return (high - low).bit_length()


def _pose(node: ET.Element | None) -> tuple[Float64Array, Float64Array]:
    """Rotation matrix (3, 3) and translation (3,) of a scan; those of the unmoved one without a pose."""

    def numbers(parent: ET.Element | None, names: str, otherwise: list[float]) -> list[float]:
        if parent is None:
            return otherwise
        return [float((parent.findtext(f"{_E57}{one}") or "0").strip() or 0) for one in names]

    rotation = None if node is None else node.find(f"{_E57}rotation")
    translation = None if node is None else node.find(f"{_E57}translation")
    w, x, y, z = numbers(rotation, "wxyz", [1.0, 0.0, 0.0, 0.0])
    shift = np.array(numbers(translation, "xyz", [0.0, 0.0, 0.0]))
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not (math.isfinite(length) and length > 0 and np.isfinite(shift).all()):
        raise ValueError
    w, x, y, z = w / length, x / length, y / length, z / length
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return matrix, shift


def _read_scan(lib: Any, image: Any, scan: _Scan) -> tuple[Float64Array, Float64Array | None, BoolArray]:
    """Points in metres (n, 3) of the file's frame, normals (n, 3) or None, and which are invalid (n,)."""
    vector = lib.CompressedVectorNode(
        lib.StructureNode(lib.VectorNode(image.root().get("data3D")).get(scan.number)).get("points")
    )
    coordinates = _SPHERICAL if scan.is_spherical else _CARTESIAN
    prefixes = [
        image.extensionsPrefix(i) for i in range(image.extensionsCount()) if image.extensionsUri(i) == _NORMALS_URI
    ]
    normal_names = [f"{prefixes[0]}:normal{axis}" for axis in "XYZ"] if scan.has_normals and prefixes else []
    arrays = {part: np.zeros(_BLOCK_POINTS) for part in (*coordinates, *normal_names)}
    if scan.invalid is not None:
        arrays[scan.invalid] = np.zeros(_BLOCK_POINTS)
    points: list[Float64Array] = []
    normals: list[Float64Array] = []
    invalid: list[BoolArray] = []
    for count in _blocks(lib, image, vector, arrays):
        xyz = np.stack([arrays[part][:count] for part in coordinates], axis=1)
        if scan.is_spherical:
            xyz = _cartesian(xyz)
        points.append(xyz @ scan.rotation.T + scan.translation_m)
        if normal_names:
            normals.append(np.stack([arrays[part][:count] for part in normal_names], axis=1) @ scan.rotation.T)
        said = arrays[scan.invalid][:count] if scan.invalid is not None else np.zeros(count)
        invalid.append(said != 0)
    return np.concatenate(points), np.concatenate(normals) if normals else None, np.concatenate(invalid)


def _blocks(lib: Any, image: Any, vector: Any, arrays: dict[str, Float64Array]) -> Iterator[int]:
    """Fill the arrays block by block; how many values each block has."""
    buffers = lib.VectorSourceDestBuffer()
    for part, array in arrays.items():
        buffers.append(lib.SourceDestBuffer(image, part, array, len(array), True, True))
    reader = vector.reader(buffers)
    try:
        while count := reader.read():
            yield int(count)
    finally:
        reader.close()


def _cartesian(rae: Float64Array) -> Float64Array:
    """Range, azimuth and elevation as x, y, z (E2807, section 6)."""
    ground = rae[:, 0] * np.cos(rae[:, 2])
    return np.stack([ground * np.cos(rae[:, 1]), ground * np.sin(rae[:, 1]), rae[:, 0] * np.sin(rae[:, 2])], axis=1)
