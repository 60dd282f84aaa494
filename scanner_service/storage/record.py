"""The durable record: sessions, their lines and events; knows who may open the file, and leaves the rest to others.

One writer thread with the only connection that writes (`writer.py`), any number of reading ones (`reader.py`). What
is promised, and how it is kept, is in `docs/record.md`.
"""

import math
import random
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from operator import methodcaller
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from sqlalchemy.exc import DBAPIError

from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.passes import PassKey
from scanner_service.storage.answer import Answer
from scanner_service.storage.batch import Batch, EncodedLine
from scanner_service.storage.database import SqliteFile
from scanner_service.storage.errors import NotStorable, RecordNotDurable, RecordNotWritable
from scanner_service.storage.identifiers import new_session_id
from scanner_service.storage.place import Place
from scanner_service.storage.postgres import PostgresSchema, is_url
from scanner_service.storage.reader import OnDamage, RecordReader
from scanner_service.storage.rows import (
    Count,
    CreationKey,
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
        place: Place,
        writer: Writer,
        reader: RecordReader,
        clock: Callable[[], datetime],
        rng: random.Random,
    ) -> None:
        self.place = place
        self._writer = writer
        self._reader = reader
        self._clock = clock
        self._rng = rng
        self._let_go = False

    @classmethod
    def open(
        cls,
        where: Path | str,
        *,
        limits: Limits | None = None,
        clock: Callable[[], datetime] = utc_now,
        rng: random.Random | None = None,
        connection_class: type[sqlite3.Connection] = sqlite3.Connection,
    ) -> "Record":
        """Open the record in a file, or at an address `postgresql://…`; make an empty one where there is none.

        Parameters
        ----------
        where : the file, beside which SQLite keeps `-wal` and `-shm`, and the service `.lock`; or the address of a
            PostgreSQL database.
        limits : bounds of the writer.
        clock, rng : time and chance, for time stamps and session ids.
        connection_class : class of the writer's connection to a file; the seam at which tests let the disk fail.

        Raises
        ------
        RecordUnusable : one of its kinds; nothing was changed.
        """

        def now() -> str:
            return _iso(clock())

        place: Place = (
            PostgresSchema.open(str(where), now)
            if is_url(where)
            else SqliteFile.open(Path(where), now, connection_class)
        )
        try:
            writer = Writer(place, limits or Limits())
        except DBAPIError as error:
            place.release()
            unusable = RecordNotDurable if is_url(where) else RecordNotWritable
            raise unusable(f"the record {place.name} cannot be opened: {error.orig}") from error
        except BaseException:
            place.release()
            raise
        return cls(place, writer, RecordReader(place.reader_engine()), clock, rng or random.SystemRandom())

    def close(self, timeout_s: float = 10.0) -> int:
        """Take nothing more, write what waits, and let go of the file; idempotent.

        Returns the number of lines that could not be confirmed as stored within `timeout_s` (their futures say why).
        """
        given_up = self._writer.close(timeout_s)
        if not self._writer.is_alive and not self._let_go:
            self._let_go = True
            self._reader.close()
            self.place.release()
        return given_up

    def __enter__(self) -> "Record":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- lines and events ---------------------------------------------------------------------------------------

    def append(self, session_id: str, line: StoredLine, timeout_s: float = 0.0) -> Answer[Stored]:
        """Queue a line; the future has its answer after the commit that made it durable has returned.

        Never waits unless told to: with a full spool it raises after `timeout_s`, and the line was not taken. The
        future raises SessionUnknown, WriteRefused or RecordClosed when the line is not (or not surely) stored.

        Raises
        ------
        NotStorable, RecordBusy, RecordClosed : the line was not taken; the caller counts it or offers it again.
        """
        encoded = EncodedLine.of(line)
        size_bytes = len(encoded.encoded) + _ROW_BYTES
        store = methodcaller("append_line", session_id, encoded)
        return self._writer.submit(store, size_bytes, timeout_s, True)

    def append_event(
        self, session_id: str, kind: str, details: Mapping[str, Any], timeout_s: float = 0.0
    ) -> Answer[EventRow]:
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

    @property
    def is_failing(self) -> bool:
        """True while the record cannot be written."""
        return self._writer.is_failing

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
        calibration: Mapping[str, Any] | None = None,
        key: CreationKey | None = None,
    ) -> SessionRow:
        """Make a session; returns when it is durable. With a `key` that came before it is the session made then.

        Raises
        ------
        NotStorable, RecordBusy, RecordClosed
        CreationKeyReused : the key came before, with another request.
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
            calibration=dict(calibration or {}),
        )
        for what in ("settings", "source", "calibration"):
            to_json(getattr(session, what), what)
        milliseconds = int(now.timestamp() * 1000)

        def create(batch: Batch) -> SessionRow:
            made = batch.made_with(key) if key is not None else None
            if made is not None:
                return made
            session_id = new_session_id(milliseconds, self._rng, batch.newest_session_id())
            return batch.create_session(replace(session, session_id=session_id), key)

        return self._wait_for(create)

    def list_sessions(self, limit: int = 100, after: str | None = None) -> list[SessionRow]:
        """See `RecordReader.list_sessions`."""
        return self._reader.list_sessions(limit, after)

    def get_session(self, session_id: str) -> SessionRow:
        """See `RecordReader.get_session`."""
        return self._reader.get_session(session_id)

    def set_state(self, session_id: str, state: str) -> SessionRow:
        """Change a session's state; raises SessionUnknown, SessionDamaged and what `create_session` does."""
        return self.change_state(session_id, state, _PATIENCE_S).result(_PATIENCE_S)

    def change_state(self, session_id: str, state: str, timeout_s: float = 0.0) -> Answer[SessionRow]:
        """Queue a change of a session's state; the future has its answer when the change is durable."""
        plain_text(state, "state")
        now = self._now()
        return self._writer.submit(lambda batch: batch.set_state(session_id, state, now), _ROW_BYTES, timeout_s)

    def describe(self, session_id: str, *, name: str | None = None, notes: str | None = None) -> SessionRow:
        """Change the name or the notes of a session, None leaves them; raises what `set_state` does, NotStorable."""
        for text in (name, notes):
            if text is not None:
                plain_text(text, "name and the notes")
        now = self._now()
        return self._wait_for(lambda batch: batch.describe(session_id, name, notes, now))

    def change_settings(self, session_id: str, settings: Mapping[str, Any]) -> SessionRow:
        """Keep other settings of a session; raises what `set_state` does, NotStorable."""
        settings = dict(settings)
        to_json(settings, "settings")
        now = self._now()
        return self._wait_for(lambda batch: batch.change_settings(session_id, settings, now))

    def save_ledger(self, session_id: str, account: Mapping[str, Any]) -> Answer[None]:
        """Queue the account of a session's losses, in place of the one before; answered and refused as an event is."""
        account = dict(account)
        size_bytes, now = len(to_json(account, "ledger")) + _ROW_BYTES, self._now()
        return self._writer.submit(lambda batch: batch.save_ledger(session_id, account, now), size_bytes, 0.0)

    def ledger(self, session_id: str) -> Mapping[str, Any] | None:
        """See `RecordReader.ledger`."""
        return self._reader.ledger(session_id)

    def lines_of_passes(self, session_id: str) -> Mapping[PassKey, int]:
        """See `RecordReader.lines_of_passes`."""
        return self._reader.lines_of_passes(session_id)

    def made_with(self, key: CreationKey) -> SessionRow | None:
        """See `RecordReader.made_with`."""
        return self._reader.made_with(key)

    def used_bytes(self) -> int:
        """See `RecordReader.used_bytes`."""
        return self._reader.used_bytes()

    def session_bytes(self, session_id: str) -> int:
        """See `RecordReader.session_bytes`."""
        return self._reader.session_bytes(session_id)

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
