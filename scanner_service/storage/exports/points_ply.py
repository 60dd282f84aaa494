"""Points of a live map as a binary PLY that other programs read; knows the layout, computes nothing.

Scalars are named `scalar_*`: a well-known viewer drops other names without a word.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drivers.scanline import BoolArray
from scanner_service import __version__
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.storage.exports.whole_file import whole_file

_BLOCK = 1 << 16
ROW = np.dtype(
    [
        *((name, "<f8") for name in ("x", "y", "z", "scalar_radius", "nx", "ny", "nz")),
        *((f"scalar_{name}", "<f4") for name in ("density", "reliable", "rescan", "laser_x", "laser_y", "laser_z")),
        *((f"scalar_{name}", "<i4") for name in ("neighbours", "scanline")),
    ]
)
_PLY_TYPES = {"<f8": "double", "<f4": "float", "<i4": "int"}


def write_points_ply(
    path: Path, snapshot: MapSnapshot, rescan: BoolArray, *, version: str = __version__, comments: Sequence[str] = ()
) -> None:
    """Write all points of a snapshot, in its order, binary little endian, millimetres, part frame.

    x y z are the stored coordinates without rounding. `scalar_neighbours` counts the point itself, `scalar_laser_*` is
    the laser position of the point's own scanline, `scalar_scanline` that scanline's row in the line table. A normal
    that is not reliable is NaN. The file appears under its name when it is whole.

    Parameters
    ----------
    rescan : (n,) True where a point belongs to a region worth another pass.
    version : version of the software, written into the header.
    comments : further header lines.

    Raises
    ------
    ValueError : `rescan` has not one value a point.
    ExportNotWritten, ExportNotConfirmed : the file system refused.
    """
    total = len(snapshot)
    if rescan.shape != (total,):
        raise ValueError(f"rescan must have shape ({total},), not {rescan.shape}")
    with whole_file(path) as file:
        file.write(_header(total, version, comments))
        for start in range(0, total, _BLOCK):
            file.write(_rows(snapshot, rescan, slice(start, min(start + _BLOCK, total))).tobytes())


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


def _rows(snapshot: MapSnapshot, rescan: BoolArray, part: slice) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    rows = np.empty(part.stop - part.start, dtype=ROW)
    line = snapshot.line[part]
    laser = snapshot.lines.laser_mm[line]
    normals = np.where(snapshot.reliable[part, None], snapshot.normals[part], np.nan)
    for axis, name in enumerate("xyz"):
        rows[name] = snapshot.points_mm[part, axis]
        rows[f"n{name}"] = normals[:, axis]
        rows[f"scalar_laser_{name}"] = laser[:, axis]
    rows["scalar_radius"] = snapshot.radius_mm[part]
    rows["scalar_density"] = snapshot.density_per_mm2[part]
    rows["scalar_reliable"] = snapshot.reliable[part]
    rows["scalar_rescan"] = rescan[part]
    rows["scalar_neighbours"] = snapshot.neighbours[part]
    rows["scalar_scanline"] = line
    return rows
