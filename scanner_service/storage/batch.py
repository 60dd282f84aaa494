"""What may be done inside one transaction of the writer; knows no thread, no retry and no file.

Every method looks before it writes: a `RecordError` from it has changed nothing. The state a batch builds on
(`Tail`) is copied at first touch and handed back only when the batch is durable.
"""

import zlib
from collections.abc import Mapping
from functools import cache
from itertools import chain
from typing import Any, NamedTuple

from sqlalchemy import Connection, Dialect, Table, delete, func, insert, select, update

from scanner_service.analysis.intake import StoredLine
from scanner_service.storage.encoding import decode_line, encode_line
from scanner_service.storage.errors import CreationKeyReused, LineDamaged, SessionDamaged, SessionUnknown
from scanner_service.storage.rows import CreationKey, EventRow, SessionRow, Stored
from scanner_service.storage.tables import (
    LINE_COLUMNS,
    creations,
    events,
    from_json,
    ledgers,
    line_row,
    lines,
    notes,
    plain_text,
    record,
    row_crc,
    sessions,
    to_json,
)
from scanner_service.storage.tail import Tail, load_tail

DELETE_SLICE_LINES = 256
_ROWS_A_STATEMENT = (128, 32, 8, 1)


class EncodedLine(NamedTuple):
    """A line ready to be stored, made in the thread of the caller."""

    device_id: str
    boot_id: int
    line_index: int
    pass_index: int
    points: int
    encoded: bytes
    encoded_crc32: int

    @classmethod
    def of(cls, line: StoredLine) -> "EncodedLine":
        """Encode a line; raises NotStorable."""
        encoded = encode_line(line)
        key = (plain_text(line.device_id, "device id"), line.boot_id, line.line_index, line.pass_index)
        return cls(*key, len(line.index), encoded, zlib.crc32(encoded))


