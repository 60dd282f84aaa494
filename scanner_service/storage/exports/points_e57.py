"""Points as E57 (ASTM E2807) in one scan, through pye57's binding of libE57; knows the layout, computes nothing.

E57 is in metres. Coordinates are whole numbers times 2**-13 mm, so that nothing is rounded. Normals follow the public
extension for surface normals; density and the rest are in an extension of our own.
"""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

import numpy as np

from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.storage.exports.about import About
from scanner_service.storage.exports.optional import pye57_module
from scanner_service.storage.exports.point_stream import BLOCK_POINTS, PointBlock, PointStream

NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
OWN_URI = "urn:scanner-service:e57:1"
_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_FLOATS = ("sq:density", "sq:radius", "sq:laserX", "sq:laserY", "sq:laserZ")
_INT32 = 2**31
_INT64 = "q"  # numpy's longlong: the binding takes what numpy calls int64 for 32 bits


def write_e57(path: Path, stream: PointStream, about: About) -> None:
    """Write points of the part frame to `path`, which libE57 opens itself; metres, as the standard says.

    `sq:rescan` and `sq:reason` are left out where nothing was judged.

    Raises
    ------
    ExtraMissing : pye57 is not installed.
    """
    lib = pye57_module().libe57
    image = lib.ImageFile(str(path), "w")
    try:
        _write(lib, image, stream, about)
        image.close()
    except BaseException:
        image.cancel()
        raise


def _write(lib: Any, image: Any, stream: PointStream, about: About) -> None:
    image.extensionsAdd("", lib.E57_V1_0_URI)
    image.extensionsAdd("nor", NORMALS_URI)
    image.extensionsAdd("sq", OWN_URI)
    root = image.root()
    root.set("formatName", lib.StringNode(image, "ASTM E57 3D Imaging Data File"))
    root.set("guid", lib.StringNode(image, _guid(about, "file")))
    root.set("versionMajor", lib.IntegerNode(image, lib.E57_FORMAT_MAJOR))
    root.set("versionMinor", lib.IntegerNode(image, lib.E57_FORMAT_MINOR))
    root.set("e57LibraryVersion", lib.StringNode(image, lib.E57_LIBRARY_ID))
    root.set("coordinateMetadata", lib.StringNode(image, ""))
    root.set("creationDateTime", _moment(lib, image, about.created_utc))
    scans = lib.VectorNode(image, True)
    root.set("data3D", scans)
    root.set("images2D", lib.VectorNode(image, True))
    scan = lib.StructureNode(image)
    scan.set("guid", lib.StringNode(image, _guid(about, "scan")))
    scan.set("name", lib.StringNode(image, about.name))
    scan.set("description", lib.StringNode(image, about.to_text()))
    scan.set("acquisitionStart", _moment(lib, image, about.created_utc))
    bounds = lib.StructureNode(image)
    for axis, name in enumerate("xyz"):
        for end, q in (("Minimum", stream.low_q[axis]), ("Maximum", stream.high_q[axis])):
            bounds.set(f"{name}{end}", lib.FloatNode(image, (stream.origin_mm[axis] + q * QUANTUM_MM) / 1000.0))
    scan.set("cartesianBounds", bounds)
    fields, prototype = _prototype(lib, image, stream)
    points = lib.CompressedVectorNode(image, prototype, lib.VectorNode(image, True))
    scan.set("points", points)
    scans.append(scan)
    arrays = {name: np.zeros(BLOCK_POINTS, dtype=kind) for name, kind in fields.items()}
    buffers = lib.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(lib.SourceDestBuffer(image, name, array, BLOCK_POINTS, True, False))
    writer = points.writer(buffers)
    for block in stream.blocks():
        _fill(arrays, block)
        writer.write(len(block))
    writer.close()


def _prototype(lib: Any, image: Any, stream: PointStream) -> tuple[dict[str, str], Any]:
    """What one record holds, and the numpy kind by which each field is handed over."""
    prototype = lib.StructureNode(image)
    fields: dict[str, str] = {}

    def add(name: str, kind: str, node: Any) -> None:
        prototype.set(name, node)
        fields[name] = kind

    scale = QUANTUM_MM / 1000.0
    for axis, name in enumerate("XYZ"):
        low, high, offset = int(stream.low_q[axis]), int(stream.high_q[axis]), float(stream.origin_mm[axis]) / 1000.0
        add(f"cartesian{name}", _INT64, lib.ScaledIntegerNode(image, low, low, high, scale, offset))
    add("cartesianInvalidState", "i1", lib.IntegerNode(image, 0, 0, 0))
    for name in ("nor:normalX", "nor:normalY", "nor:normalZ", *_FLOATS):
        add(name, "f4", lib.FloatNode(image, 0.0, lib.E57_SINGLE))
    for name in ("sq:neighbours", "sq:scanline"):
        add(name, _INT64, lib.IntegerNode(image, 0, 0, _INT32 - 1))
    for name in ("sq:reliable", *(("sq:rescan",) if stream.is_judged else ())):
        add(name, "i1", lib.IntegerNode(image, 0, 0, 1))
    if stream.is_judged:
        add("sq:reason", "i1", lib.IntegerNode(image, 0, 0, 15))
    return fields, prototype


def _fill(arrays: dict[str, Any], block: PointBlock) -> None:
    count = len(block)
    xyz_q, laser, normals = block.xyz_q, block.laser_mm, block.normals
    for axis, name in enumerate("XYZ"):
        arrays[f"cartesian{name}"][:count] = xyz_q[:, axis]
        arrays[f"nor:normal{name}"][:count] = normals[:, axis]
        arrays[f"sq:laser{name}"][:count] = laser[:, axis]
    arrays["sq:density"][:count] = block.points.density_per_mm2
    arrays["sq:radius"][:count] = block.points.radius_mm
    arrays["sq:neighbours"][:count] = block.points.neighbours
    arrays["sq:scanline"][:count] = block.points.line
    arrays["sq:reliable"][:count] = block.points.reliable
    if block.rescan is not None:
        arrays["sq:rescan"][:count] = block.rescan
        arrays["sq:reason"][:count] = 0 if block.reason is None else block.reason


def _guid(about: About, what: str) -> str:
    """The same session gives the same name, and another one another."""
    return f"{{{uuid5(NAMESPACE_URL, f'{OWN_URI}:{about.session_id}:{about.raw_sha256}:{what}')}}}"


def _moment(lib: Any, image: Any, when_utc: str) -> Any:
    """A time as E57 has it: seconds since the beginning of GPS time, leap seconds left aside."""
    seconds = 0.0
    if when_utc:
        seconds = (datetime.fromisoformat(when_utc.replace("Z", "+00:00")) - _GPS_EPOCH).total_seconds()
    moment = lib.StructureNode(image)
    moment.set("dateTimeValue", lib.FloatNode(image, seconds))
    moment.set("isAtomicClockReferenced", lib.IntegerNode(image, 0))
    return moment
