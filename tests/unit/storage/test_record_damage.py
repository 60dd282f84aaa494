"""Rot is seen: a flipped bit is reported, never handed out as a measurement, and the rest stays readable."""

import random
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from scanner_service.storage.errors import LineDamaged, SessionDamaged
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from scanner_service.storage.rows import DamagedLine
from tests.unit.storage.record_lines import bits, line_of

LINES = 60
TRUTH = [bits(line_of(index)) for index in range(LINES)]


@pytest.fixture
def stored(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A closed record with one session, and the session's id."""
    with Record.open(tmp_path / "r") as record:
        session = record.create_session("rot", settings={"a": 1}).session_id
        for index in range(LINES):
            record.append(session, line_of(index))
        for index in range(10):
            record.append_event(session, "kind", {"i": index})
    yield tmp_path / "r", session


def flip(data: bytes, rng: random.Random) -> bytes:
    flipped = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        flipped[rng.randrange(len(flipped))] ^= 1 << rng.randrange(8)
    return bytes(flipped)


def test_flipped_bits_of_a_stored_line_are_reported_and_the_rest_is_read(stored: tuple[Path, str]) -> None:
    path, session = stored
    rng = random.Random(9)
    victims = sorted(rng.sample(range(LINES), 20))
    with closing(sqlite3.connect(path)) as database:
        for number in victims:
            (data,) = database.execute("SELECT encoded FROM lines WHERE line_number = ?", (number,)).fetchone()
            bad = data
            while bad == data:
                bad = flip(data, rng)
            database.execute("UPDATE lines SET encoded = ? WHERE line_number = ?", (bad, number))
        database.commit()
    with Record.open(path) as record:
        damaged: list[DamagedLine] = []
        read = {number: bits(line) for number, line in record.lines(session, on_damage=damaged.append)}
        assert [bad.line_number for bad in damaged] == victims
        assert read == {number: TRUTH[number] for number in range(LINES) if number not in victims}
        with pytest.raises(LineDamaged, match=f"line {victims[0]} of session"):
            list(record.lines(session))
        assert [bad.line_number for bad in record.verify(session).damaged] == victims
        again = record.append(session, line_of(victims[0])).result()
        assert (again.line_number, again.outcome) == (victims[0], "conflict")
        assert record.append(session, line_of(LINES)).result().line_number == LINES


@pytest.mark.parametrize(
    "column", ["line_number", "device_id", "boot_id", "line_index", "pass_index", "points", "crc32"]
)
def test_any_changed_column_of_a_line_is_seen(stored: tuple[Path, str], column: str) -> None:
    path, session = stored
    value = "'s1x'" if column == "device_id" else f"{column} + 1000"
    with closing(sqlite3.connect(path)) as database:
        database.execute(f"UPDATE lines SET {column} = {value} WHERE line_number = 7")
        database.commit()
    with closing(RecordReader.open(path)) as reader:
        found = reader.verify(session)
        assert found.sound.lines == LINES - 1
        assert {bad.line_number for bad in found.damaged} >= {7}


def test_a_line_that_was_taken_away_is_missed(stored: tuple[Path, str]) -> None:
    path, session = stored
    with closing(sqlite3.connect(path)) as database:
        database.execute("DELETE FROM lines WHERE line_number = 7")
        database.commit()
    with closing(RecordReader.open(path)) as reader:
        assert reader.verify(session).damaged == (DamagedLine(session, 7, "the line is gone"),)


def test_damaged_sessions_and_events_are_marked_and_do_not_stop_a_list(stored: tuple[Path, str]) -> None:
    path, session = stored
    with closing(sqlite3.connect(path)) as database:
        database.execute("UPDATE sessions SET settings = CAST(x'ff7b22' AS TEXT), name = CAST(x'fe' AS TEXT)")
        database.execute("UPDATE events SET details = '{\"i\": 99}' WHERE number = 3")
        database.execute("DELETE FROM events WHERE number = 6")
        database.commit()
    with Record.open(path) as record:
        (row,) = record.list_sessions()
        assert row.damaged and row.settings == {} and row.name.encode()
        assert [event.number for event in record.events(session) if event.damaged] == [3, 6]
        assert len(list(record.events(session))) == 10
        with pytest.raises(SessionDamaged):
            record.set_state(session, "closed")
        assert len(record.verify(session).problems) >= 3
        record.delete_session(session)
