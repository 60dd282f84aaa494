"""The durable record: sessions, their lines and events; knows who may open the file, and leaves the rest to others.

One writer thread with the only connection that writes (`writer.py`), any number of reading ones (`reader.py`). What
is promised, and how it is kept, is in `docs/record.md`.
"""

import contextlib
import math
import random
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from sqlalchemy.exc import DBAPIError

from scanner_service.analysis.intake import StoredLine
from scanner_service.storage.batch import Batch, EncodedLine
from scanner_service.storage.database import (
    RecordLock,
    SqliteLibrary,
    check_file,
    check_place,
    create_file,
    sqlite_library,
    writable,
    writer_engine,
)
from scanner_service.storage.errors import NotStorable, RecordNotWritable
from scanner_service.storage.identifiers import new_session_id
from scanner_service.storage.reader import OnDamage, RecordReader
from scanner_service.storage.rows import (
    Count,
    EventRow,
    Limits,
    SessionRow,
    Stored,
    Verification,
    Watermark,
    WriterState,
)
from scanner_service.storage.tables import plain_text, to_json
from scanner_service.storage.writer import Writer

T = TypeVar("T")
_ROW_BYTES = 512  # what a line or an event takes in the spool beside its payload
_PATIENCE_S = 30.0  # how long a session's creation or change waits for a disk that does not answer


def utc_now() -> datetime:
    """The time in UTC."""
    return datetime.now(UTC)


