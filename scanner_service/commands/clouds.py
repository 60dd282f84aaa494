"""Points for the commands that analyse clouds: from a file, or from a session of a record with its laser positions."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.passes import pass_key
from scanner_service.commands.options import parse_units
from scanner_service.sessions.source_specs import RecordSpec
from scanner_service.sessions.withdrawals import withdrawn_passes
from scanner_service.storage.database import is_sqlite
from scanner_service.storage.formats import FileEmpty, ReadOptions, open_cloud
from scanner_service.storage.reader import RecordReader


@dataclass(frozen=True, slots=True)
class OpenedCloud:
    """Points (n, 3) in mm; `normals` (n, 3) that came with them, and `laser_mm` (n, 3) that saw them, where known."""

    name: str
    points_mm: Float64Array
    normals: Float64Array | None
    laser_mm: Float64Array | None
    points_declared: int
    dropped: dict[str, int]
    notes: tuple[str, ...]


def open_points(file: Path, units: str | None, session: str | None) -> OpenedCloud:
    """The points of a cloud file, or of a session of a record (the newest unless named).

    Raises
    ------
    FormatError, RecordError, SessionError, ValueError : with one plain sentence.
    """
    if is_sqlite(file):
        if units is not None:
            raise ValueError("a record is in millimetres: leave out --units")
        return _of_record(file, session)
    if session is not None:
        raise ValueError(f"{file.name} is not a record of this service: leave out --session")
    cloud = open_cloud(file, ReadOptions(parse_units(units)))
    return OpenedCloud(
        file.name, cloud.points_mm, cloud.normals, None, cloud.points_declared, dict(cloud.dropped), cloud.notes
    )


def _of_record(file: Path, session: str | None) -> OpenedCloud:
    reader = RecordReader.open(file)
    try:
        row = RecordSpec.find(reader, session).session
        gone = withdrawn_passes(reader.events(row.session_id))
        points: list[Float64Array] = [np.empty((0, 3))]
        lasers: list[Float64Array] = [np.empty((0, 3))]
        dropped: dict[str, int] = {}
        declared = 0
        for _, line in reader.lines(row.session_id):
            declared += line.point_count
            for reason, count in line.dropped.items():
                dropped[reason] = dropped.get(reason, 0) + count
            if pass_key(line) in gone:
                dropped["withdrawn"] = dropped.get("withdrawn", 0) + len(line.xyz_q)
                continue
            points.append(np.asarray(line.xyz_q * QUANTUM_MM + np.array(row.origin_mm), dtype=np.float64))
            lasers.append(np.broadcast_to(line.laser_mm, line.xyz_q.shape))
    finally:
        reader.close()
    found = np.concatenate(points)
    if not len(found):
        raise FileEmpty(f"session {row.session_id} of {file.name} holds no point: there is nothing to analyse")
    notes = (f"session {row.session_id}, {row.name}; normals are turned to the laser of each point's own scanline",)
    return OpenedCloud(f"{file.name} {row.session_id}", found, None, np.concatenate(lasers), declared, dropped, notes)
