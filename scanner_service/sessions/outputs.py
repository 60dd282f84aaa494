"""The four files a scan leaves: points.ply, density.png, regions.json, summary.json; computes nothing new."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from scanner_service import __version__
from scanner_service.sessions.errors import SessionError
from scanner_service.sessions.results import Results, summarise
from scanner_service.sessions.session import LiveSession
from scanner_service.storage.exports.density_png import density_png
from scanner_service.storage.exports.points_ply import write_points_ply
from scanner_service.storage.exports.results_json import write_json
from scanner_service.storage.exports.whole_file import write_whole


def summary_of(session: LiveSession, results: Results) -> dict[str, Any]:
    """The content of summary.json."""
    status = session.status()
    head = {"session": session.row.session_id, "name": session.row.name, "state": status.state}
    return head | summarise(results, status.losses, status.points_per_s, __version__)


def _points(path: Path, session: LiveSession, results: Results) -> None:
    write_points_ply(path, results.snapshot, results.verdict.rescan, version=__version__)


def _density(path: Path, session: LiveSession, results: Results) -> None:
    picture = density_png(
        results.snapshot,
        results.regions,
        session_name=session.row.name,
        when=session.row.created_utc[:16].replace("T", " ") + " UTC",
        coverage=results.share,
    )
    write_whole(path, picture)


def _regions(path: Path, session: LiveSession, results: Results) -> None:
    write_json(path, {"session": session.row.session_id, **results.regions_dict()})


def _summary(path: Path, session: LiveSession, results: Results) -> None:
    write_json(path, summary_of(session, results))


_WRITERS: dict[str, Callable[[Path, LiveSession, Results], None]] = {
    "points.ply": _points,
    "density.png": _density,
    "regions.json": _regions,
    "summary.json": _summary,
}
OUTPUT_FILES = tuple(_WRITERS)


def write_output(name: str, path: Path, session: LiveSession, results: Results) -> None:
    """Write one of OUTPUT_FILES to `path`; raises OSError when the place cannot be written to."""
    _WRITERS[name](path, session, results)


def write_outputs(folder: Path, session: LiveSession) -> dict[str, Any]:
    """Write all four files into a folder, made if need be; returns the summary.

    Raises
    ------
    SessionError : the session has no verdict yet.
    OSError : the folder cannot be written to.
    """
    results = session.results()
    if results is None:
        raise SessionError("the session has nothing to write yet: stop it first")
    folder.mkdir(parents=True, exist_ok=True)
    for name in OUTPUT_FILES:
        write_output(name, folder / name, session, results)
    return summary_of(session, results)
