"""Sessions: create, list, start, stop, delete; every call is one call of the session book."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from scanner_service.api.answers import answer
from scanner_service.api.keys import Role
from scanner_service.api.schemas import DeviceSourceIn, PassIn, PushSourceIn, ReplaySourceIn, SessionIn
from scanner_service.api.scopes import require
from scanner_service.rescan.presets import PRESETS
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.errors import SourceUnusable
from scanner_service.sessions.references import open_reference
from scanner_service.sessions.session import LiveSession
from scanner_service.sessions.source_specs import DeviceSpec, PushSpec, ReplaySpec, SourceSpec
from scanner_service.storage.formats.recording import ReadOptions
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


def spec_of(source: DeviceSourceIn | ReplaySourceIn | PushSourceIn, replay_dir: Path) -> SourceSpec:
    """What the request asks to read from."""
    match source:
        case DeviceSourceIn():
            return DeviceSpec(**source.model_dump(exclude={"kind"}))
        case ReplaySourceIn():
            if source.file not in {item.name for item in replay_dir.iterdir()}:
                raise SourceUnusable(f"there is no file {source.file} in the service's replay folder")
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
        "lines": count.lines if count is not None else live.engine.ledger.received if live else 0,
        "points": count.points if count is not None else live.engine.ledger.counted if live else 0,
        "source": row.source,
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
        "progress": status.progress,
        "losses": status.losses,
        "durable": status.durable,
        "message": status.message,
        "origin_mm": session.row.origin_mm,
        "settings": session.row.settings,
        "source": session.row.source,
    }


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
    return answer({"presets": {name: preset.to_dict() for name, preset in PRESETS.items()}})


@router.post("", status_code=201, dependencies=[operator])
def create_session(request: Request, body: SessionIn) -> Response:
    """Make a session on a device, a replay file, or pushed scanlines. It does not scan before it is started."""
    spec = spec_of(body.source, request.app.state.service.replay_dir)
    settings, reference = body.settings.to_settings(), None
    if settings.reference is not None:
        reference, named = open_reference(settings.reference, request.app.state.service.replay_dir)
        settings = replace(settings, reference=named)
    session = book_of(request).create(body.name, spec, settings, body.origin_mm, reference=reference)
    location = {"Location": f"/api/v1/sessions/{session.row.session_id}"}
    return answer(status_answer(session), 201, location)


@router.get("/{session_id}", dependencies=[viewer])
def get_session(session: Session) -> Response:
    """What the session is doing."""
    return answer(status_answer(session))


@router.post("/{session_id}/start", dependencies=[operator])
def start_session(session: Session) -> Response:
    """Begin to scan."""
    session.start()
    return answer(status_answer(session))


@router.post("/{session_id}/stop", dependencies=[operator])
def stop_session(session: Session) -> Response:
    """Stop the scan, close its passes and judge it; the answer comes when the verdict is there."""
    session.stop()
    return answer(status_answer(session))


@router.post("/{session_id}/passes/withdraw", dependencies=[operator])
def withdraw_pass(session: Session, body: PassIn) -> Response:
    """Take a pass out of the map, as if it had never been scanned. Its raw lines stay in the record."""
    points = session.withdraw_pass((body.device_id, body.boot_id, body.pass_index))
    return answer({**status_answer(session), "withdrawn_points": points})


@router.delete("/{session_id}", status_code=204, dependencies=[admin])
def delete_session(request: Request, session_id: str) -> Response:
    """Delete the session and everything stored of it."""
    book_of(request).delete(session_id)
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