class Record:
    """An open record. All methods may be called from any thread; all values are frozen."""

    def __init__(
        self,
        lock: RecordLock,
        writer: Writer,
        reader: RecordReader,
        sqlite: SqliteLibrary,
        clock: Callable[[], datetime],
        rng: random.Random,
    ) -> None:
        self._lock = lock
        self._writer = writer
        self._reader = reader
        self._clock = clock
        self._rng = rng
        self._let_go = False
        self.sqlite = sqlite

    @classmethod
    def open(
        cls,
        path: Path,
        *,
        limits: Limits | None = None,
        clock: Callable[[], datetime] = utc_now,
        rng: random.Random | None = None,
        connection_class: type[sqlite3.Connection] = sqlite3.Connection,
    ) -> "Record":
        """Open the record in the file `path`, or make an empty one.

        Parameters
        ----------
        path : the file; beside it SQLite keeps `-wal` and `-shm`, the service `.lock`.
        limits : bounds of the writer.
        clock, rng : time and chance, for time stamps and session ids.
        connection_class : class of the writer's connection; the seam at which tests let the disk fail.

        Raises
        ------
        RecordUnusable : one of `NotARecord`, `RecordTooNew`, `RecordInUse`, `RecordNotWritable`, `SqliteTooOld`;
            nothing was changed.
        """
        sqlite = sqlite_library()
        path = path.resolve()
        with contextlib.ExitStack() as undo:
            with writable(path):
                check_place(path)
                lock = RecordLock(path)  # before the file is looked at: see `docs/record.md`
                undo.callback(lock.release)
                if not path.exists():
                    create_file(path, _iso(clock()))
                check_file(path)
            try:
                writer = Writer(path, writer_engine(path, connection_class), limits or Limits())
            except DBAPIError as error:
                raise RecordNotWritable(f"the record {path} cannot be opened: {error.orig}") from error
            undo.pop_all()
        return cls(lock, writer, RecordReader(path), sqlite, clock, rng or random.SystemRandom())

    def close(self, timeout_s: float = 10.0) -> int:
        """Take nothing more, write what waits, and let go of the file; idempotent.

        Returns the number of lines that could not be confirmed as stored within `timeout_s` (their futures say why).
        """
        given_up = self._writer.close(timeout_s)
        if not self._writer.is_alive and not self._let_go:
            self._let_go = True
            self._reader.close()
            self._lock.release()
        return given_up

    def __enter__(self) -> "Record":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- lines and events ---------------------------------------------------------------------------------------

    def append(self, session_id: str, line: StoredLine, timeout_s: float = 0.0) -> "Future[Stored]":
        """Queue a line; the future has its answer after the commit that made it durable has returned.

        Never waits unless told to: with a full spool it raises after `timeout_s`, and the line was not taken. The
        future raises SessionUnknown, WriteRefused or RecordClosed when the line is not (or not surely) stored.

        Raises
        ------
        NotStorable, RecordBusy, RecordClosed : the line was not taken; the caller counts it or offers it again.
        """
        encoded = EncodedLine.of(line)
        size_bytes = len(encoded.encoded) + _ROW_BYTES
        return self._writer.submit(lambda batch: batch.append_line(session_id, encoded), size_bytes, timeout_s, True)

    def append_event(
        self, session_id: str, kind: str, details: Mapping[str, Any], timeout_s: float = 0.0
    ) -> "Future[EventRow]":
        """Queue an event behind everything appended before it; answered and refused as a line is."""
        plain_text(kind, "kind of the event")
        size_bytes = len(to_json(details, "details of the event")) + _ROW_BYTES
        details, now = dict(details), self._now()
        return self._writer.submit(
            lambda batch: batch.append_event(session_id, now, kind, details), size_bytes, timeout_s
        )

    def watermark(self, session_id: str) -> Mapping[str, Watermark]:
        """Of each device of a session, how far its lines are durable, in the boot whose line was stored last."""
        known = self._writer.watermarks(session_id)
        return self._reader.watermark(session_id) if known is None else known

    def writer_state(self) -> WriterState:
        """How the writer is, and what it did since the record was opened."""
        return self._writer.state()

    def lines(
        self, session_id: str, start: int = 0, stop: int | None = None, *, on_damage: OnDamage | None = None
    ) -> Iterator[tuple[int, StoredLine]]:
        """See `RecordReader.lines`."""
        return self._reader.lines(session_id, start, stop, on_damage=on_damage)

    def events(self, session_id: str, after: int = -1) -> Iterator[EventRow]:
        """See `RecordReader.events`."""
        return self._reader.events(session_id, after)

    def count(self, session_id: str) -> Count:
        """See `RecordReader.count`."""
        return self._reader.count(session_id)

    def verify(self, session_id: str) -> Verification:
        """See `RecordReader.verify`."""
        return self._reader.verify(session_id)

    # --- sessions -----------------------------------------------------------------------------------------------

    def create_session(
        self,
        name: str,
        *,
        state: str = "open",
        settings: Mapping[str, Any] | None = None,
        origin_mm: Sequence[float] = (0.0, 0.0, 0.0),
        source: Mapping[str, Any] | None = None,
    ) -> SessionRow:
        """Make a session; returns when it is durable.

        Raises
        ------
        NotStorable, RecordBusy, RecordClosed
        TimeoutError : the disk does not answer; the session may appear later.
        """
        origin = [float(value) for value in origin_mm]
        if len(origin) != 3 or not all(map(math.isfinite, origin)):
            raise NotStorable(f"the origin must be three finite millimetres, not {origin}")
        now = self._clock()
        session = SessionRow(
            session_id="",
            name=plain_text(name, "name"),
            created_utc=_iso(now),
            changed_utc=_iso(now),
            state=plain_text(state, "state"),
            settings=dict(settings or {}),
            origin_mm=(origin[0], origin[1], origin[2]),
            source=dict(source or {}),
        )
        to_json(session.settings, "settings")
        to_json(session.source, "source")
        milliseconds = int(now.timestamp() * 1000)

        def create(batch: Batch) -> SessionRow:
            session_id = new_session_id(milliseconds, self._rng, batch.newest_session_id())
            return batch.create_session(replace(session, session_id=session_id))

        return self._wait_for(create)

    def list_sessions(self, limit: int = 100, after: str | None = None) -> list[SessionRow]:
        """See `RecordReader.list_sessions`."""
        return self._reader.list_sessions(limit, after)

    def get_session(self, session_id: str) -> SessionRow:
        """See `RecordReader.get_session`."""
        return self._reader.get_session(session_id)

    def set_state(self, session_id: str, state: str) -> SessionRow:
        """Change a session's state; raises SessionUnknown, SessionDamaged and what `create_session` does."""
        plain_text(state, "state")
        now = self._now()
        return self._wait_for(lambda batch: batch.set_state(session_id, state, now))

    def delete_session(self, session_id: str) -> None:
        """Delete a session with all it holds; raises SessionUnknown and what `create_session` does.

        It is gone for everybody on return; its rows are taken away in the background, its space is used again.
        """
        now = self._now()
        self._wait_for(lambda batch: batch.delete_session(session_id, now))

    def _wait_for(self, run: Callable[[Batch], T]) -> T:
        return self._writer.submit(run, _ROW_BYTES, _PATIENCE_S).result(_PATIENCE_S)

    def _now(self) -> str:
        return _iso(self._clock())


def _iso(moment: datetime) -> str:
    return moment.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
