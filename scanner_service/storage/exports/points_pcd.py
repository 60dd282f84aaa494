"""Points as a binary PCD (version 0.7) that PCL and Open3D read; knows the layout, computes nothing.

Other programs take x, y and z as float32 only, which holds a stored coordinate exactly up to 2 m from the part's zero.
Where the points lie farther out, float64 is written, which is exact everywhere and which not all of them read.
"""

from typing import BinaryIO

import numpy as np

from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.storage.exports.about import About
from scanner_service.storage.exports.point_stream import PointBlock, PointStream
from scanner_service.storage.formats.normals_of import BY_LIVE_MAP

_FIELDS: tuple[tuple[str, str], ...] = (
    *((f"normal_{axis}", "<f4") for axis in "xyz"),
    ("density", "<f4"),
    ("radius", "<f4"),
    *((f"laser_{axis}", "<f4") for axis in "xyz"),
    ("neighbours", "<i4"),
    ("scanline", "<i4"),
    ("reliable", "|u1"),
    ("rescan", "|u1"),
    ("reason", "|u1"),
)
_KINDS = {"f": "F", "i": "I", "u": "U"}
_FLOAT32_HOLDS_Q = 2**24


def write_pcd(file: BinaryIO, stream: PointStream, about: About) -> None:
    """Write points in millimetres of the part frame; NaN normals where not reliable.

    `rescan` and `reason` are left out where nothing was judged.
    """
    row = np.dtype(
        [(axis, "<f4" if fits_float32(stream) else "<f8") for axis in "xyz"]
        + [item for item in _FIELDS if stream.is_judged or item[0] not in ("rescan", "reason")]
    )
    file.write(_header(row, stream.total, about))
    for block in stream.blocks():
        file.write(_rows(row, block).tobytes())


def fits_float32(stream: PointStream) -> bool:
    """True when every stored coordinate within the stream's box is a float32."""
    origin_q = stream.origin_mm / QUANTUM_MM
    whole = bool((origin_q == np.rint(origin_q)).all())
    farthest = np.maximum(np.abs(stream.low_q + origin_q), np.abs(stream.high_q + origin_q)).max()
    return whole and bool(farthest <= _FLOAT32_HOLDS_Q)


def _header(row: np.dtype[np.void], total: int, about: About) -> bytes:
    names = row.names or ()
    kinds = [row[name] for name in names]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "# units mm",
        f"# {BY_LIVE_MAP}",
        f"# about {about.to_text()}",
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join(str(kind.itemsize) for kind in kinds),
        "TYPE " + " ".join(_KINDS[kind.kind] for kind in kinds),
        "COUNT " + " ".join("1" for _ in kinds),
        f"WIDTH {total}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {total}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def _rows(row: np.dtype[np.void], block: PointBlock) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    rows = np.empty(len(block), dtype=row)
    laser, normals = block.laser_mm, block.normals
    for axis, name in enumerate("xyz"):
        rows[name] = block.points.points_mm[:, axis]
        rows[f"normal_{name}"] = normals[:, axis]
        rows[f"laser_{name}"] = laser[:, axis]
    rows["density"] = block.points.density_per_mm2
    rows["radius"] = block.points.radius_mm
    rows["neighbours"] = block.points.neighbours
    rows["scanline"] = block.points.line
    rows["reliable"] = block.points.reliable
    if block.rescan is not None:
        rows["rescan"] = block.rescan
        rows["reason"] = 0 if block.reason is None else block.reason
    return rows
