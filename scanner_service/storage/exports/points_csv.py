"""Points as a profile table (CSV), which spreadsheets read and `scanner replay` plays again; computes nothing.

Coordinates are written in as many digits as they have, so that the very number is read back.
"""

import re
from math import isfinite
from typing import Any, BinaryIO

import numpy as np

from scanner_service.rescan.judgement import Reason
from scanner_service.storage.exports.about import About
from scanner_service.storage.exports.point_stream import PointBlock, PointStream

COLUMNS = (
    *("device", "pass", "line", "index", "x_mm", "y_mm", "z_mm", "laser_x_mm", "laser_y_mm", "laser_z_mm"),
    *("line_spacing_mm", "nx", "ny", "nz", "density_per_mm2", "radius_mm", "neighbours", "reliable"),
)
JUDGED = ("rescan", "reason")
_REASONS = np.array([reason.label for reason in Reason])


def write_csv(file: BinaryIO, stream: PointStream, about: About) -> None:
    """Write points in millimetres of the part frame, UTF-8, one row a point; an unknown value is an empty field.

    `pass` numbers the passes of the session, `line` is the scanner's own number of the scanline, `index` the point's
    place in it. `rescan` and `reason` are left out where nothing was judged.
    """
    file.write(f"# about {about.to_text()}\n{','.join((*COLUMNS, *(JUDGED if stream.is_judged else ())))}\n".encode())
    for block in stream.blocks():
        columns = _columns(block)
        file.write("".join(f"{','.join(row)}\n" for row in zip(*columns, strict=True)).encode())


def _columns(block: PointBlock) -> list[list[str]]:
    """The texts of each column. What is the same in a whole scanline is made once for it."""
    points, lines = block.points, block.points.lines
    own, place = np.unique(points.line, return_inverse=True)
    devices = [device_name(name) for name in lines.device_ids]
    heads = [
        f"{devices[device]},{number},{index}"
        for device, number, index in zip(
            lines.device[own].tolist(), lines.pass_number[own].tolist(), lines.line_index[own].tolist(), strict=True
        )
    ]
    lasers = [
        ",".join(map(repr, (*laser, spacing)))
        for laser, spacing in zip(lines.laser_mm[own].tolist(), lines.line_spacing_mm[own].tolist(), strict=True)
    ]
    where = place.tolist()
    normals = block.normals
    texts = [[heads[at] for at in where], [str(value) for value in points.index.tolist()]]
    texts += [_exact(points.points_mm[:, axis]) for axis in range(3)]
    texts += [[lasers[at] for at in where]]
    texts += [_rounded(normals[:, axis]) for axis in range(3)]
    texts += [_rounded(points.density_per_mm2), _rounded(points.radius_mm)]
    texts += [[str(value) for value in points.neighbours.tolist()], _flags(points.reliable)]
    if block.rescan is not None:
        reason = np.zeros(len(block), np.uint8) if block.reason is None else block.reason
        texts += [_flags(block.rescan), _REASONS[reason].tolist()]
    return texts


def device_name(device_id: str) -> str:
    """The device's name as one field of the table: separators, quotes and line breaks become `_`.

    So do signs with which a spreadsheet would begin a formula.
    """
    return re.sub(r'[,;\t\r\n"]|^[=+\-@#]', "_", device_id) or "_"


def _exact(column: Any) -> list[str]:
    return [repr(value) for value in column.tolist()]


def _rounded(column: Any) -> list[str]:
    """Nine digits, which is more than a normal or a density is good for; empty where not known."""
    return [f"{value:.9g}" if isfinite(value) else "" for value in column.tolist()]


def _flags(column: Any) -> list[str]:
    return ["1" if value else "0" for value in column.tolist()]
