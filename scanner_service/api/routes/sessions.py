"""Sessions: create, list, start, pause, resume, stop, describe, delete; every call is one call of the session book."""

import threading
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from scanner_service.api.access import Identity
from scanner_service.api.answers import answer
from scanner_service.api.errors import NotConfirmed
from scanner_service.api.idempotency import IdempotencyKey, creation_key
from scanner_service.api.keys import Role
from scanner_service.api.schemas import (
    DescriptionIn,
    DeviceSourceIn,
    PushSourceIn,
    ReferenceIn,
    ReplaySourceIn,
    RequirementIn,
    RigSourceIn,
    SessionIn,
    requirement_told,
)
from scanner_service.api.scopes import require
from scanner_service.rescan.presets import PRESETS
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.errors import SourceUnusable
from scanner_service.sessions.references import NO_NOMINAL, Nominal, open_reference
from scanner_service.sessions.session import LiveSession
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import DeviceSpec, PushSpec, RecordSpec, ReplaySpec, RigSpec, SourceSpec
from scanner_service.storage.database import is_sqlite
from scanner_service.storage.formats.recording import ReadOptions
from scanner_service.storage.formats.reference_mesh import ReferenceSpec
from scanner_service.storage.rows import SessionRow

router = APIRouter(prefix="/api/v1/sessions", tags=["sessions"])
viewer, operator, admin = (Depends(require(role)) for role in (Role.VIEWER, Role.OPERATOR, Role.ADMIN))


def book_of(request: Request) -> SessionBook:
    """The service's session book."""
    book: SessionBook = request.app.state.service.book
    return book


async def session_of(request: Request, session_id: str) -> LiveSession:
    """The session, reopened from the record when it has to be; raises SessionUnknown."""
    return await run_in_threadpool(book_of(request).get, session_id)


Session = Annotated[LiveSession, Depends(session_of)]


def spec_of(source: DeviceSourceIn | RigSourceIn | ReplaySourceIn | PushSourceIn, replay_dir: Path) -> SourceSpec:
    """What the request asks to read from."""
    match source:
        case DeviceSourceIn():
            return DeviceSpec(**source.model_dump(exclude={"kind"}))
        case RigSourceIn():
            rigs_dir = replay_dir.parent / "rigs"
            if not rigs_dir.is_dir() or source.rig not in {item.name for item in rigs_dir.iterdir()}:
                raise SourceUnusable(f"there is no file {source.rig} in the service's folder of rigs")
            return RigSpec(rigs_dir / source.rig, **source.model_dump(exclude={"kind", "rig"}))
        case ReplaySourceIn():
            if source.file not in {item.name for item in replay_dir.iterdir()}:
                raise SourceUnusable(f"there is no file {source.file} in the service's replay folder")
            if is_sqlite(replay_dir / source.file):
                if (source.units, source.laser_mm, source.line_spacing_mm) != (None, None, None):
                    raise SourceUnusable("a record knows its units, spacing and laser: leave them out")
                return RecordSpec.of_file(replay_dir / source.file, source.session, source.speed)
            if source.session is not None:
                raise SourceUnusable(f"{source.file} is no record, so that it holds no session to be named")
            options = ReadOptions(units=source.units, laser_mm=source.laser_mm, line_spacing_mm=source.line_spacing_mm)
            return ReplaySpec(replay_dir / source.file, options, source.speed)
        case PushSourceIn():
            return PushSpec()


def row_answer(book: SessionBook, row: SessionRow) -> dict[str, Any]:
    """One line of the list: from the session when it is open, else from the record."""
    live = book.live(row.session_id)
    count = book.record.count(row.session_id) if live is None else None
    return {
        "id": row.session_id,
        "name": row.name,
        "state": row.state if live is None else live.state,
        "created": row.created_utc,
        "lines": count.lines if count is not None else live.engine.ledger.stored if live else 0,
        "points": count.points if count is not None else live.engine.ledger.counted if live else 0,
        "source": row.source,
        "notes": row.notes,
        "opening": _share(book, row.session_id),
    }


