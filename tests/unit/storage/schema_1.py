"""A record as version 0.1's first schema had it, written out by hand: what later versions must open."""

import json
import zlib
from typing import Any

from sqlalchemy import Connection, text

from scanner_service.storage.encoding import PLAIN, encode_line
from tests.unit.storage.record_lines import line_of

SESSION = "1m82614ch5ada4"
_TABLES = """
CREATE TABLE record (id SMALLINT NOT NULL PRIMARY KEY, schema_version INTEGER NOT NULL, created_utc TEXT NOT NULL,
  batch_number BIGINT NOT NULL);
CREATE TABLE sessions (session_id TEXT NOT NULL PRIMARY KEY, name TEXT NOT NULL, created_utc TEXT NOT NULL,
  changed_utc TEXT NOT NULL, state TEXT NOT NULL, settings TEXT NOT NULL, origin_x_mm DOUBLE PRECISION NOT NULL,
  origin_y_mm DOUBLE PRECISION NOT NULL, origin_z_mm DOUBLE PRECISION NOT NULL, source TEXT NOT NULL,
  deleted_utc TEXT NOT NULL, crc32 BIGINT NOT NULL);
CREATE TABLE lines (session_id TEXT NOT NULL REFERENCES sessions (session_id), line_number BIGINT NOT NULL,
  device_id TEXT NOT NULL, boot_id BIGINT NOT NULL, line_index BIGINT NOT NULL, pass_index BIGINT NOT NULL,
  points BIGINT NOT NULL, points_before BIGINT NOT NULL, crc32 BIGINT NOT NULL, encoded {bytes} NOT NULL,
  UNIQUE (session_id, line_number), UNIQUE (session_id, device_id, boot_id, line_index));
CREATE TABLE events (session_id TEXT NOT NULL REFERENCES sessions (session_id), number BIGINT NOT NULL,
  time_utc TEXT NOT NULL, kind TEXT NOT NULL, line_number BIGINT NOT NULL, details TEXT NOT NULL, crc32 BIGINT NOT NULL,
  UNIQUE (session_id, number));
CREATE INDEX sessions_not_deleted ON sessions (deleted_utc, session_id)
"""


def make_schema_1(connection: Connection) -> str:
    """Tables of schema 1 with one session of three lines and an event; its id."""
    kind = {"sqlite": "BLOB", "postgresql": "BYTEA"}[connection.dialect.name]
    for statement in _TABLES.format(bytes=kind).split(";"):
        connection.execute(text(statement))
    utc = "2026-11-22T10:00:00.000Z"
    connection.execute(text(f"INSERT INTO record VALUES (1, 1, '{utc}', 7)"))
    origin = {"origin_x_mm": 1.0, "origin_y_mm": 0.5, "origin_z_mm": 0.0}
    told = {"name": "old", "created_utc": utc, "changed_utc": utc, "state": "stopped", "settings": '{"a":1}'}
    _insert(connection, "sessions", {"session_id": SESSION, **told, **origin, "source": "{}", "deleted_utc": ""})
    points_before = 0
    for number in range(3):
        line = line_of(number)
        key = {"device_id": line.device_id, "boot_id": line.boot_id, "line_index": number, "pass_index": 0}
        counts = {"line_number": number, "points": len(line.index), "points_before": points_before}
        row = {"session_id": SESSION, **key, **counts}
        _insert(connection, "lines", row, encode_line(line, PLAIN))
        points_before += len(line.index)
    event = {"number": 0, "time_utc": utc, "kind": "losses", "line_number": 3, "details": "{}"}
    _insert(connection, "events", {"session_id": SESSION, **event})
    return SESSION


def _insert(connection: Connection, table: str, row: dict[str, Any], encoded: bytes | None = None) -> None:
    """A row with its checksum, by the rule that docs/record.md states."""
    summed = row if encoded is None else {**row, "encoded": zlib.crc32(encoded)}
    row = {**row, "crc32": zlib.crc32(json.dumps(summed, sort_keys=True).encode())}
    row = row if encoded is None else {**row, "encoded": encoded}
    names = ", ".join(row)
    connection.execute(text(f"INSERT INTO {table} ({names}) VALUES ({', '.join(f':{name}' for name in row)})"), row)
