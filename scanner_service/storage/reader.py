"""Reads the record through connections that can neither write nor checkpoint; verifies every row it hands out.

No read holds a transaction for longer than one chunk, so a slow reader never keeps the log from being reused.
"""

import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, Select, Table, func, select, text
from sqlalchemy.exc import DBAPIError

from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.passes import PassKey
from scanner_service.storage.batch import SESSION_COLUMNS, session_from, session_made_with
from scanner_service.storage.database import (
    MOST_VALUE_BYTES,
    check_identity,
    reader_engine,
    structure_problems,
    used_bytes,
)
from scanner_service.storage.encoding import decode_line
from scanner_service.storage.errors import LineDamaged, NotARecord, RecordUnreadable, SessionUnknown
from scanner_service.storage.postgres import PostgresSchema, is_url
from scanner_service.storage.rows import (
    Count,
    CreationKey,
    DamagedLine,
    EventRow,
    SessionRow,
    Verification,
    Watermark,
)
from scanner_service.storage.tables import (
    SCHEMA_VERSION,
    events,
    from_json,
    ledgers,
    lines,
    metadata,
    notes,
    row_crc,
    sessions,
)
from scanner_service.storage.tail import load_count, load_tail

_LINES_A_CHUNK = 32
_EVENTS_A_CHUNK = 256
OnDamage = Callable[[DamagedLine], None]


class RecordReader:
    """The reading half of a record, for any thread and, by itself, for another process."""

    def __init__(self, engine: Engine, schema: int = SCHEMA_VERSION) -> None:
        self._engine = engine
        self._schema = schema

    @classmethod
    def open(cls, where: Path | str) -> "RecordReader":
        """A reader of a record that may at the same time be open in a service, in a file or at `postgresql://…`.

        A record of an older schema is read as it is.

        Raises
        ------
        NotARecord, RecordTooNew
        """
        if is_url(where):
            return cls(PostgresSchema.of_reader(str(where)).reader_engine())
        path = Path(where).resolve()
        if not path.is_file():
            raise NotARecord(f"there is no record {path}")
        try:
            with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)) as connection:
                connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_VALUE_BYTES)
                schema = check_identity(connection, path)
        except sqlite3.Error as error:
            raise NotARecord(f"the record {path} cannot be read: {error}") from error
        return cls(reader_engine(path, MOST_VALUE_BYTES), schema)

    def close(self) -> None:
        """Let go of the file."""
        self._engine.dispose()

    def list_sessions(self, limit: int = 100, after: str | None = None) -> list[SessionRow]:
        """At most `limit` sessions, the newest first, those older than the session `after`."""
        query = self._sessions().where(sessions.c.deleted_utc == "").order_by(sessions.c.session_id.desc())
        if after is not None:
            query = query.where(sessions.c.session_id < after)
        return [session_from(row) for row in self._rows(query.limit(limit))]

    def get_session(self, session_id: str) -> SessionRow:
        """One session; raises SessionUnknown."""
        query = self._sessions().where(sessions.c.session_id == session_id, sessions.c.deleted_utc == "")
        for row in self._rows(query):
            return session_from(row)
        raise SessionUnknown(f"there is no session {session_id}")

    def ledger(self, session_id: str) -> Mapping[str, Any] | None:
        """The account of a session's losses as it was last kept; None when there is none, or it is damaged."""
        if self._schema < 2:
            return None
        for row in self._rows(select(ledgers).where(ledgers.c.session_id == session_id)):
            return from_json(row["account"]) if row["crc32"] == row_crc(row) else None
        return None

    def lines_of_passes(self, session_id: str) -> dict[PassKey, int]:
        """How many lines are stored of each pass of a session, in order of their first."""
        key = (lines.c.device_id, lines.c.boot_id, lines.c.pass_index)
        query = select(*key, func.count().label("lines")).where(lines.c.session_id == session_id).group_by(*key)
        rows = self._rows(query.order_by(func.min(lines.c.line_number)))
        return {(row["device_id"], row["boot_id"], row["pass_index"]): row["lines"] for row in rows}

    def made_with(self, key: CreationKey) -> SessionRow | None:
        """The session that a request with this key made, None when there is none; raises CreationKeyReused."""
        with self._connection() as connection:
            return session_made_with(connection, key)

    def used_bytes(self) -> int:
        """Bytes that the record takes."""
        with self._connection() as connection:
            if connection.dialect.name == "sqlite":
                return used_bytes(connection)
            return int(connection.execute(text("SELECT pg_database_size(current_database())")).scalar_one())

    def session_bytes(self, session_id: str) -> int:
        """Bytes of the lines of a session."""
        total = select(func.coalesce(func.sum(func.length(lines.c.encoded)), 0).label("bytes"))
        return int(self._rows(total.where(lines.c.session_id == session_id))[0]["bytes"])

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
            if self._schema < 2 and table not in (sessions, events):
                continue  # a record of schema 1 has no others
            if found := self._rows(select(table).where(table.c.session_id == session_id)):
                yield table, found
        last = -1
        query = select(lines).where(lines.c.session_id == session_id).order_by(lines.c.line_number)
        while chunk := self._rows(query.where(lines.c.line_number > last).limit(_LINES_A_CHUNK)):
            yield lines, chunk
            last = chunk[-1]["line_number"]

    def _structure(self) -> Iterator[str]:
        """What the database itself finds wrong with the file; a server looks after its own."""
        with self._connection() as connection:
            if connection.dialect.name == "sqlite":
                yield from structure_problems(connection)

    def _sessions(self) -> Select[Any]:
        """Sessions with their notes, which a record of schema 1 does not have."""
        if self._schema < 2:
            return select(sessions)
        return select(*SESSION_COLUMNS).outerjoin(notes, notes.c.session_id == sessions.c.session_id)

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