def status_answer(session: LiveSession) -> dict[str, Any]:
    """Everything there is to say of an open session."""
    status = session.status()
    return {
        "id": status.session_id,
        "name": status.name,
        "state": status.state,
        "created": status.created_utc,
        "lines": status.lines,
        "points": status.points,
        "points_per_s": status.points_per_s,
        "coverage": status.coverage,
        "coverage_kind": status.coverage_kind,
        "verdict_age_s": status.verdict_age_s,
        "progress": status.progress,
        "losses": status.losses,
        "durable": status.durable,
        "message": status.message,
        "origin_mm": session.row.origin_mm,
        "settings": session.row.settings,
        "source": session.row.source,
        "notes": session.row.notes,
        "calibration": session.row.calibration,
        "held": status.held,
        "can_pause": session.can_pause,
        "requirement": requirement_told(session.settings.target),
        "holds": status.holds,
        "judging": None if status.judging is None else asdict(status.judging),
    }


def _share(book: SessionBook, session_id: str) -> float | None:
    opening = book.opening(session_id)
    return None if opening is None else opening.share


@router.get("", dependencies=[viewer])
def list_sessions(
    request: Request, limit: Annotated[int, Query(ge=1, le=1000)] = 100, after: str | None = None
) -> Response:
    """Sessions, newest first; `next` goes into `after` of the next call."""
    book = book_of(request)
    rows = book.rows(limit, after)
    return answer(
        {
            "sessions": [row_answer(book, row) for row in rows],
            "next": rows[-1].session_id if len(rows) == limit else None,
        }
    )


@router.get("/presets", dependencies=[viewer])
def list_presets() -> Response:
    """Requirements by name, from the loosest to the finest; null is what is not asked for."""
    return answer({"presets": {name: requirement_told(preset) for name, preset in PRESETS.items()}})


