"""The live stream of a session over a WebSocket: points as credit allows, status and regions as they change."""

import asyncio
import contextlib
import json
import time
from typing import Any

from fastapi import APIRouter, Depends, WebSocket
from starlette.concurrency import run_in_threadpool
from starlette.websockets import WebSocketDisconnect

from scanner_service.api.access import Access, Identity
from scanner_service.api.answers import plain
from scanner_service.api.keys import Role
from scanner_service.api.live_frames import MAX_POINTS, point_message
from scanner_service.api.live_regions import RegionsTold
from scanner_service.api.routes.sessions import status_answer
from scanner_service.api.scopes import accepted_subprotocol, require
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.errors import SessionError
from scanner_service.sessions.results import Results
from scanner_service.sessions.session import LiveSession
from scanner_service.sessions.still_sources import PushSource
from scanner_service.storage.errors import RecordError, SessionUnknown

router = APIRouter()
UPDATE_PERIOD_S = 1 / 30
STATUS_PERIOD_S = 0.5
OPENING_PERIOD_S = 0.2
ACCESS_PERIOD_S = 0.5
MAX_CREDIT = 64
MAX_REQUEST_CHARACTERS = 1024
FINISHED, GOING_AWAY, POLICY, TRY_AGAIN_LATER, NOT_FOUND = 1000, 1001, 1008, 1013, 4404


class AccessEnded(Exception):
    """What the client showed when it connected does not hold any more."""


class _Credit:
    """How many binary messages the client is ready to take; owned by the connection's event loop."""

    def __init__(self) -> None:
        self.left = 0
        self.granted = asyncio.Event()

    def grant(self, more: int) -> None:
        self.left = min(MAX_CREDIT, self.left + more)
        self.granted.set()

    def spend(self) -> None:
        self.left -= 1
        if self.left == 0:
            self.granted.clear()


@router.websocket("/api/v1/sessions/{session_id}/live", dependencies=[Depends(require(Role.VIEWER))])
async def live(websocket: WebSocket, session_id: str) -> None:
    """Serve one client until it leaves, has everything there will ever be, or the session is closed."""
    await websocket.accept(subprotocol=accepted_subprotocol(websocket))
    try:
        session = await _opened(websocket, session_id)
    except WebSocketDisconnect:
        return
    except (RecordError, SessionError) as error:
        await _say(websocket, {"type": "error", "detail": str(error)})
        await websocket.close(NOT_FOUND if isinstance(error, SessionUnknown) else TRY_AGAIN_LATER)
        return
    credit, greeted = _Credit(), asyncio.Event()
    listening = asyncio.create_task(_listen(websocket, credit))
    sending = [
        asyncio.create_task(_send_status(websocket, session, greeted)),
        asyncio.create_task(_send_points(websocket, session, credit, greeted)),
    ]
    all_sent = asyncio.gather(*sending)
    watching = asyncio.create_task(_watch_access(websocket))
    waited_for: tuple[asyncio.Future[Any], ...] = (watching, listening, all_sent)
    try:
        done, _ = await asyncio.wait(waited_for, return_when=asyncio.FIRST_COMPLETED)
    finally:  # also when the server ends this task
        for task in (watching, listening, *sending):
            task.cancel()
        await asyncio.gather(watching, listening, *sending, all_sent, return_exceptions=True)
    ended = next(task for task in waited_for if task in done)
    await _part(websocket, ended.exception())


async def _opened(websocket: WebSocket, session_id: str) -> LiveSession:
    """The session; while its map is being built from the record, the client is told how far that is."""
    book: SessionBook = websocket.app.state.service.book
    getting = asyncio.ensure_future(run_in_threadpool(book.get, session_id))
    while True:
        done, _ = await asyncio.wait((getting,), timeout=OPENING_PERIOD_S)
        if done:
            return getting.result()
        opening = book.opening(session_id)
        if opening is not None:
            told = {"type": "opening", "lines": opening.lines, "of": opening.of, "progress": opening.share}
            await _say(websocket, told)