class Batch:
    """One transaction: jobs call its methods in order, then `finish` writes what was put off."""

    def __init__(self, connection: Connection, known: Mapping[str, Tail]) -> None:
        self._connection = connection
        self._known = known
        self._rows: list[tuple[Any, ...]] = []
        self.tails: dict[str, Tail] = {}
        self.deleted: set[str] = set()

    def append_line(self, session_id: str, line: EncodedLine) -> Stored:
        """Store a line, unless it, or another under its key, is there already."""
        tail = self._tail(session_id)
        mark = tail.marks.get((line.device_id, line.boot_id))
        if mark is not None and mark.first_index <= line.line_index <= mark.line_index:
            found = self._find(session_id, line)
            if found is not None:
                return found
        self._rows.append(
            line_row(
                session_id,
                tail.next_line,
                line.device_id,
                line.boot_id,
                line.line_index,
                line.pass_index,
                line.points,
                tail.points,
                line.encoded,
                line.encoded_crc32,
            )
        )
        tail.advance(line.device_id, line.boot_id, line.line_index, line.points)
        return Stored(tail.next_line - 1, "stored")

    def append_event(self, session_id: str, time_utc: str, kind: str, details: Mapping[str, Any]) -> EventRow:
        """Store an event, numbered within its session."""
        tail = self._tail(session_id)
        event = EventRow(session_id, tail.next_event, time_utc, kind, tail.next_line, details)
        row = {
            "session_id": session_id,
            "number": event.number,
            "time_utc": time_utc,
            "kind": kind,
            "line_number": event.line_number,
            "details": to_json(details, "details of the event"),
        }
        self._connection.execute(insert(events).values(row | {"crc32": row_crc(row)}))
        tail.next_event += 1
        return event

    def newest_session_id(self) -> str | None:
        """The greatest id of any session, deleted or not."""
        newest: str | None = self._connection.execute(select(func.max(sessions.c.session_id))).scalar()
        return newest

    def made_with(self, key: CreationKey) -> SessionRow | None:
        """The session that an earlier request with this key made; raises CreationKeyReused for another request."""
        return session_made_with(self._connection, key)

    def create_session(self, session: SessionRow, key: CreationKey | None = None) -> SessionRow:
        """Store a session, and with which request it was made."""
        x_mm, y_mm, z_mm = session.origin_mm
        row = {
            "session_id": session.session_id,
            "name": session.name,
            "created_utc": session.created_utc,
            "changed_utc": session.changed_utc,
            "state": session.state,
            "settings": to_json(session.settings, "settings"),
            "origin_x_mm": x_mm,
            "origin_y_mm": y_mm,
            "origin_z_mm": z_mm,
            "source": to_json(session.source, "source"),
            "deleted_utc": "",
        }
        self._connection.execute(insert(sessions).values(row | {"crc32": row_crc(row)}))
        if session.calibration or session.notes:
            self._put(notes, session.session_id, _notes_row(session.session_id, session.notes, session.calibration))
        if key is not None:
            made = {
                "key_sha256": key.key_sha256,
                "request_sha256": key.request_sha256,
                "session_id": session.session_id,
                "time_utc": session.created_utc,
            }
            of_deleted = creations.c.key_sha256 == key.key_sha256  # of no other: `made_with` was asked
            self._connection.execute(delete(creations).where(of_deleted))
            self._connection.execute(insert(creations).values(made | {"crc32": row_crc(made)}))
        self.tails[session.session_id] = Tail()
        return session

    def describe(self, session_id: str, name: str | None, text: str | None, now_utc: str) -> SessionRow:
        """Change a session's name or notes."""
        changes = {"changed_utc": now_utc} | ({} if name is None else {"name": name})
        row = self._update(session_id, self._sound_session(session_id), changes)
        kept = self._connection.execute(select(notes).where(notes.c.session_id == session_id)).first()
        before = kept._asdict() if kept is not None else _notes_row(session_id, "", {})
        if text is not None:
            calibration = from_json(before["calibration"]) or {}
            before = _notes_row(session_id, text, calibration)
            self._put(notes, session_id, before)
        return session_from(row | _renamed(before))

    def change_settings(self, session_id: str, settings: Mapping[str, Any], now_utc: str) -> SessionRow:
        """Put other settings in the place of a session's own."""
        row = self._sound_session(session_id)
        changes = {"settings": to_json(settings, "settings"), "changed_utc": now_utc}
        return session_from(self._update(session_id, row, changes))

    def save_ledger(self, session_id: str, account: Mapping[str, Any], now_utc: str) -> None:
        """Keep the account of a session's losses, in place of the one before."""
        self._tail(session_id)
        row = {"session_id": session_id, "time_utc": now_utc, "account": to_json(account, "ledger")}
        self._put(ledgers, session_id, row | {"crc32": row_crc(row)})

    def set_state(self, session_id: str, state: str, now_utc: str) -> SessionRow:
        """Change a session's state."""
        row = self._sound_session(session_id)
        return session_from(self._update(session_id, row, {"state": state, "changed_utc": now_utc}))

    def delete_session(self, session_id: str, now_utc: str) -> None:
        """Hide a session from now on; `delete_slice` takes its rows away, a bounded number at a time."""
        self._update(session_id, self._session(session_id), {"deleted_utc": now_utc})
        self.deleted.add(session_id)

    def delete_slice(self, session_id: str) -> bool:
        """Delete some lines of a deleted session, and the session itself once it has none; True when it is gone."""
        self.finish()
        of_session = lines.c.session_id == session_id
        first = self._connection.execute(select(func.min(lines.c.line_number)).where(of_session)).scalar()
        if first is not None:
            in_slice = lines.c.line_number < first + DELETE_SLICE_LINES
            self._connection.execute(delete(lines).where(of_session, in_slice))
            return False
        for table in (events, notes, ledgers, creations):
            self._connection.execute(delete(table).where(table.c.session_id == session_id))
        self._connection.execute(delete(sessions).where(sessions.c.session_id == session_id))
        return True

    def finish(self) -> None:
        """Write the lines of the batch, in as few statements as they fill."""
        rows, self._rows, done = self._rows, [], 0
        if rows and not self._connection.dialect.positional:
            named = [dict(zip(LINE_COLUMNS, row, strict=True)) for row in rows]
            self._connection.execute(insert(lines), named)
            return
        while done < len(rows):
            count = next(size for size in _ROWS_A_STATEMENT if size <= len(rows) - done)
            values = tuple(chain.from_iterable(rows[done : done + count]))
            self._connection.exec_driver_sql(_line_insert(self._connection.dialect, count), values)
            done += count

    def _find(self, session_id: str, line: EncodedLine) -> Stored | None:
        """The answer for a line whose key is taken, None when it is free."""
        self.finish()
        found = self._connection.execute(
            select(lines).where(
                lines.c.session_id == session_id,
                lines.c.device_id == line.device_id,
                lines.c.boot_id == line.boot_id,
                lines.c.line_index == line.line_index,
            )
        ).first()
        if found is None:
            return None
        row = found._asdict()
        same = row.pop("crc32") == row_crc(row) and _is_same(row["encoded"], line.encoded)
        return Stored(row["line_number"], "duplicate" if same else "conflict")

    def _tail(self, session_id: str) -> Tail:
        if session_id in self.deleted:
            raise SessionUnknown(f"there is no session {session_id}")
        tail = self.tails.get(session_id)
        if tail is None:
            known = self._known.get(session_id)
            if known is None:
                self._session(session_id)
                known = load_tail(self._connection, session_id)
            tail = self.tails[session_id] = known.copy()
        return tail

    def _session(self, session_id: str) -> dict[str, Any]:
        query = select(sessions).where(sessions.c.session_id == session_id, sessions.c.deleted_utc == "")
        row = self._connection.execute(query).first()
        if row is None or session_id in self.deleted:
            raise SessionUnknown(f"there is no session {session_id}")
        return row._asdict()

    def _sound_session(self, session_id: str) -> dict[str, Any]:
        row = self._session(session_id)
        if row.pop("crc32") != row_crc(row):
            raise SessionDamaged(f"session {session_id} fails its checksum and is not changed; its lines are readable")
        return row

    def _put(self, table: Table, session_id: str, row: Mapping[str, Any]) -> None:
        """Write the one row that a session has in a table."""
        changed = self._connection.execute(update(table).where(table.c.session_id == session_id).values(row))
        if changed.rowcount == 0:
            self._connection.execute(insert(table).values(row))

    def _update(self, session_id: str, row: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
        """Write the changes alone: the other values may be damaged, and the database would not take them back."""
        changes = changes | {"crc32": row_crc(row | changes)}
        self._connection.execute(update(sessions).where(sessions.c.session_id == session_id).values(changes))
        return row | changes


def _is_same(stored: bytes, encoded: bytes) -> bool:
    """True for the same line, also when an earlier version stored it in another format."""
    if stored[:3] == encoded[:3]:
        return stored == encoded
    try:
        return encode_line(decode_line(stored)) == encoded
    except LineDamaged:
        return False


SESSION_COLUMNS = (*sessions.c, notes.c.notes, notes.c.calibration, notes.c.crc32.label("notes_crc32"))
"""Everything that a session is, its row joined with its notes."""


def session_from(row: Mapping[str, Any]) -> SessionRow:
    """A row of the table, with its notes when they were read too; what cannot be read of a damaged row is empty."""
    own = {column.name: row[column.name] for column in sessions.c}
    settings, source = from_json(own["settings"]), from_json(own["source"])
    text, calibration, sound = "", {}, True
    if row.get("notes_crc32") is not None:
        told = {"session_id": own["session_id"], "notes": row["notes"], "calibration": row["calibration"]}
        text, calibration = _legible(row["notes"]), from_json(row["calibration"]) or {}
        sound = row["notes_crc32"] == row_crc(told)
    return SessionRow(
        session_id=_legible(own["session_id"]),
        name=_legible(own["name"]),
        created_utc=_legible(own["created_utc"]),
        changed_utc=_legible(own["changed_utc"]),
        state=_legible(own["state"]),
        settings=settings or {},
        origin_mm=(own["origin_x_mm"], own["origin_y_mm"], own["origin_z_mm"]),
        source=source or {},
        damaged=own["crc32"] != row_crc(own) or settings is None or source is None or not sound,
        notes=text,
        calibration=calibration,
    )


def session_made_with(connection: Connection, key: CreationKey) -> SessionRow | None:
    """The session that a request with this key made; None when there is none, or it is deleted.

    Raises
    ------
    CreationKeyReused : the key came with another request.
    """
    query = (
        select(*SESSION_COLUMNS, creations.c.request_sha256)
        .join(creations, creations.c.session_id == sessions.c.session_id)
        .outerjoin(notes, notes.c.session_id == sessions.c.session_id)
        .where(creations.c.key_sha256 == key.key_sha256)
    )
    row = connection.execute(query).mappings().first()
    if row is None or row["deleted_utc"]:
        return None
    if row["request_sha256"] != key.request_sha256:
        raise CreationKeyReused("this Idempotency-Key came before, with another request; send a new key")
    return session_from(dict(row))


@cache
def _line_insert(dialect: Dialect, count: int) -> str:
    """The statement for the driver itself that inserts so many lines, values in the order of LINE_COLUMNS.

    Every scanline goes through it. SQLAlchemy would ask a third of what SQLite itself does, and SQLite's module gives
    the interpreter away with each statement, and has to wait for it.
    """
    head, values, row = str(insert(lines).compile(dialect=dialect)).rpartition("VALUES ")
    return head + values + ", ".join([row] * count)


def _notes_row(session_id: str, text: str, calibration: Mapping[str, Any]) -> dict[str, Any]:
    row = {"session_id": session_id, "notes": text, "calibration": to_json(calibration, "calibration")}
    return row | {"crc32": row_crc(row)}


def _renamed(row: Mapping[str, Any]) -> dict[str, Any]:
    return {"notes": row["notes"], "calibration": row["calibration"], "notes_crc32": row["crc32"]}


def _legible(text: Any) -> str:
    """Text that anybody can print, also when its bytes were damaged."""
    return str(text).encode("utf-8", "replace").decode()


def batch_number(connection: Connection) -> int:
    """The number of the last batch that is in the record."""
    return int(connection.execute(select(record.c.batch_number)).scalar_one())


def set_batch_number(connection: Connection, number: int) -> None:
    """Write the number of this batch, so that a later look tells whether it is in."""
    connection.execute(update(record).values(batch_number=number))