@router.post("", status_code=201)
def create_session(
    request: Request,
    body: SessionIn,
    who: Annotated[Identity, operator],
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Make a session on a device, a replay file, or pushed scanlines. It does not scan before it is started.

    With an `Idempotency-Key` the request may be sent again: the answer is then about the session made at first.
    """
    key = creation_key(idempotency_key, who, body)
    made = book_of(request).made_with(key)
    if made is not None:  # whatever has become of the files that the request names
        return _made(made)
    spec = spec_of(body.source, request.app.state.service.replay_dir)
    settings, reference, origin_mm = body.settings.to_settings(), None, body.origin_mm
    if isinstance(spec, RecordSpec):
        if body.model_fields_set & {"settings", "origin_mm"}:
            spec.close()
            raise SourceUnusable("a session of a record is played with its own settings and origin: leave them out")
        try:
            settings, origin_mm = SessionSettings.from_dict(spec.session.settings), spec.session.origin_mm
        except (TypeError, ValueError, AttributeError) as error:
            spec.close()
            raise SourceUnusable(
                f"the settings of the recorded session are none that are known here: {error}"
            ) from None
    elif settings.reference is not None:
        reference, named = open_reference(settings.reference, request.app.state.service.replay_dir)
        settings = replace(settings, reference=named)
    session = book_of(request).create(body.name, spec, settings, origin_mm, key=key, reference=reference)
    return _made(session)


def _made(session: LiveSession) -> Response:
    return answer(status_answer(session), 201, {"Location": f"/api/v1/sessions/{session.row.session_id}"})


@router.get("/{session_id}", dependencies=[viewer])
def get_session(session: Session) -> Response:
    """What the session is doing."""
    return answer(status_answer(session))


@router.patch("/{session_id}", dependencies=[operator])
def describe_session(request: Request, session_id: str, body: DescriptionIn) -> Response:
    """Change the name or the notes of a session."""
    row = book_of(request).describe(session_id, name=body.name, notes=body.notes)
    return answer(row_answer(book_of(request), row))


@router.get("/{session_id}/requirement", dependencies=[viewer])
def get_requirement(session: Session) -> Response:
    """What the session is judged by, and whether the coverage asked for is reached."""
    return answer(_requirement_answer(session))


@router.put("/{session_id}/requirement", dependencies=[operator])
def put_requirement(session: Session, body: RequirementIn) -> Response:
    """Ask for something else, in the place of all that was asked for; the answer comes when all is judged anew.

    It may be sent before, during and after a scan, and stays with the session; that it changed is an event.
    """
    session.terms.judge_by(body.to_requirement())
    return answer(_requirement_answer(session))


@router.put("/{session_id}/reference", dependencies=[operator])
def put_reference(request: Request, session: Session, body: ReferenceIn) -> Response:
    """Measure coverage against a nominal part in the replay folder; the answer comes when all is judged anew."""
    surface, spec = open_reference(ReferenceSpec(body.file, body.units), request.app.state.service.replay_dir)
    session.terms.measure_against(spec, Nominal(surface))
    return answer(_requirement_answer(session))


@router.delete("/{session_id}/reference", dependencies=[operator])
def delete_reference(session: Session) -> Response:
    """Measure coverage against the surface seen again."""
    session.terms.measure_against(None, NO_NOMINAL)
    return answer(_requirement_answer(session))


def _requirement_answer(session: LiveSession) -> dict[str, Any]:
    status, results = session.status(), session.results()
    return {
        "requirement": requirement_told(session.settings.target),
        "reference": session.row.settings.get("reference"),
        "holds": status.holds,
        "coverage": status.coverage,
        "coverage_kind": status.coverage_kind,
        "reference_refused": None if results is None else results.reference_refused,
        "remarks": [] if results is None else results.remarks,
    }


@router.post("/{session_id}/open", status_code=202, dependencies=[operator])
def open_session(request: Request, session_id: str) -> Response:
    """Begin to reopen a session from the record: its live map is built from its lines. `GET` tells how far it is."""
    book = book_of(request)
    book.record.get_session(session_id)
    if book.live(session_id) is None and book.opening(session_id) is None:
        threading.Thread(target=book.open_quietly, args=(session_id,), name=f"opening-{session_id}").start()
    return answer(_opening_answer(book, session_id), 202)


@router.get("/{session_id}/open", dependencies=[viewer])
def opening_of_session(request: Request, session_id: str) -> Response:
    """Whether a session is open, and how far the building of its map is."""
    book = book_of(request)
    book.record.get_session(session_id)
    return answer(_opening_answer(book, session_id))


def _opening_answer(book: SessionBook, session_id: str) -> dict[str, Any]:
    opening = book.opening(session_id)
    return {
        "id": session_id,
        "is_open": book.live(session_id) is not None,
        "lines": None if opening is None else opening.lines,
        "of": None if opening is None else opening.of,
        "progress": _share(book, session_id),
        "failure": book.failure_to_open(session_id),
    }


@router.post("/{session_id}/start", dependencies=[operator])
def start_session(session: Session) -> Response:
    """Begin to scan."""
    session.start()
    return answer(status_answer(session))


@router.post("/{session_id}/pause", dependencies=[operator])
def pause_session(session: Session) -> Response:
    """Hold the scan: stage and laser of a device stop, pushed lines are refused until it is resumed."""
    session.pause()
    return answer(status_answer(session))


@router.post("/{session_id}/resume", dependencies=[operator])
def resume_session(session: Session) -> Response:
    """Go on behind the last line; the laser of a device is switched on."""
    session.resume()
    return answer(status_answer(session))


@router.get("/{session_id}/ledger", dependencies=[viewer])
def get_ledger(session: Session) -> Response:
    """What became of every line: sent = stored + under way + lost, by reason, for each device and pass."""
    return answer(session.losses())


@router.post("/{session_id}/stop", dependencies=[operator])
def stop_session(session: Session) -> Response:
    """Stop the scan, close its passes and judge it; the answer comes when the verdict is there."""
    session.stop()
    return answer(status_answer(session))


@router.delete("/{session_id}", status_code=204, dependencies=[admin])
def delete_session(
    request: Request, session_id: str, confirm: Annotated[str | None, Query(max_length=100)] = None
) -> Response:
    """Delete the session and everything stored of it; `confirm` is its id once more, so that none goes by mistake."""
    book = book_of(request)
    row = book.record.get_session(session_id)
    if confirm != session_id:
        count = book.record.count(session_id)
        raise NotConfirmed(
            f"this deletes session {session_id} ({row.name!r}, {count.lines} lines, {count.points} points) for good: "
            f"say so with ?confirm={session_id}"
        )
    book.delete(session_id)
    return Response(status_code=204)


@router.get("/{session_id}/events", dependencies=[viewer])
def list_events(
    request: Request,
    session_id: str,
    after: Annotated[int, Query(ge=-1, lt=2**63)] = -1,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Response:
    """What happened in the session, in order."""
    found = []
    for event in book_of(request).record.events(session_id, after):
        found.append(event)
        if len(found) == limit:
            break
    return answer({"events": found, "next": found[-1].number if len(found) == limit else None})
