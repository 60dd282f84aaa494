"""Oriented points as a binary PLY: normals, component and whether the side is known; computes nothing."""

from pathlib import Path

import numpy as np

from drivers.scanline import Float64Array
from scanner_service import __version__
from scanner_service.analysis.orientation import Orientation
from scanner_service.storage.exports.whole_file import whole_file
from scanner_service.storage.formats.normals_of import BY_ANALYSIS

_ROW = np.dtype(
    [
        *((name, "<f8") for name in ("x", "y", "z", "nx", "ny", "nz")),
        ("scalar_component", "<i4"),
        ("scalar_sure", "<f4"),
    ]
)
_TYPES = {"<f8": "double", "<f4": "float", "<i4": "int"}


def write_oriented_ply(path: Path, points_mm: Float64Array, found: Orientation, *, version: str = __version__) -> None:
    """Write points (n, 3), mm, with their oriented normals; NaN and component -1 where a point has no normal.

    Raises
    ------
    ExportNotWritten, ExportNotConfirmed : the file system refused.
    """
    header = ["ply", "format binary_little_endian 1.0", f"comment scanner-service {version}", "comment units mm"]
    header.append(f"comment {BY_ANALYSIS}")
    header.append("comment scalar_sure is 1 where the side of the normal is known, 0 where it is a guess")
    header.append(f"element vertex {len(points_mm)}")
    header += [f"property {_TYPES[_ROW[name].str]} {name}" for name in _ROW.names or ()]
    rows = np.empty(len(points_mm), dtype=_ROW)
    for axis, name in enumerate("xyz"):
        rows[name] = points_mm[:, axis]
        rows[f"n{name}"] = found.normals[:, axis]
    rows["scalar_component"] = found.component
    rows["scalar_sure"] = found.sure
    with whole_file(path) as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        file.write(rows.tobytes())
