"""Points for the commands that analyse clouds: from a file, or from a session of a record, as stored or as mapped."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.analysis.comparison.shapes import KnownCloud, known_cloud
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.passes import pass_key
from scanner_service.analysis.snapshot import Unreliable
from scanner_service.commands.options import parse_units
from scanner_service.sessions.stored import find_session, read_session
from scanner_service.sessions.withdrawals import withdrawn_passes
from scanner_service.storage.database import is_sqlite
from scanner_service.storage.formats import FileEmpty, ReadOptions, open_cloud
from scanner_service.storage.formats.normals_of import NormalsOf
from scanner_service.storage.reader import RecordReader

NEWEST = "latest"


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
    normals_of: NormalsOf = "file"


def open_points(file: Path, units: str | None, session: str | None) -> OpenedCloud:
    """The points of a cloud file, or of a session of a record (the newest unless its id or first letters are given).

    Raises
    ------
    FormatError, RecordError, SessionError, ValueError : with one plain sentence.
    """
    if is_sqlite(file):
        refuse_units(units)
        return _of_record(file, session)
    if session is not None:
        raise ValueError(f"{file.name} is not a record of this service: leave out --session")
    cloud = open_cloud(file, ReadOptions(parse_units(units)))
    return OpenedCloud(
        file.name,
        cloud.points_mm,
        cloud.normals,
        None,
        cloud.points_declared,
        dict(cloud.dropped),
        cloud.notes,
        cloud.normals_of,
    )


def open_known(file: Path, units: str | None, session: str | None) -> tuple[KnownCloud, dict[str, int]]:
    """A cloud with the normals that came with it, or a session with those of its live map; what is left out, and why.

    The live map's normals are turned to the laser; they are an estimate too, which the cloud's `reference` says, also
    of a file that this program has written.

    Raises
    ------
    FormatError, RecordError, SessionError, AnalysisError, ValueError : with one plain sentence.
    """
    if is_sqlite(file):
        refuse_units(units)
        return _as_mapped(file, session)
    opened = open_points(file, units, session)
    if opened.normals is None:
        raise ValueError(
            f"{file.name} has no normals to compare with: give a cloud with x y z nx ny nz, or leave the file out"
        )
    cloud, kept = known_cloud(file.name, opened.points_mm, opened.normals, opened.normals_of)
    return cloud, {"no reference normal": int((~kept).sum())}


def refuse_units(units: str | None) -> None:
    """Refuse a length unit for a record; raises ValueError."""
    if units is not None:
        raise ValueError("a record is in millimetres: leave out --units")


def _as_mapped(file: Path, session: str | None) -> tuple[KnownCloud, dict[str, int]]:
    reader = RecordReader.open(file)
    try:
        row = find_session(reader, session or NEWEST)
        stored = read_session(reader, row)
    finally:
        reader.close()
    found, name = stored.results.snapshot, f"{file.name} {row.session_id}"
    lost = {why.name.lower(): int((found.unreliable == why).sum()) for why in list(Unreliable)[1:]}
    lost["damaged lines"] = len(stored.damaged)
    if not (found.unreliable == Unreliable.RELIABLE).any():
        raise ValueError(f"the live map of session {row.session_id} gives no reliable normal to compare with")
    return known_cloud(name, found.points_mm, found.normals, "live map")[0], lost


def _of_record(file: Path, session: str | None) -> OpenedCloud:
    reader = RecordReader.open(file)
    try:
        row = find_session(reader, session or NEWEST)
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