async def _watch_access(websocket: WebSocket) -> None:
    """Raise once the key that this stream was opened with is revoked, or the browser's login has ended."""
    access: Access = websocket.app.state.access
    who: Identity = websocket.state.identity
    while access.still_holds(who):
        await asyncio.sleep(ACCESS_PERIOD_S)
    raise AccessEnded("the key or login that this stream was opened with is not valid any more")


def _is_final(session: LiveSession) -> bool:
    """The scan is over and judged, and nobody can start it again: what is said of it now stays so."""
    is_over = session.state in ("stopped", "failed", "interrupted") and session.results() is not None
    return is_over and not isinstance(session.source, PushSource)  # pushed lines may go on at any time


async def _part(websocket: WebSocket, error: BaseException | None) -> None:
    """Say why the stream ends, when there is somebody left to be told."""
    match error:
        case SessionError() | AccessEnded() | ValueError():
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                await _say(websocket, {"type": "error", "detail": str(error)})
                await websocket.close(GOING_AWAY if isinstance(error, SessionError) else POLICY)
        case None:
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                await websocket.close(FINISHED)
        case WebSocketDisconnect() | RuntimeError():  # the client left; starlette says it in two ways
            pass
        case _:
            raise error


async def _listen(websocket: WebSocket, credit: _Credit) -> None:
    """Take grants of credit; anything else ends the connection."""
    while True:
        received = await websocket.receive()
        if received["type"] == "websocket.disconnect":
            raise WebSocketDisconnect(received.get("code", GOING_AWAY))
        text = received.get("text")  # None: a binary message
        try:
            message = json.loads(text) if text is not None and len(text) <= MAX_REQUEST_CHARACTERS else None
        except (ValueError, RecursionError):
            message = None
        more = message.get("credit") if isinstance(message, dict) else None
        if not isinstance(more, int) or isinstance(more, bool) or more < 1:
            raise ValueError('the only request of this stream is {"credit": n} with n of at least 1')
        credit.grant(more)


async def _send_points(websocket: WebSocket, session: LiveSession, credit: _Credit, greeted: asyncio.Event) -> None:
    """Send what changed, at most 30 times a second, whenever there is credit; until nothing can change any more."""
    version = 0
    has_sent = False
    await greeted.wait()
    while True:
        await credit.granted.wait()
        asked_s = time.monotonic()
        is_final = _is_final(session)  # looked at before the question: its answer is the last word then
        changes = await asyncio.wrap_future(session.changes_since(version))
        if len(changes) == 0 and has_sent:
            if is_final:
                return
            await asyncio.sleep(UPDATE_PERIOD_S)
            continue
        for start in range(0, max(1, len(changes)), MAX_POINTS):
            await credit.granted.wait()
            page = await asyncio.wrap_future(session.read_page(changes, start, MAX_POINTS))
            message = await asyncio.to_thread(point_message, page)
            credit.spend()
            await websocket.send_bytes(message)
        has_sent = True
        version = changes.version
        await asyncio.sleep(rest_s(asked_s, time.monotonic()))


def rest_s(asked_s: float, now_s: float) -> float:
    """How long to wait before the next update: what the last one took is part of its period.

    One that took long is followed by a rest as long as itself, a whole period at the most, so that a client in a hurry
    does not take the time in which lines are read.
    """
    took_s = now_s - asked_s
    return max(UPDATE_PERIOD_S - took_s, min(took_s, UPDATE_PERIOD_S))


async def _send_status(websocket: WebSocket, session: LiveSession, greeted: asyncio.Event) -> None:
    """Send the status about twice a second, and the regions when there is a new verdict; until both are final."""
    told: Results | None = None
    regions_told = RegionsTold()
    while True:
        is_final = _is_final(session)
        status = await asyncio.to_thread(status_answer, session)
        await _say(websocket, {"type": "status", **status})
        greeted.set()
        results = session.results()
        if results is not None and results is not told:
            news = await asyncio.to_thread(regions_told.news, results.regions)
            await _say(websocket, {"type": "regions", "version": results.snapshot.version, **news})
            told = results
        if is_final:
            return
        await asyncio.sleep(STATUS_PERIOD_S)


async def _say(websocket: WebSocket, message: dict[str, object]) -> None:
    await websocket.send_text(await asyncio.to_thread(lambda: json.dumps(plain(message), allow_nan=False)))
