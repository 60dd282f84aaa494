"""The four files a scan leaves: points.ply, density.png, regions.json, summary.json; computes nothing new."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scanner_service import __version__
from scanner_service.sessions.errors import SessionError
from scanner_service.sessions.fingerprint import verdict_sha256
from scanner_service.sessions.results import Results, summarise
from scanner_service.sessions.session import LiveSession
from scanner_service.sessions.stored import StoredSession
from scanner_service.sessions.withdrawals import end_of_scan_utc
from scanner_service.storage.exports.points_ply import write_points_ply
from scanner_service.storage.exports.results_json import write_json
from scanner_service.storage.exports.whole_file import write_whole
from scanner_service.storage.rows import SessionRow


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the files tell of, be the session held open or read from the record; `points_per_s` may be NaN.

    `ended_utc` is None while the scan has not ended.
    """

    row: SessionRow
    state: str
    results: Results
    losses: Mapping[str, Any]
    points_per_s: float
    ended_utc: str | None


def outcome_of(session: LiveSession, results: Results) -> Outcome:
    """Of a session that is held open."""
    status = session.status()
    return Outcome(
        session.row, status.state, results, status.losses, status.points_per_s, end_of_scan_utc(session.past_events())
    )


def stored_outcome(stored: StoredSession) -> Outcome:
    """Of a session that was read from the record, which does not tell how long it took."""
    return Outcome(stored.row, stored.row.state, stored.results, stored.losses, float("nan"), stored.ended_utc)


def summary_of(outcome: Outcome) -> dict[str, Any]:
    """The content of summary.json."""
    head = {"session": outcome.row.session_id, "name": outcome.row.name, "state": outcome.state}
    told = summarise(outcome.results, outcome.losses, outcome.points_per_s, __version__)
    return head | told | {"verdict_sha256": verdict_sha256(outcome.results)}


def _points(path: Path, outcome: Outcome) -> None:
    write_points_ply(path, outcome.results.snapshot, outcome.results.verdict.rescan, version=__version__)


def _density(path: Path, outcome: Outcome) -> None:
    from scanner_service.storage.exports.density_png import density_png  # noqa: PLC0415 - 0.4 s for who draws nothing

    picture = density_png(
        outcome.results.snapshot,
        outcome.results.regions,
        session_name=outcome.row.name,
        when=_when(outcome),
        coverage=outcome.results.share,
        required_per_mm2=outcome.results.typical_required_per_mm2,
    )
    write_whole(path, picture)


def _when(outcome: Outcome) -> str:
    """When the scan ended, or what is known instead."""
    said = "begun " if outcome.ended_utc is None else ""
    return said + (outcome.ended_utc or outcome.row.created_utc)[:16].replace("T", " ") + " UTC"


def _regions(path: Path, outcome: Outcome) -> None:
    write_json(path, {"session": outcome.row.session_id, **outcome.results.regions_dict()})


def _summary(path: Path, outcome: Outcome) -> None:
    write_json(path, summary_of(outcome))


_WRITERS: dict[str, Callable[[Path, Outcome], None]] = {
    "points.ply": _points,
    "density.png": _density,
    "regions.json": _regions,
    "summary.json": _summary,
}
OUTPUT_FILES = tuple(_WRITERS)


def write_output(name: str, path: Path, outcome: Outcome) -> None:
    """Write one of OUTPUT_FILES to `path`; raises OSError when the place cannot be written to."""
    _WRITERS[name](path, outcome)


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
    outcome = outcome_of(session, results)
    folder.mkdir(parents=True, exist_ok=True)
    for name in OUTPUT_FILES:
        write_output(name, folder / name, outcome)
    return summary_of(outcome)
