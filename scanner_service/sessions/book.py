"""The sessions of one service: creates, holds open, reopens and deletes them; knows no HTTP and no scanline."""

import contextlib
import logging
import threading
from collections.abc import Callable, Sequence

from scanner_service.sessions.errors import SessionBusy
from scanner_service.sessions.pass_desk import PassDesk
from scanner_service.sessions.session import LiveSession
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import PushSpec, SourceSpec
from scanner_service.sessions.sources import PushSource, Source, SpentSource
from scanner_service.storage.errors import RecordError
from scanner_service.storage.record import Record
from scanner_service.storage.rows import SessionRow

_LOG = logging.getLogger(__name__)
MAX_LIVE = 16


class SessionBook:
    """All sessions of one record; those that somebody looks at are held open."""

    def __init__(self, record: Record) -> None:
        self.record = record
        self._live: dict[str, LiveSession] = {}
        self._desks: dict[str, tuple[LiveSession, PassDesk]] = {}
        self._lock = threading.RLock()
        for row in self._all_rows():
            if row.state in ("scanning", "paused"):  # the service ended in the middle of it
                try:
                    record.set_state(row.session_id, "interrupted")
                except RecordError as error:  # one damaged row must not keep all others from being served
                    _LOG.warning("session %s cannot be marked as interrupted: %s", row.session_id, error)

    def create(
        self,
        name: str,
        spec: SourceSpec,
        settings: SessionSettings | None = None,
        origin_mm: Sequence[float] = (0.0, 0.0, 0.0),
        source: Source | None = None,
    ) -> LiveSession:
        """Make a session and hold it open; `source` is the opened source when the caller has it already.

        Raises
        ------
        SessionBusy : too many sessions are open.
        SourceUnusable, DriverError : the source cannot be opened; no session was made.
        RecordError : the session could not be recorded.
        """
        with self._lock:
            self._make_room()
            opened = spec.open() if source is None else source
            try:
                row = self.record.create_session(
                    name,
                    state="created",
                    settings=(settings or SessionSettings()).to_dict(),
                    origin_mm=origin_mm,
                    source=spec.to_dict(),
                )
                return self._hold(LiveSession(row, self.record, opened))
            except BaseException:
                opened.stop()
                raise

    def get(self, session_id: str, on_progress: Callable[[int], None] = lambda lines: None) -> LiveSession:
        """The session, reopened from the record when nobody holds it open: the map is built from its lines.

        Raises
        ------
        SessionUnknown : there is none.
        SessionBusy : too many sessions are open.
        """
        live = self._live.get(session_id)
        if live is not None:  # nobody waits here for another session that is being reopened
            return live
        with self._lock:
            live = self._live.get(session_id)
            if live is not None:
                return live
            row = self.record.get_session(session_id)
            self._make_room()
            source: Source = PushSource() if row.source.get("kind") == PushSpec().to_dict()["kind"] else SpentSource()
            return self._hold(LiveSession(row, self.record, source), on_progress)

    def pass_desk(self, session: LiveSession) -> PassDesk:
        """The desk where the session's recommended passes are ordered; made when it is first asked for."""
        with self._lock:
            known = self._desks.get(session.row.session_id)
            if known is None or known[0] is not session:
                known = self._desks[session.row.session_id] = (session, PassDesk(session))
            return known[1]

    def live(self, session_id: str) -> LiveSession | None:
        """The session if it is held open."""
        return self._live.get(session_id)

    def open_sessions(self) -> list[LiveSession]:
        """The sessions that are held open."""
        return list(self._live.values())

    def rows(self, limit: int = 100, after: str | None = None) -> list[SessionRow]:
        """A page of the record's sessions, newest first."""
        return self.record.list_sessions(limit, after)

    def delete(self, session_id: str) -> None:
        """Stop and delete a session with everything stored of it; raises SessionUnknown."""
        with self._lock:
            live = self._live.pop(session_id, None)
            self._desks.pop(session_id, None)
            if live is not None:
                live.close()
            self.record.delete_session(session_id)

    def close(self) -> None:
        """Stop and close all sessions; the record stays open."""
        with self._lock, contextlib.ExitStack() as stack:  # one that cannot be closed keeps none of the others open
            for live in self._live.values():
                stack.callback(live.close)
            self._live = {}

    def _hold(self, session: LiveSession, on_progress: Callable[[int], None] = lambda lines: None) -> LiveSession:
        session.open(on_progress)
        self._live[session.row.session_id] = session
        return session

    def _make_room(self) -> None:
        """Close the session that was opened first among those that do not scan."""
        if len(self._live) < MAX_LIVE:
            return
        for session_id, session in self._live.items():
            if session.state in ("stopped", "failed", "interrupted"):
                session.close()
                del self._live[session_id]
                self._desks.pop(session_id, None)
                return
        raise SessionBusy(f"{MAX_LIVE} sessions are scanning or waiting: stop one first")

    def _all_rows(self) -> list[SessionRow]:
        rows: list[SessionRow] = []
        while page := self.record.list_sessions(100, rows[-1].session_id if rows else None):
            rows += page
        return rows
