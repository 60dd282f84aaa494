"""Reads the record through connections that can neither write nor checkpoint; verifies every row it hands out.

No read holds a transaction for longer than one chunk, so a slow reader never keeps the log from being reused.
"""

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Select, Table, func, select
from sqlalchemy.exc import DBAPIError

from scanner_service.analysis.intake import StoredLine
from scanner_service.storage.batch import session_from
from scanner_service.storage.database import check_identity, reader_engine
from scanner_service.storage.encoding import decode_line
from scanner_service.storage.errors import LineDamaged, NotARecord, RecordUnreadable, SessionUnknown
from scanner_service.storage.rows import Count, DamagedLine, EventRow, SessionRow, Verification, Watermark
from scanner_service.storage.tables import events, from_json, lines, metadata, row_crc, sessions
from scanner_service.storage.tail import load_count, load_tail

_LINES_A_CHUNK = 32
_EVENTS_A_CHUNK = 256
OnDamage = Callable[[DamagedLine], None]


class RecordReader:
    """The reading half of a record, for any thread and, by itself, for another process."""

    def __init__(self, path: Path) -> None:
        self._engine = reader_engine(path)

    @classmethod
    def open(cls, path: Path) -> "RecordReader":
        """A reader of a record that may at the same time be open in a service.

        Raises
        ------
        NotARecord, RecordTooNew
        """
        path = path.resolve()
        if not path.is_file():
            raise NotARecord(f"there is no record {path}")
        try:
            with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as connection:
                check_identity(connection, path)
        except sqlite3.Error as error:
            raise NotARecord(f"the record {path} cannot be read: {error}") from error
        return cls(path)

    def close(self) -> None:
        """Let go of the file."""
        self._engine.dispose()

    def list_sessions(self, limit: int = 100, after: str | None = None) -> list[SessionRow]:
        """At most `limit` sessions, the newest first, those older than the session `after`."""
        query = select(sessions).where(sessions.c.deleted_utc == "").order_by(sessions.c.session_id.desc())
        if after is not None:
            query = query.where(sessions.c.session_id < after)
        return [session_from(row) for row in self._rows(query.limit(limit))]

    def get_session(self, session_id: str) -> SessionRow:
        """One session; raises SessionUnknown."""
        query = select(sessions).where(sessions.c.session_id == session_id, sessions.c.deleted_utc == "")
        for row in self._rows(query):
            return session_from(row)
        raise SessionUnknown(f"there is no session {session_id}")

    def events(self, session_id: str, after: int = -1) -> Iterator[EventRow]:
        """The events of a session numbered above `after`, in order; raises SessionUnknown."""
        self.get_session(session_id)
        return self._events(session_id, after)

    def count(self, session_id: str) -> Count:
        """Lines and points of a session; raises SessionUnknown."""
        self.get_session(session_id)
        with self._connection() as connection:
            return load_count(connection, session_id)

    def watermark(self, session_id: str) -> dict[str, Watermark]:
        """Of each device, how far the boot that stored last is durable; raises SessionUnknown."""
        self.get_session(session_id)
        with self._connection() as connection:
            return load_tail(connection, session_id).watermarks()

    def lines(
        self, session_id: str, start: int = 0, stop: int | None = None, *, on_damage: OnDamage | None = None
    ) -> Iterator[tuple[int, StoredLine]]:
        """The lines numbered `start` to `stop` (exclusive; None: all stored by now) in order, in constant memory.

        A damaged line goes to `on_damage` and the next one follows; without `on_damage` it is raised.

        Raises
        ------
        SessionUnknown : at once.
        LineDamaged : from the iterator, at a damaged line, when there is no `on_damage`.
        """
        end = self.count(session_id).lines
        return self._lines(session_id, max(start, 0), end if stop is None else min(stop, end), on_damage)

    def stored_rows(self, session_id: str) -> Iterator[tuple[Table, list[dict[str, Any]]]]:
        """Every row of a session as it is stored, damaged or not: table by table, lines in chunks; for copies.

        Raises
        ------
        SessionUnknown : at once.
        """
        self.get_session(session_id)
        return self._stored_rows(session_id)

    def verify(self, session_id: str) -> Verification:
        """Read everything of a session, and the structure of the whole file, and say what is damaged."""
        damaged: list[DamagedLine] = []
        problems = list(self._structure())
        sound_lines = points = 0
        if self.get_session(session_id).damaged:
            problems.append("the session's own row fails its checksum")
        for _, line in self.lines(session_id, on_damage=damaged.append):
            sound_lines += 1
            points += len(line.index)
        found = list(self.events(session_id))
        problems += [f"event {event.number} is damaged or gone" for event in found if event.damaged]
        for table, seen in ((lines, sound_lines + len(damaged)), (events, len(found))):
            # An expression keeps the database from answering out of an index, whose end may be what is lost.
            query = (
                select(func.count().label("count"))
                .select_from(table)
                .where(table.c.session_id.concat("") == session_id)
            )
            rows = self._rows(query)[0]["count"]
            if rows != seen:
                problems.append(f"{rows} {table.name} are in the table, {seen} in its index")
        return Verification(Count(sound_lines, points), tuple(damaged), tuple(problems))

    def _stored_rows(self, session_id: str) -> Iterator[tuple[Table, list[dict[str, Any]]]]:
        for table in metadata.sorted_tables:
            if table is lines or "session_id" not in table.c:
                continue
            if found := self._rows(select(table).where(table.c.session_id == session_id)):
                yield table, found
        last = -1
        query = select(lines).where(lines.c.session_id == session_id).order_by(lines.c.line_number)
        while chunk := self._rows(query.where(lines.c.line_number > last).limit(_LINES_A_CHUNK)):
            yield lines, chunk
            last = chunk[-1]["line_number"]

    def _structure(self) -> Iterator[str]:
        """What SQLite itself finds wrong with the file; it sees no flipped bit of a value."""
        with self._connection() as connection:
            for (message,) in connection.exec_driver_sql("PRAGMA integrity_check"):
                if message != "ok":
                    yield str(message)

    def _lines(
        self, session_id: str, start: int, stop: int, on_damage: OnDamage | None
    ) -> Iterator[tuple[int, StoredLine]]:
        for first in range(start, stop, _LINES_A_CHUNK):
            numbers = range(first, min(first + _LINES_A_CHUNK, stop))
            for number, row in self._chunk(session_id, numbers):
                try:
                    line = _verified(row)
                except LineDamaged as error:
                    if on_damage is None:
                        raise LineDamaged(f"line {number} of session {session_id}: {error}") from error
                    on_damage(DamagedLine(session_id, number, str(error)))
                else:
                    yield number, line

    def _chunk(self, session_id: str, numbers: range) -> Iterator[tuple[int, dict[str, Any] | str]]:
        """Each number with its row, or with the reason why there is none."""
        of_session = lines.c.session_id == session_id
        query = select(lines).where(of_session, lines.c.line_number.between(numbers[0], numbers[-1]))
        try:
            found: dict[int, dict[str, Any] | str] = {row["line_number"]: row for row in self._rows(query)}
        except RecordUnreadable:  # a page of the file is unreadable: one at a time, so that the others are not lost
            found = {
                number: self._single(select(lines).where(of_session, lines.c.line_number == number))
                for number in numbers
            }
        return ((number, found.get(number, "the line is gone")) for number in numbers)

    def _single(self, query: Select[Any]) -> dict[str, Any] | str:
        try:
            return next(iter(self._rows(query)), "the line is gone")
        except RecordUnreadable as error:
            return str(error)

    def _events(self, session_id: str, after: int) -> Iterator[EventRow]:
        expected = after + 1
        while True:
            query = select(events).where(events.c.session_id == session_id, events.c.number > after)
            chunk = self._rows(query.order_by(events.c.number).limit(_EVENTS_A_CHUNK))
            for row in chunk:
                found = _event(row)
                if not found.damaged:  # a damaged number tells nothing of what is missing before it
                    for missing in range(expected, found.number):
                        yield EventRow(session_id, missing, "", "", 0, {}, damaged=True)
                    expected = found.number
                expected += found.number == expected
                yield found
            if len(chunk) < _EVENTS_A_CHUNK:
                return
            after = chunk[-1]["number"]

    def _rows(self, query: Select[Any]) -> list[dict[str, Any]]:
        with self._connection() as connection:
            return [dict(row) for row in connection.execute(query).mappings()]

    @contextmanager
    def _connection(self) -> Iterator[Connection]:
        try:
            with self._engine.connect() as connection:
                yield connection
        except DBAPIError as error:
            raise RecordUnreadable(f"the record cannot be read: {error.orig}") from error
        except UnicodeDecodeError as error:  # SQLite quotes damaged text in its message
            raise RecordUnreadable("the record cannot be read: its schema is damaged") from error


def _verified(row: dict[str, Any] | str) -> StoredLine:
    """The line of a row whose checksum holds."""
    if isinstance(row, str):
        raise LineDamaged(row)
    if row["crc32"] != row_crc(row):
        raise LineDamaged("its checksum does not match what is stored")
    return decode_line(row["encoded"])


def _event(row: dict[str, Any]) -> EventRow:
    details = from_json(row["details"])
    return EventRow(
        session_id=row["session_id"],
        number=row["number"],
        time_utc=row["time_utc"],
        kind=row["kind"],
        line_number=row["line_number"],
        details=details or {},
        damaged=details is None or row["crc32"] != row_crc(row),
    )
