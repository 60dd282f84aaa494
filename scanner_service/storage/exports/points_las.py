"""Points as LAS or LAZ 1.4 with extra bytes (ASPRS LAS 1.4 R15); knows the layout, computes nothing.

A LAS coordinate is a whole number times a scale plus an offset. So is a stored one: the scale is 2**-13 and the offset
the session's origin, and nothing is rounded.
"""

from datetime import date
from typing import Any, BinaryIO

import numpy as np

from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.storage.exports.about import About
from scanner_service.storage.exports.optional import laspy_module
from scanner_service.storage.exports.point_stream import PointBlock, PointStream

VLR_USER, VLR_RECORD = "scanner_service", 1
EXTRA_BYTES: tuple[tuple[str, str, str], ...] = (
    *((f"Normal{axis}", "f4", "unit normal, NaN if unreliable") for axis in "XYZ"),
    ("Density", "f4", "points per mm2"),
    ("ScanLine", "i4", "row of the scanline"),
    *((f"Laser{axis}", "f8", "laser position, mm") for axis in "XYZ"),
    ("Rescan", "u1", "1: worth another pass"),
    ("Reason", "u1", "why, 0: none"),
    ("Radius", "f4", "of the neighbourhood, mm"),
    ("Neighbours", "i4", "within it, itself too"),
    ("Reliable", "u1", "1: the normal is given"),
)
_LAST_PASS = 65_534


def write_las(file: BinaryIO, stream: PointStream, about: About, compressed: bool = True) -> None:
    """Write points in millimetres of the part frame, point format 6, LAZ when `compressed`.

    `point_source_id` is the number of the pass, counted from 1 (65535: beyond). `Rescan` and `Reason` are left out
    where nothing was judged.

    Raises
    ------
    ExtraMissing : laspy (and lazrs for LAZ) is not installed.
    """
    laspy = laspy_module()
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, QUANTUM_MM), np.array(stream.origin_mm)
    header.global_encoding.wkt = True  # what point formats 6 and above must say, also without a reference system
    header.system_identifier = "laser-line scanner"
    header.generating_software = about.software[:32]
    header.creation_date = date.fromisoformat(about.created_utc[:10]) if about.created_utc else date(2000, 1, 1)
    extra = [item for item in EXTRA_BYTES if stream.is_judged or item[0] not in ("Rescan", "Reason")]
    header.add_extra_dims([laspy.ExtraBytesParams(name=n, type=kind, description=text) for n, kind, text in extra])
    note = about.to_text().encode("ascii")
    header.vlrs.append(laspy.VLR(VLR_USER, VLR_RECORD, "where it comes from; units mm", note[:65_535]))
    backend = laspy.LazBackend.LazrsParallel if compressed else None
    with laspy.open(file, "w", header=header, do_compress=compressed, laz_backend=backend, closefd=False) as writer:
        for block in stream.blocks():
            writer.write_points(_points(laspy, header, block))


def _points(laspy: Any, header: Any, block: PointBlock) -> Any:
    points = laspy.ScaleAwarePointRecord.zeros(len(block), header=header)
    xyz_q, laser, normals = block.xyz_q, block.laser_mm, block.normals
    for axis, name in enumerate("XYZ"):
        points[name] = xyz_q[:, axis].astype(np.int32)
        points[f"Normal{name}"] = normals[:, axis]
        points[f"Laser{name}"] = laser[:, axis]
    points["return_number"] = points["number_of_returns"] = np.ones(len(block), np.uint8)
    points["point_source_id"] = np.minimum(block.of_line("pass_number"), _LAST_PASS) + 1
    points["Density"] = block.points.density_per_mm2
    points["ScanLine"] = block.points.line
    points["Radius"] = block.points.radius_mm
    points["Neighbours"] = block.points.neighbours
    points["Reliable"] = block.points.reliable
    if block.rescan is not None:
        points["Rescan"] = block.rescan
        points["Reason"] = np.zeros(len(block), np.uint8) if block.reason is None else block.reason
    return points
