"""The sessions of one service: creates, holds open, reopens and deletes them; knows no HTTP and no scanline."""

import contextlib
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path

from drivers.errors import PortBusy
from drivers.port_names import is_among
from scanner_service.rescan.reference import ReferenceSurface
from scanner_service.sessions.calibration import calibration_after, calibration_of, geometry_from, towards_sensor_from
from scanner_service.sessions.errors import BudgetSpent, SessionBusy, SessionError
from scanner_service.sessions.pass_desk import PassDesk
from scanner_service.sessions.references import Nominal, nominal_of
from scanner_service.sessions.reopening import Opening
from scanner_service.sessions.retention import OVER, Kept, Retention, choose
from scanner_service.sessions.session import LiveSession
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source import OnPorts, Source
from scanner_service.sessions.source_specs import PushSpec, SourceSpec, let_go
from scanner_service.sessions.still_sources import PushSource, SpentSource
from scanner_service.sessions.withdrawals import SERVICE_ENDED
from scanner_service.storage.errors import RecordError, SessionUnknown
from scanner_service.storage.record import Record, utc_now
from scanner_service.storage.rows import CreationKey, SessionRow

_LOG = logging.getLogger(__name__)
MAX_LIVE = 16
_HOLDING = ("created", "scanning", "paused")
"""States in which a session has its ports open."""


