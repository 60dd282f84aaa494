"""Points of a live map as a binary PLY that other programs read; knows the layout, computes nothing.

Scalars are named `scalar_*`: a well-known viewer drops other names without a word.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from drivers.scanline import BoolArray
from scanner_service import __version__
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.storage.exports.about import About
from scanner_service.storage.exports.point_stream import PointBlock, PointStream, stream_of
from scanner_service.storage.exports.whole_file import whole_file
from scanner_service.storage.formats.normals_of import BY_LIVE_MAP

ROW = np.dtype(
    [
        *((name, "<f8") for name in ("x", "y", "z", "scalar_radius", "nx", "ny", "nz")),
        *((f"scalar_{name}", "<f4") for name in ("density", "reliable", "rescan", "laser_x", "laser_y", "laser_z")),
        *((f"scalar_{name}", "<i4") for name in ("neighbours", "scanline")),
    ]
)
_PLY_TYPES = {"<f8": "double", "<f4": "float", "<i4": "int"}


def write_points_ply(
    path: Path,
    snapshot: MapSnapshot,
    rescan: BoolArray,
    *,
    version: str = __version__,
    comments: Sequence[str] = (),
    normals_by: str = BY_LIVE_MAP,
) -> None:
    """Write all points of a snapshot, in its order, as `write_ply` does, whole or not at all.

    Parameters
    ----------
    rescan : (n,) True where a point belongs to a region worth another pass.
    version : version of the software, written into the header.
    comments : further header lines.
    normals_by : the header line that says whose the normals are.

    Raises
    ------
    ValueError : `rescan` has not one value a point.
    ExportNotWritten, ExportNotConfirmed : the file system refused.
    """
    stream = stream_of(snapshot, rescan)
    with whole_file(path) as file:
        write_ply(file, stream, About(version=version), (normals_by, *comments))


def write_ply(file: BinaryIO, stream: PointStream, about: About, comments: Sequence[str] = (BY_LIVE_MAP,)) -> None:
    """Write points, binary little endian, millimetres, part frame.

    x y z are the stored coordinates without rounding. `scalar_neighbours` counts the point itself, `scalar_laser_*` is
    the laser position of the point's own scanline, `scalar_scanline` that scanline's row in the line table. A normal
    that is not reliable is NaN. `scalar_rescan` is NaN where nothing was judged.
    """
    if about.session_id:
        comments = (*comments, f"about {about.to_text()}")
    file.write(_header(stream.total, about.version, comments))
    for block in stream.blocks():
        file.write(_rows(block).tobytes())


def _header(total: int, version: str, comments: Sequence[str]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"comment scanner-service {version}", "comment units mm"]
    lines.append("comment scalar_neighbours counts the point itself; scalar_density is points per mm2")
    lines.append("comment a normal that is not reliable is nan")
    lines += [f"comment {text}" for text in comments]
    lines.append(f"element vertex {total}")
    lines += [f"property {_PLY_TYPES[ROW[name].str]} {name}" for name in ROW.names or ()]
    lines.append("end_header")
    # A line break in a comment would be a header line of its own.
    printable = (" ".join(line.split()) for line in lines)
    return ("\n".join(printable) + "\n").encode("ascii", "backslashreplace")


def _rows(block: PointBlock) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    points = block.points
    rows = np.empty(len(block), dtype=ROW)
    laser, normals = block.laser_mm, block.normals
    for axis, name in enumerate("xyz"):
        rows[name] = points.points_mm[:, axis]
        rows[f"n{name}"] = normals[:, axis]
        rows[f"scalar_laser_{name}"] = laser[:, axis]
    rows["scalar_radius"] = points.radius_mm
    rows["scalar_density"] = points.density_per_mm2
    rows["scalar_reliable"] = points.reliable
    rows["scalar_rescan"] = np.nan if block.rescan is None else block.rescan
    rows["scalar_neighbours"] = points.neighbours
    rows["scalar_scanline"] = points.line
    return rows
