"""A session written out: which files there are, each with its hash in a manifest; lays out no format itself."""

from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from scanner_service import __version__
from scanner_service.sessions.fingerprint import verdict_sha256
from scanner_service.sessions.outputs import stored_outcome, write_output
from scanner_service.sessions.reporting import report_of
from scanner_service.sessions.stored import StoredSession, read_session
from scanner_service.storage.exports.errors import ExtraMissing, FormatNotWritten
from scanner_service.storage.exports.manifest import write_manifest
from scanner_service.storage.exports.point_files import POINT_FORMATS
from scanner_service.storage.exports.point_stream import stream_of
from scanner_service.storage.exports.record_file import write_session_record
from scanner_service.storage.exports.report_html import report_html
from scanner_service.storage.exports.report_pdf import report_pdf
from scanner_service.storage.exports.whole_file import write_whole
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.rows import SessionRow

RECORD_FILE = "session.sqlite"
RESULT_FILES = ("density.png", "regions.json", "summary.json")
REPORT_FILES = ("report.html", "report.pdf")
RESULTS, RECORD, REPORT = "results", "record", "report"
FORMATS = (*POINT_FORMATS, RESULTS, RECORD, REPORT)
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
        if name not in FORMATS:
            raise FormatNotWritten(f"there is no export format {name}; the formats are {', '.join(FORMATS)}")
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
) -> dict[str, Any]:
    """Write a session in the formats asked for, and the manifest of the files; returns the manifest.

    Each file appears under its name when it is whole, the manifest last. `on_progress` is told what is being done,
    and the share of it that is done.

    Raises
    ------
    ExportError : in one of its kinds.
    RecordError : the record cannot be read.
    """
    check_formats(formats)
    folder.mkdir(parents=True, exist_ok=True)
    wanted = [name for name in FORMATS if name in formats]
    stored = read_session(reader, row, lambda share: on_progress("reading the record", share), REPORT in wanted)
    written: list[str] = []
    for name in wanted:
        written += _write(name, reader, stored, folder, now, on_progress)
    return write_manifest(folder, written, _facts(stored, now))


def _write(
    name: str, reader: RecordReader, stored: StoredSession, folder: Path, now: datetime, on_progress: OnProgress
) -> list[str]:
    """Write one format; the names of its files."""
    on_progress(name, 0.0)
    if name in POINT_FORMATS:
        one = POINT_FORMATS[name]
        results = stored.results
        stream = stream_of(results.snapshot, results.verdict.rescan, results.verdict.reason)
        total = max(stream.total, 1)
        one.write(folder / one.file_name, stream.told(lambda done: on_progress(name, done / total)), stored.about)
        return [one.file_name]
    if name == RECORD:
        write_session_record(folder / RECORD_FILE, reader, stored.row, lambda share: on_progress(name, share))
        return [RECORD_FILE]
    if name == REPORT:
        content = report_of(stored, now)
        for done, (file_name, write) in enumerate(zip(REPORT_FILES, (report_html, report_pdf), strict=True)):
            write_whole(folder / file_name, write(content))
            on_progress(name, (done + 1) / len(REPORT_FILES))
        return list(REPORT_FILES)
    for done, output in enumerate(RESULT_FILES):
        write_output(output, folder / output, stored_outcome(stored))
        on_progress(name, (done + 1) / len(RESULT_FILES))
    return list(RESULT_FILES)


def _facts(stored: StoredSession, now: datetime) -> dict[str, Any]:
    return {
        **stored.about.to_dict(),
        "version": __version__,
        "written_utc": now.isoformat(timespec="seconds").replace("+00:00", "Z"),
        "lines": stored.lines,
        "points": len(stored.results.snapshot),
        "damaged_lines": list(stored.damaged),
        "verdict_sha256": verdict_sha256(stored.results),
    }
