"""What a method says of each point, as a binary PLY that other programs read; knows the layout, computes nothing."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drivers.scanline import Float64Array
from scanner_service import __version__
from scanner_service.analysis.method_analysis import MethodAnswer
from scanner_service.storage.exports.whole_file import whole_file
from scanner_service.storage.formats.normals_of import BY_ANALYSIS

_BLOCK = 1 << 16


def write_method_ply(
    path: Path,
    points_mm: Float64Array,
    answer: MethodAnswer,
    *,
    version: str = __version__,
    comments: Sequence[str] = (),
) -> None:
    """Write points (n, 3) with their normals and every value of the answer, binary little endian, millimetres.

    Scalars are named `scalar_*` with their unit, directions `*_x`, `*_y`, `*_z`; what is not known is NaN.
    `scalar_reason` is 0 where there is an answer; a header line names the others.

    Raises
    ------
    ValueError : the answer is not one of so many points.
    ExportNotWritten, ExportNotConfirmed : the file system refused.
    """
    total = len(answer)
    if points_mm.shape != (total, 3):
        raise ValueError(f"the answer is one of {total} points, not of {points_mm.shape}")
    columns: list[tuple[str, Float64Array]] = [
        *((name, points_mm[:, axis]) for axis, name in enumerate("xyz")),
        *((f"n{name}", answer.normals[:, axis]) for axis, name in enumerate("xyz")),
        *((f"scalar_{name}", values) for name, values in answer.scalars.items()),
        *((f"scalar_{name}_{x}", values[:, i]) for name, values in answer.vectors.items() for i, x in enumerate("xyz")),
        ("scalar_neighbours", answer.neighbours.astype(np.float64)),
        ("scalar_reason", answer.reason.astype(np.float64)),
    ]
    reasons = ", ".join(f"{number} {name}" for number, name in enumerate(answer.reasons))
    lines = ["ply", "format binary_little_endian 1.0", f"comment scanner-service {version}", "comment units mm"]
    lines += [f"comment {BY_ANALYSIS}", f"comment method {answer.method}", f"comment scalar_reason: {reasons}"]
    lines += [f"comment {text}" for text in (*answer.notes, *comments)]
    lines += [f"element vertex {total}", *(f"property double {name}" for name, _ in columns), "end_header"]
    header = "\n".join(" ".join(line.split()) for line in lines) + "\n"
    with whole_file(path) as file:
        file.write(header.encode("ascii", "backslashreplace"))
        for start in range(0, total, _BLOCK):
            part = slice(start, start + _BLOCK)
            file.write(np.column_stack([values[part] for _, values in columns]).astype("<f8").tobytes())
