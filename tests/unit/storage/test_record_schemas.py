"""A record of an older schema opens; notes, ledgers and request keys are kept with a session."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import create_engine

from scanner_service.storage.errors import CreationKeyReused, NotStorable
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from scanner_service.storage.rows import CreationKey, Stored
from scanner_service.storage.tables import APPLICATION_ID, SCHEMA_VERSION
from tests.unit.storage.record_lines import bits, line_of
from tests.unit.storage.schema_1 import make_schema_1

TRUTH = [bits(line_of(index)) for index in range(3)]


def old_record(path: Path) -> str:
    engine = create_engine(f"sqlite:///{path}")
    with engine.begin() as connection:
        session = make_schema_1(connection)
        connection.exec_driver_sql(f"PRAGMA application_id={APPLICATION_ID}")
        connection.exec_driver_sql("PRAGMA user_version=1")
    engine.dispose()
    return session


def test_an_old_record_is_read_as_it_is(tmp_path: Path) -> None:
    session = old_record(tmp_path / "r")
    before = (tmp_path / "r").read_bytes()
    with closing(RecordReader.open(tmp_path / "r")) as reader:
        (row,) = reader.list_sessions()
        assert (row.session_id, row.name, row.notes, row.damaged) == (session, "old", "", False)
        assert [bits(line) for _, line in reader.lines(session)] == TRUTH
        assert reader.ledger(session) is None
        assert reader.verify(session).problems == ()
    assert (tmp_path / "r").read_bytes() == before


def test_an_old_record_is_brought_up_to_date_and_keeps_all_it_held(tmp_path: Path) -> None:
    session = old_record(tmp_path / "r")
    for _ in range(2):
        with Record.open(tmp_path / "r") as record:
            assert [bits(line) for _, line in record.lines(session)][:3] == TRUTH
            assert [event.kind for event in record.events(session)] == ["losses"]
            assert record.verify(session).problems == ()
            assert record.describe(session, notes="found again").notes == "found again"
            record.save_ledger(session, {"passes": []}).result()
            again = [record.append(session, line_of(index)).result() for index in (1, 3)]
            assert again[0] == Stored(1, "duplicate"), "whatever format it was stored in"
            assert record.append(session, line_of(1, seed=1)).result() == Stored(1, "conflict")
    assert again[1] == Stored(3, "duplicate")
    with closing(sqlite3.connect(tmp_path / "r")) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)
        assert database.execute("SELECT schema_version FROM record").fetchone() == (SCHEMA_VERSION,)


def test_notes_ledgers_and_keys_are_kept_checked_and_deleted_with_their_session(tmp_path: Path) -> None:
    key, other = CreationKey("a" * 64, "b" * 64), CreationKey("a" * 64, "c" * 64)
    with Record.open(tmp_path / "r") as record:
        session = record.create_session("s", calibration={"x": 1.5}, key=key).session_id
        assert record.create_session("s", key=key).session_id == session
        with pytest.raises(CreationKeyReused):
            record.create_session("t", key=other)
        with pytest.raises(NotStorable):
            record.describe(session, notes="a\0b")
        assert record.describe(session, name="renamed").calibration == {"x": 1.5}
        record.describe(session, notes="note")
        record.save_ledger(session, {"n": 1}).result()
        record.save_ledger(session, {"n": 2}).result()
    with Record.open(tmp_path / "r") as record:
        row = record.get_session(session)
        assert (row.name, row.notes, row.calibration, row.damaged) == ("renamed", "note", {"x": 1.5}, False)
        assert record.ledger(session) == {"n": 2}
    with closing(sqlite3.connect(tmp_path / "r")) as database:
        database.execute("UPDATE notes SET notes = 'forged'")
        database.execute("UPDATE ledgers SET account = '{\"n\":3}'")
        database.commit()
    with Record.open(tmp_path / "r") as record:
        assert record.get_session(session).damaged
        assert record.ledger(session) is None
        record.delete_session(session)
        assert record.made_with(key) is None
        assert record.create_session("another", key=other).session_id != session
        assert [row.name for row in record.list_sessions()] == ["another"]
