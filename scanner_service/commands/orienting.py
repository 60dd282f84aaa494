"""What `scanner analyse --orient` adds: normals on one side, and how sure that is; computes nothing itself."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scanner_service.analysis.orientation import orient_normals
from scanner_service.analysis.orientation.telling import summarise_orientation, tell_orientation
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.storage.exports.oriented_ply import write_oriented_ply


def orient_snapshot(snapshot: MapSnapshot, out: Path) -> tuple[MapSnapshot, dict[str, Any], list[str]]:
    """The snapshot with oriented normals, what the summary says of them, and notes; writes `oriented.ply`.

    Raises
    ------
    ValueError : no point has a reliable normal.
    """
    normals = np.where(snapshot.reliable[:, None], snapshot.normals, np.nan)
    found = orient_normals(snapshot.points_mm, normals)
    write_oriented_ply(out / "oriented.ply", snapshot.points_mm, found)
    return replace(snapshot, normals=found.normals), summarise_orientation(found), tell_orientation(found)
