"""From the columns of a file to a cloud, with every point accounted for; knows no file format."""

import numpy as np

from drivers.scanline import BoolArray, Float64Array
from scanner_service.storage.formats.errors import FileEmpty
from scanner_service.storage.formats.recording import MM_PER_UNIT, Cloud, finite_rows
from scanner_service.storage.formats.units import UnitAndWhy


def cloud_from(
    name: str,
    kind: str,
    points: Float64Array,
    normals: Float64Array | None,
    unit: UnitAndWhy,
    invalid: BoolArray | None = None,
    notes: tuple[str, ...] = (),
) -> Cloud:
    """The points (n, 3) of a file in its own unit as a cloud in millimetres.

    `invalid` (n,) is True where the file itself says that a point is none. What is left out is counted by reason.

    Raises
    ------
    FileEmpty : not one point is left.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        points_mm = points * MM_PER_UNIT[unit[0]]
    said_invalid = np.zeros(len(points), dtype=np.bool_) if invalid is None else invalid
    kept = finite_rows(points_mm) & ~said_invalid
    if not kept.any():
        raise FileEmpty(f"{name} holds no point with finite coordinates: there is nothing to analyse")
    dropped = {"invalid": int(said_invalid.sum()), "not_finite": int((~kept & ~said_invalid).sum())}
    return Cloud(
        source=name,
        format=kind,
        points_mm=points_mm[kept],
        normals=None if normals is None else normals[kept],
        points_declared=len(points),
        dropped={reason: count for reason, count in dropped.items() if count},
        notes=(unit[1], *notes),
    )
