"""The schema of the record and the checksum of each row; knows no connection and writes nothing.

Every row carries a CRC-32 over all its own values, since a database's own checks call most flipped bits sound.
"""

import json
import zlib
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from sqlalchemy import (
    BigInteger,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    SmallInteger,
    Table,
    Text,
    UniqueConstraint,
)

from scanner_service.storage.errors import NotStorable

APPLICATION_ID = 0x4C51_4C53  # "LQLS": tells a record from any other SQLite file
SCHEMA_VERSION = 3

metadata = MetaData()
_Key = Text().with_variant(Text(collation="C"), "postgresql")  # sorts byte by byte everywhere

# One row: the schema's version, and the number of the last batch. A batch writes its own number, so that after an
# error from COMMIT one look tells whether the batch is in.
record = Table(
    "record",
    metadata,
    Column("id", SmallInteger, primary_key=True, autoincrement=False),
    Column("schema_version", Integer, nullable=False),
    Column("created_utc", Text, nullable=False),
    Column("batch_number", BigInteger, nullable=False),
)

sessions = Table(
    "sessions",
    metadata,
    Column("session_id", _Key, primary_key=True),
    Column("name", Text, nullable=False),
    Column("created_utc", Text, nullable=False),
    Column("changed_utc", Text, nullable=False),
    Column("state", Text, nullable=False),
    Column("settings", Text, nullable=False),
    Column("origin_x_mm", Float(53), nullable=False),
    Column("origin_y_mm", Float(53), nullable=False),
    Column("origin_z_mm", Float(53), nullable=False),
    Column("source", Text, nullable=False),
    Column("deleted_utc", Text, nullable=False),  # empty: not deleted
    Column("crc32", BigInteger, nullable=False),
)

# `points_before` sums the points of all earlier lines of the session, so that the last row tells the session's count.
lines = Table(
    "lines",
    metadata,
    Column("session_id", _Key, ForeignKey("sessions.session_id"), nullable=False),
    Column("line_number", BigInteger, nullable=False),
    Column("device_id", Text, nullable=False),
    Column("boot_id", BigInteger, nullable=False),
    Column("line_index", BigInteger, nullable=False),
    Column("pass_index", BigInteger, nullable=False),
    Column("points", BigInteger, nullable=False),
    Column("points_before", BigInteger, nullable=False),
    Column("crc32", BigInteger, nullable=False),
    Column("encoded", LargeBinary, nullable=False),  # last: readers of the columns before it never touch its pages
    UniqueConstraint("session_id", "line_number"),
    UniqueConstraint("session_id", "device_id", "boot_id", "line_index"),
)

events = Table(
    "events",
    metadata,
    Column("session_id", _Key, ForeignKey("sessions.session_id"), nullable=False),
    Column("number", BigInteger, nullable=False),
    Column("time_utc", Text, nullable=False),
    Column("kind", Text, nullable=False),
    Column("line_number", BigInteger, nullable=False),
    Column("details", Text, nullable=False),
    Column("crc32", BigInteger, nullable=False),
    UniqueConstraint("session_id", "number"),
)

# Schema 2: what a person says of a session and what the scanner was; the account of its losses; which request made it.
notes = Table(
    "notes",
    metadata,
    Column("session_id", _Key, ForeignKey("sessions.session_id"), primary_key=True),
    Column("notes", Text, nullable=False),
    Column("calibration", Text, nullable=False),
    Column("crc32", BigInteger, nullable=False),
)

ledgers = Table(
    "ledgers",
    metadata,
    Column("session_id", _Key, ForeignKey("sessions.session_id"), primary_key=True),
    Column("time_utc", Text, nullable=False),
    Column("account", Text, nullable=False),
    Column("crc32", BigInteger, nullable=False),
)

creations = Table(
    "creations",
    metadata,
    Column("key_sha256", Text, primary_key=True),
    Column("request_sha256", Text, nullable=False),
    Column("session_id", _Key, ForeignKey("sessions.session_id"), nullable=False, index=True),
    Column("time_utc", Text, nullable=False),
    Column("crc32", BigInteger, nullable=False),
)

Index("sessions_not_deleted", sessions.c.deleted_utc, sessions.c.session_id)


def row_crc(row: Mapping[str, Any]) -> int:
    """CRC-32 over every value of a row but its own checksum; of a line's bytes their own CRC-32 goes in."""
    values = {name: value for name, value in row.items() if name not in ("crc32", "encoded")}
    if isinstance(row.get("encoded"), bytes):
        values["encoded"] = zlib.crc32(row["encoded"])
    return values_crc(values)


LINE_COLUMNS = tuple(column.name for column in lines.columns)
_quoted = lru_cache(maxsize=256)(json.dumps)


def line_row(
    session_id: str,
    line_number: int,
    device_id: str,
    boot_id: int,
    line_index: int,
    pass_index: int,
    points: int,
    points_before: int,
    encoded: bytes,
    encoded_crc32: int,
) -> tuple[Any, ...]:
    """A row of `lines` in the order of LINE_COLUMNS; its checksum is `row_crc`'s, the text put together by hand."""
    text = (
        f'{{"boot_id": {boot_id:d}, "device_id": {_quoted(device_id)}, "encoded": {encoded_crc32:d}, '
        f'"line_index": {line_index:d}, "line_number": {line_number:d}, "pass_index": {pass_index:d}, '
        f'"points": {points:d}, "points_before": {points_before:d}, "session_id": {_quoted(session_id)}}}'
    )
    crc32 = zlib.crc32(text.encode())
    key = (session_id, line_number, device_id, boot_id, line_index, pass_index)
    return (*key, points, points_before, crc32, encoded)


def values_crc(values: Mapping[str, Any]) -> int:
    """CRC-32 over names and values as ASCII JSON with sorted names; floats enter by their shortest exact text."""
    return zlib.crc32(json.dumps(dict(values), sort_keys=True, default=repr).encode())


def to_json(value: Mapping[str, Any], what: str) -> str:
    """JSON text of a mapping.

    Raises
    ------
    NotStorable : when it holds NaN, an infinity, or anything JSON does not know.
    """
    try:
        text = json.dumps(dict(value), allow_nan=False, ensure_ascii=False, sort_keys=True, separators=(",", ":"))
    except (TypeError, ValueError, RecursionError) as error:
        raise NotStorable(f"the {what} cannot be written as JSON: {error}") from error
    return plain_text(text, what)


def from_json(text: Any) -> dict[str, Any] | None:
    """The mapping that `to_json` wrote, or None when the text is no longer one."""
    try:
        value = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def plain_text(text: str, what: str) -> str:
    """`text` itself.

    Raises
    ------
    NotStorable : when it holds a NUL or half a surrogate pair, which databases refuse or cut.
    """
    if not isinstance(text, str) or "\0" in text or not (text.isascii() or _is_whole(text)):
        raise NotStorable(f"the {what} must be plain text, not {text!r}")
    return text


def _is_whole(text: str) -> bool:
    """True when no half of a surrogate pair is in the text."""
    return not any("\ud800" <= letter <= "\udfff" for letter in text)
