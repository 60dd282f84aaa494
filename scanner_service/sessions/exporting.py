"""A session written out: which files there are, each with its hash in a manifest; lays out no format itself."""

from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from scanner_service import __version__
from scanner_service.sessions.fingerprint import verdict_sha256
from scanner_service.sessions.memory_bound import points_at_once as points_that_fit
from scanner_service.sessions.outputs import stored_outcome, write_output
from scanner_service.sessions.reporting import report_of
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.stored import StoredSession, about_of, read_session
from scanner_service.sessions.tiles import read_in_tiles, why_not_in_tiles
from scanner_service.storage.exports.about import About
from scanner_service.storage.exports.errors import ExtraMissing, FormatNotWritten, NotExportable
from scanner_service.storage.exports.manifest import write_manifest
from scanner_service.storage.exports.point_files import POINT_FORMATS
from scanner_service.storage.exports.point_stream import PointStream, stream_of
from scanner_service.storage.exports.record_file import write_session_record
from scanner_service.storage.exports.whole_file import write_whole
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.rows import SessionRow

RECORD_FILE = "session.sqlite"
RESULT_FILES = ("density.png", "regions.json", "summary.json")
REPORT_FILES = ("report.html", "report.pdf")
RESULTS, RECORD, REPORT = "results", "record", "report"
FORMATS = (*POINT_FORMATS, RESULTS, RECORD, REPORT)
ALL = "all"
"""Stands for every format that can be written; what cannot is told in the manifest, with the reason."""

OnProgress = Callable[[str, float], object]


def check_formats(formats: Sequence[str]) -> None:
    """Refuse, before any work, what could not be written.

    Raises
    ------
    FormatNotWritten : there is no such format, or none was asked for.
    ExtraMissing : a library that it needs is not installed.
    """
    if not formats:
        raise FormatNotWritten(f"no format to export was named; the formats are {', '.join(FORMATS)}")
    for name in formats:
        if name not in (*FORMATS, ALL):
            raise FormatNotWritten(f"there is no export format {name}; the formats are {', '.join(FORMATS)}, or {ALL}")
        missing = missing_for(name)
        if missing is not None:
            raise ExtraMissing(missing)


def missing_for(name: str) -> str | None:
    """Why a format cannot be written here, as one sentence; None when it can."""
    return POINT_FORMATS[name].missing() if name in POINT_FORMATS else None


def export_session(
    reader: RecordReader,
    row: SessionRow,
    formats: Sequence[str],
    folder: Path,
    now: datetime,
    on_progress: OnProgress = lambda what, share: None,
    points_at_once: int | None = None,
    meshes: Path | None = None,
) -> dict[str, Any]:
    """Write a session in the formats asked for, and the manifest of the files; returns the manifest.

    Each file appears under its name when it is whole, the manifest last. `on_progress` is told what is being done,
    and the share of it that is done. A session of more than `points_at_once` points (None: as many as fit into half
    of the free memory, at most ten million) is never in memory as a whole: its points are written without a verdict,
    slab by slab. What `all` cannot write stands in the manifest under `left_out`, with the reason. `meshes` is the
    folder with the reference mesh that the session may name.

    Raises
    ------
    ExportError : in one of its kinds.
    RecordError : the record cannot be read.
    """
    check_formats(formats)
    points_at_once = points_that_fit() if points_at_once is None else points_at_once
    points = reader.count(row.session_id).points
    impossible = {name: why for name in FORMATS if (why := _why_not(name, row, points, points_at_once)) is not None}
    for name in formats:
        if name in impossible:
            raise NotExportable(impossible[name])
    left_out = impossible if ALL in formats else {}
    wanted = [name for name in FORMATS if name in formats or (ALL in formats and name not in left_out)]
    folder.mkdir(parents=True, exist_ok=True)
    written: list[str] = []
    if points > points_at_once:
        tiled = read_in_tiles(reader, row, points_at_once, lambda share: on_progress("reading the record", share))
        about = about_of(row, tiled.raw_sha256)
        for name in wanted:
            if name == RECORD:
                written += _write_record(reader, row, folder, on_progress)
            else:
                written += _write_points(name, tiled.stream, about, folder, on_progress)
        facts = {"lines": tiled.lines, "points": tiled.stream.total, "damaged_lines": list(tiled.damaged)}
        facts |= {"left_out": left_out, "verdict_sha256": None}
        return write_manifest(folder, written, _facts(about, now) | facts)
    stored = read_session(reader, row, lambda share: on_progress("reading the record", share), REPORT in wanted, meshes)
    results = stored.results
    stream = stream_of(results.snapshot, results.verdict.rescan, results.verdict.reason)
    for name in wanted:
        if name in POINT_FORMATS:
            written += _write_points(name, stream, stored.about, folder, on_progress)
        elif name == RECORD:
            written += _write_record(reader, row, folder, on_progress)
        elif name == REPORT:
            written += _write_report(stored, folder, now, on_progress)
        else:
            written += _write_results(stored, folder, on_progress)
    facts = {
        "lines": stored.lines,
        "points": len(results.snapshot),
        "damaged_lines": list(stored.damaged),
        "left_out": left_out,
        "reference_refused": results.reference_refused,
        "verdict_sha256": verdict_sha256(results),
    }
    return write_manifest(folder, written, _facts(stored.about, now) | facts)


def _why_not(name: str, row: SessionRow, points: int, points_at_once: int) -> str | None:
    """Why a format cannot be written of a session, as one sentence; None when it can."""
    missing = missing_for(name)
    if missing is not None or name == RECORD or points <= points_at_once:
        return missing
    if name in (RESULTS, REPORT):
        return (
            f"regions and coverage need all {points:,} points of the session in memory, and {points_at_once:,} at once "
            "are allowed: leave out results and report, or allow more memory"
        )
    return why_not_in_tiles(SessionSettings.from_dict(row.settings), points_at_once)


def _write_points(name: str, stream: PointStream, about: About, folder: Path, on_progress: OnProgress) -> list[str]:
    on_progress(name, 0.0)
    one, total = POINT_FORMATS[name], max(stream.total, 1)
    one.write(folder / one.file_name, stream.told(lambda done: on_progress(name, done / total)), about)
    return [one.file_name]


def _write_record(reader: RecordReader, row: SessionRow, folder: Path, on_progress: OnProgress) -> list[str]:
    write_session_record(folder / RECORD_FILE, reader, row, lambda share: on_progress(RECORD, share))
    return [RECORD_FILE]


def _write_report(stored: StoredSession, folder: Path, now: datetime, on_progress: OnProgress) -> list[str]:
    from scanner_service.storage.exports.report_html import report_html  # noqa: PLC0415 - 0.4 s for who draws nothing
    from scanner_service.storage.exports.report_pdf import report_pdf  # noqa: PLC0415

    content = report_of(stored, now)
    for done, (file_name, write) in enumerate(zip(REPORT_FILES, (report_html, report_pdf), strict=True)):
        on_progress(REPORT, done / len(REPORT_FILES))
        write_whole(folder / file_name, write(content))
    return list(REPORT_FILES)


def _write_results(stored: StoredSession, folder: Path, on_progress: OnProgress) -> list[str]:
    for done, output in enumerate(RESULT_FILES):
        on_progress(RESULTS, done / len(RESULT_FILES))
        write_output(output, folder / output, stored_outcome(stored))
    return list(RESULT_FILES)


def _facts(about: About, now: datetime) -> dict[str, Any]:
    written = now.isoformat(timespec="seconds").replace("+00:00", "Z")
    return {**about.to_dict(), "version": __version__, "written_utc": written}