class SessionBook:
    """All sessions of one record; those that somebody looks at are held open."""

    def __init__(
        self,
        record: Record,
        retention: Retention | None = None,
        clock: Callable[[], datetime] = utc_now,
        meshes: Path | None = None,
        rigs: Path | None = None,
        check_ready: Callable[[], None] = lambda: None,
    ) -> None:
        self.record = record
        self._check_ready = check_ready  # raises what whoever wants a session opened is to be told instead
        self._meshes = meshes  # the folder in which reference meshes lie
        self._rigs = rigs  # the folder in which rig files lie
        self.retention = retention or Retention()
        self._clock = clock
        self._live: dict[str, LiveSession] = {}
        self._desks: dict[str, tuple[LiveSession, PassDesk]] = {}
        self._opening: dict[str, Opening] = {}
        self._creating: set[str] = set()
        self._deleting: set[str] = set()
        self._leaving: dict[str, threading.Event] = {}  # sessions that are just being closed to make room
        self._places = 0  # kept for sessions that are being made
        self._is_closed = False
        self._failures: dict[str, str] = {}
        self._lock = threading.RLock()
        for row in self._all_rows():
            if row.state in ("scanning", "paused"):  # the service ended in the middle of it
                try:
                    record.set_state(row.session_id, "interrupted")
                    record.append_event(row.session_id, SERVICE_ENDED, {})
                except RecordError as error:  # one damaged row must not keep all others from being served
                    _LOG.warning("session %s cannot be marked as interrupted: %s", row.session_id, error)

    def create(
        self,
        name: str,
        spec: SourceSpec,
        settings: SessionSettings | None = None,
        origin_mm: Sequence[float] = (0.0, 0.0, 0.0),
        source: Source | None = None,
        key: CreationKey | None = None,
        reference: ReferenceSurface | None = None,
    ) -> LiveSession:
        """Make a session and hold it open; `source` is the opened source when the caller has it already.

        `reference` is the nominal part that the settings name, when the caller has it already. With a `key` that came
        before, the session that was made then; nothing is opened or made.

        Raises
        ------
        SessionBusy : too many sessions are open, or the same request is being carried out.
        KernelsCompiling : it is too early to open one.
        BudgetSpent : the disk budget is used up.
        SourceUnusable, DriverError : the source cannot be opened; no session was made.
        CreationKeyReused : the key came before, with another request.
        RecordError : the session could not be recorded.
        """
        try:
            if key is None:
                return self._create(name, spec, settings, origin_mm, source, None, reference)
            with self._making(key):
                made = self.made_with(key)
                if made is None:
                    return self._create(name, spec, settings, origin_mm, source, key, reference)
                let_go(spec)
                return made
        except BaseException:
            let_go(spec)
            raise

    @contextlib.contextmanager
    def _making(self, key: CreationKey) -> Iterator[None]:
        """Hold off other requests with this key."""
        with self._lock:
            if key.key_sha256 in self._creating:
                raise SessionBusy("the same request is being carried out; ask again in a moment")
            self._creating.add(key.key_sha256)
        try:
            yield
        finally:
            with self._lock:
                self._creating.discard(key.key_sha256)

    def made_with(self, key: CreationKey | None) -> LiveSession | None:
        """The session that an earlier request with this key made, held open; None when there is none.

        Raises
        ------
        CreationKeyReused : the key came before, with another request.
        """
        made = None if key is None else self.record.made_with(key)
        return None if made is None else self.get(made.session_id)

    def _create(
        self,
        name: str,
        spec: SourceSpec,
        settings: SessionSettings | None,
        origin_mm: Sequence[float],
        source: Source | None,
        key: CreationKey | None,
        reference: ReferenceSurface | None,
    ) -> LiveSession:
        self._check_ready()
        self.make_room_on_disk()
        with self._place_kept():
            opened = self._open(spec) if source is None else source
            try:
                row = self.record.create_session(
                    name,
                    state="created",
                    settings=(settings or SessionSettings()).to_dict(),
                    origin_mm=origin_mm,
                    source=spec.to_dict(),
                    calibration=calibration_of(opened),
                    key=key,
                )
                named = (settings or SessionSettings()).reference
                nominal = nominal_of(named, self._meshes) if reference is None else Nominal(reference)
                session = LiveSession(row, self.record, opened, nominal=nominal)
                session.open()
            except BaseException:
                opened.stop()
                raise
            self._hold(session)
            return session

    @contextlib.contextmanager
    def _place_kept(self) -> Iterator[None]:
        """Keep a place among the open sessions for one that is being made; nobody waits for its disk or its device."""
        with self._lock:
            leaving = self._make_room()
            self._places += 1
        try:
            self._see_off(leaving)
            yield
        finally:
            with self._lock:
                self._places -= 1

    def _hold(self, session: LiveSession) -> None:
        """Hold a session open from now on, or close it: raises SessionBusy when all are being closed."""
        try:
            desk = PassDesk(session, self._rigs)  # from it the session knows what is to be decided of its passes
            with self._lock:
                if self._is_closed:
                    raise SessionBusy("the service is being closed")
                self._live[session.row.session_id], self._desks[session.row.session_id] = session, (session, desk)
        except BaseException:
            session.close()
            raise

    def _open(self, spec: SourceSpec) -> Source:
        """Open a source; when a port is held by a session of this book, say by which."""
        try:
            return spec.open()
        except PortBusy as error:
            for session in self.open_sessions():
                source = session.source
                if session.state in _HOLDING and isinstance(source, OnPorts) and is_among(error.path, source.ports):
                    raise PortBusy(
                        error.path,
                        f"{error.path} is held by session {session.row.session_id} ({session.row.name}), which is "
                        f"{session.state}; stop that one first",
                    ) from error
            raise

    def get(self, session_id: str, on_progress: Callable[[int], None] = lambda lines: None) -> LiveSession:
        """The session, reopened from the record when nobody holds it open: the map is built from its lines.

        Whoever asks for a session that is being reopened waits for it; nobody waits for another one.

        Raises
        ------
        SessionUnknown : there is none.
        SessionBusy : too many sessions are open.
        KernelsCompiling : it is too early to open one.
        """
        while True:
            live = self._live.get(session_id)
            if live is not None:  # nobody waits here for a session that is being made
                return live
            with self._lock:
                live = self._live.get(session_id)
                if live is not None:
                    return live
                if session_id in self._deleting:
                    raise SessionUnknown(f"session {session_id} is being deleted")
                busy = self._busy_with(session_id)
                if busy is None:
                    row = self.record.get_session(session_id)
                    self._check_ready()
                    leaving = self._make_room()
                    mine = self._opening[session_id] = Opening(self.record.count(session_id).lines)
                    break
            busy.wait()
        try:
            self._see_off(leaving)
            return self._reopen(row, mine, on_progress)
        finally:
            with self._lock:
                del self._opening[session_id]
            mine.done.set()

    def _reopen(self, row: SessionRow, opening: Opening, on_progress: Callable[[int], None]) -> LiveSession:
        def taken(number: int) -> None:
            opening.lines = number + 1
            on_progress(number)

        is_push = row.source.get("kind") == PushSpec().to_dict()["kind"]
        kept = calibration_after(row.calibration, self.record.events(row.session_id))
        source: Source = PushSource() if is_push else SpentSource(geometry_from(kept), towards_sensor_from(kept))
        nominal = nominal_of(SessionSettings.from_dict(row.settings).reference, self._meshes)
        if nominal.refused is not None:
            _LOG.warning("session %s is %s", row.session_id, nominal.refused)
        session = LiveSession(row, self.record, source, nominal=nominal)
        session.open(taken)
        self._hold(session)
        session.terms.read_again()  # it may have been renamed since its row was read
        return session

    def open_quietly(self, session_id: str) -> None:
        """Reopen a session; what keeps it from being opened is told by `failure_to_open`."""
        self._failures.pop(session_id, None)
        try:
            self.get(session_id)
        except (SessionError, RecordError) as error:
            self._failures[session_id] = str(error)

    def failure_to_open(self, session_id: str) -> str | None:
        """Why the session could not be reopened when that was last tried; None when it could."""
        return self._failures.get(session_id)

    def opening(self, session_id: str) -> Opening | None:
        """How far a session is that is being reopened; None when it is not."""
        return self._opening.get(session_id)

    def pass_desk(self, session: LiveSession) -> PassDesk:
        """The desk where the passes of a session that is held open are ordered."""
        held, desk = self._desks.get(session.row.session_id, (None, None))
        return desk if desk is not None and held is session else PassDesk(session, self._rigs)  # it was just let go of

    def live(self, session_id: str) -> LiveSession | None:
        """The session if it is held open."""
        return self._live.get(session_id)

    def open_sessions(self) -> list[LiveSession]:
        """The sessions that are held open."""
        return list(self._live.values())

    def rows(self, limit: int = 100, after: str | None = None) -> list[SessionRow]:
        """A page of the record's sessions, newest first."""
        return self.record.list_sessions(limit, after)

    def describe(self, session_id: str, *, name: str | None = None, notes: str | None = None) -> SessionRow:
        """Change the name or the notes of a session; raises SessionUnknown and what `Record.describe` does."""
        row = self.record.describe(session_id, name=name, notes=notes)
        live = self._live.get(session_id)
        if live is not None:
            live.terms.read_again()
        return row

    def delete(self, session_id: str) -> None:
        """Stop and delete a session with everything stored of it; raises SessionUnknown."""
        while True:
            with self._lock:
                busy = self._busy_with(session_id)
                if busy is None:
                    if session_id in self._deleting:
                        raise SessionUnknown(f"session {session_id} is being deleted")
                    self._deleting.add(session_id)
                    live = self._live.pop(session_id, None)
                    self._desks.pop(session_id, None)
                    break
            busy.wait()
        try:
            if live is not None:
                live.close()
            self.record.delete_session(session_id)
        finally:
            with self._lock:
                self._deleting.discard(session_id)

    def make_room_on_disk(self) -> list[tuple[str, str]]:
        """Delete what the retention says; the sessions deleted, with the reason.

        Raises BudgetSpent when the budget is exceeded and nothing more may be deleted.
        """
        if self.retention.is_unlimited:
            return []
        kept = [
            Kept(
                row.session_id,
                datetime.fromisoformat(row.created_utc),
                self.record.session_bytes(row.session_id),
                may_go=row.state in OVER and row.session_id not in self._live,
            )
            for row in self._all_rows()
            if not row.damaged
        ]
        choice = choose(self.retention, kept, self._clock())
        for session_id, reason in choice.deleted:
            _LOG.warning("session %s was deleted: %s", session_id, reason)
            self.delete(session_id)
        if choice.over_bytes:
            raise BudgetSpent(
                f"the disk budget is exceeded by {choice.over_bytes / 1e6:.1f} MB, and no session may be deleted for "
                "it by itself: delete sessions, or raise the budget"
            )
        return list(choice.deleted)

    def close(self) -> None:
        """Stop and close all sessions; the record stays open."""
        with self._lock:
            self._is_closed = True
            closing, self._live = self._live, {}
            leaving = list(self._leaving.values())
        with contextlib.ExitStack() as stack:  # one that cannot be closed keeps none of the others open
            for event in leaving:
                stack.callback(event.wait)
            for live in closing.values():
                stack.callback(live.close)

    def _make_room(self) -> LiveSession | None:
        """Let go of the session that was opened first among those that neither scan nor stand between two passes.

        The lock is held; whoever called closes it (`_see_off`) without. None where there is room.
        """
        if len(self._live) + len(self._opening) + self._places < MAX_LIVE:
            return None
        for session_id, session in self._live.items():
            if session.state in OVER and not self._is_at_work(session_id):
                del self._live[session_id]
                self._desks.pop(session_id, None)
                self._leaving[session_id] = threading.Event()
                return session
        raise SessionBusy(f"{MAX_LIVE} sessions are scanning or waiting: stop one first")

    def _see_off(self, session: LiveSession | None) -> None:
        """Close a session that made room, for which nobody waits but who asks for that one."""
        if session is None:
            return
        try:
            session.close()
        finally:
            with self._lock:
                self._leaving.pop(session.row.session_id).set()

    def _busy_with(self, session_id: str) -> threading.Event | None:
        """What whoever wants this session has to wait for: it is being opened, or closed. The lock is held."""
        opening = self._opening.get(session_id)
        return self._leaving.get(session_id) if opening is None else opening.done

    def _is_at_work(self, session_id: str) -> bool:
        """True for a session whose rescan loop or pass is under way."""
        known = self._desks.get(session_id)
        return known is not None and known[1].is_at_work

    def _all_rows(self) -> list[SessionRow]:
        rows: list[SessionRow] = []
        while page := self.record.list_sessions(100, rows[-1].session_id if rows else None):
            rows += page
        return rows
