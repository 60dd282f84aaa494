"""Who may open a record, and what is refused without being touched."""

import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from scanner_service.storage.database import PAGE_BYTES, SqliteLibrary
from scanner_service.storage.errors import NotARecord, RecordInUse, RecordNotWritable, RecordTooNew
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from scanner_service.storage.rows import Limits
from scanner_service.storage.tables import SCHEMA_VERSION
from tests.unit.storage.record_lines import bits, line_of


def everything_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_newer_schema_is_refused_and_nothing_is_touched(tmp_path: Path) -> None:
    path = tmp_path / "r"
    Record.open(path).close()
    database = sqlite3.connect(path)
    database.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    database.close()
    before = everything_in(tmp_path)
    for opened in (Record.open, RecordReader.open):
        with pytest.raises(RecordTooNew, match="newer version"):
            opened(path)
    assert {name: data for name, data in everything_in(tmp_path).items() if name in before} == before


def test_a_foreign_database_a_text_and_an_empty_file_are_refused_and_not_touched(tmp_path: Path) -> None:
    foreign = sqlite3.connect(tmp_path / "foreign.sqlite")
    foreign.execute("CREATE TABLE sessions (id)")
    foreign.commit()
    foreign.close()
    (tmp_path / "text").write_text("not a database\n" * 1000)
    (tmp_path / "empty").touch()
    before = everything_in(tmp_path)
    for name in before:
        with pytest.raises(NotARecord, match="not a record"):
            Record.open(tmp_path / name)
    assert everything_in(tmp_path) == before


def test_a_second_service_is_refused_and_the_first_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "r"
    with Record.open(path) as first:
        session = first.create_session("first").session_id
        with pytest.raises(RecordInUse, match="in use by another service"):
            Record.open(path)
        (tmp_path / "link").symlink_to(path)
        with pytest.raises(RecordInUse):
            Record.open(tmp_path / "link")
        code = "import sys, pathlib, scanner_service.storage.record as r; r.Record.open(pathlib.Path(sys.argv[1]))"
        command = [sys.executable, "-c", code, str(path)]
        other = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
        assert other.returncode == 1 and "RecordInUse" in other.stderr
        assert first.append(session, line_of(0)).result().outcome == "stored"
    Record.open(path).close()
    assert [entry.name for entry in tmp_path.iterdir() if entry.name.endswith((".lock", "-wal", ".new"))] == []


def test_another_process_may_read_while_the_service_writes(tmp_path: Path) -> None:
    path = tmp_path / "r"
    with Record.open(path) as record:
        session = record.create_session("shared").session_id
        record.append(session, line_of(0)).result()
        reader = RecordReader.open(path)
        record.append(session, line_of(1)).result()
        assert [bits(line) for _, line in reader.lines(session)] == [bits(line_of(0)), bits(line_of(1))]
        reader.close()


@pytest.mark.parametrize("place", [".", "nowhere/record", "/sys/record", "/dev/null"])
def test_a_place_that_cannot_hold_a_record_is_named_in_one_sentence(tmp_path: Path, place: str) -> None:
    if place.startswith("/sys") and not Path("/sys").is_dir():
        pytest.skip("this system has no read-only /sys")
    with pytest.raises(RecordNotWritable) as refusal:
        Record.open(tmp_path / place)
    assert "\n" not in str(refusal.value) and Path(place).name in str(refusal.value)
    assert list(tmp_path.iterdir()) == []


def test_a_creation_that_was_interrupted_is_begun_anew(tmp_path: Path) -> None:
    (tmp_path / "r.new").write_bytes(b"half a file")
    with Record.open(tmp_path / "r") as record:
        assert record.list_sessions() == []
    assert not (tmp_path / "r.new").exists()


def test_a_service_killed_in_the_middle_of_copying_its_log_finds_its_record_again(tmp_path: Path) -> None:
    path, killed = tmp_path / "r", tmp_path / "killed"
    with Record.open(path, limits=Limits(checkpoint_bytes=1 << 40)) as record:
        session = record.create_session("copied").session_id
        truth = [bits(line_of(index)) for index in range(50)]
        for future in [record.append(session, line_of(index)) for index in range(50)]:
            future.result()
        before = path.read_bytes()
        killed.with_name("killed-wal").write_bytes((tmp_path / "r-wal").read_bytes())
    after = path.read_bytes()
    assert len(after) > len(before)
    killed.write_bytes(after[:PAGE_BYTES] + before[PAGE_BYTES:])  # the first page alone was copied
    with Record.open(killed) as record:
        assert [bits(line) for _, line in record.lines(session)] == truth
        assert record.verify(session).problems == ()


def test_the_writer_syncs_every_commit_and_nobody_maps_the_file(tmp_path: Path) -> None:
    with Record.open(tmp_path / "r") as record:
        raw = record._writer._connection.connection.dbapi_connection
        pragmas = {name: raw.execute(f"PRAGMA {name}").fetchone()[0] for name in ("journal_mode", "synchronous")}
        assert pragmas == {"journal_mode": "wal", "synchronous": 2}
        assert raw.execute("PRAGMA foreign_keys").fetchone()[0] == 1
        assert raw.execute("PRAGMA mmap_size").fetchone()[0] == 0
        with record._reader._engine.connect() as reading, pytest.raises(Exception, match="readonly"):
            reading.exec_driver_sql("DELETE FROM sessions")


@pytest.mark.parametrize(
    ("version", "has_bug"),
    [
        *(((3, 40, 1), True), ((3, 44, 6), False), ((3, 45, 0), True), ((3, 50, 6), True)),
        *(((3, 50, 7), False), ((3, 51, 2), True), ((3, 51, 3), False), ((3, 54, 0), False)),
    ],
)
def test_the_library_with_the_wal_reset_bug_is_known(version: tuple[int, int, int], has_bug: bool) -> None:
    assert SqliteLibrary(version).wal_reset_bug is has_bug
