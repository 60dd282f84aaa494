"""A file that is brought to the service is there when it is whole and was looked at, and the disk has room for it."""

import shutil
import sqlite3
import threading

import pytest

from scanner_service.sessions import file_shelf
from scanner_service.sessions.errors import BudgetSpent, FileUnknown, NameTaken, SessionBusy, SourceUnusable
from scanner_service.sessions.file_shelf import MAX_FILE_BYTES, RESERVE_BYTES, FileShelf, ShelfFile
from scanner_service.storage.database import MOST_VALUE_BYTES
from scanner_service.storage.formats import FileEmpty, FormatUnknown
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record

TEXT = b"line,x_mm,y_mm,z_mm\n0,1,2,3\n"


@pytest.fixture
def shelf(tmp_path):
    (tmp_path / "replay").mkdir()
    return FileShelf(tmp_path / "replay", tmp_path / "arriving")


def bring(shelf, name, content, piece=7):
    with shelf.receive(name, len(content)) as arrival:
        for start in range(0, len(content), piece):
            arrival.write(content[start : start + piece])
        return arrival.keep()


def is_clean(shelf):
    return not any((shelf.folder.parent / "arriving").iterdir())


def test_a_file_is_there_when_it_is_whole_and_never_replaces_another(shelf):
    with shelf.receive("part.csv", None) as arrival:
        arrival.write(TEXT)
        assert shelf.files() == []
    assert shelf.files() == [] and is_clean(shelf)
    kept = ShelfFile("part.csv", len(TEXT), "csv profiles")
    assert bring(shelf, "part.csv", TEXT) == bring(shelf, "part.csv", TEXT) == kept
    with pytest.raises(NameTaken, match="another file"):
        bring(shelf, "part.csv", TEXT.replace(b"3", b"4"))
    assert (shelf.folder / "part.csv").read_bytes() == TEXT
    assert shelf.files() == [kept] and is_clean(shelf)
    shelf.remove("part.csv")
    assert shelf.files() == []
    with pytest.raises(FileUnknown):
        shelf.remove("../arriving")


@pytest.mark.parametrize("name", ["../x", "a/b", ".hidden", "", "x" * 121, "a\0b", "\u202egnp.csv", "a\nb"])
def test_a_name_that_is_none_is_refused_before_anything_is_written(shelf, name):
    with pytest.raises(SourceUnusable, match="letters"):
        shelf.receive(name, 3)
    assert is_clean(shelf)


@pytest.fixture
def recorded(tmp_path):
    """The bytes of a record with one session."""
    with Record.open(tmp_path / "recorded.sqlite") as record:
        record.create_session("scanned")
    return (tmp_path / "recorded.sqlite").read_bytes()


@pytest.mark.parametrize(
    "name",
    ["scan.sqlite-journal", "scan.sqlite-wal", "scan.sqlite-shm", "scan.SQLITE-WAL", "scan", "scan.lock", "x.bin"],
)
def test_nothing_comes_under_a_name_that_means_something_to_others(shelf, recorded, name):
    bring(shelf, "scan.sqlite", recorded, 4096)
    with pytest.raises(SourceUnusable, match=r"end in .*\.ply.*\.sqlite"):
        bring(shelf, name, b"1 2 3\n4 5 6\n" * 20_000, 4096)
    reader = RecordReader.open(shelf.folder / "scan.sqlite")
    assert [session.name for session in reader.list_sessions()] == ["scanned"]
    reader.close()


def test_names_are_told_by_their_ending_in_either_case(shelf):
    for name in ("a.ply.TXT", "b.Xyz", "c.csv"):
        assert bring(shelf, name, TEXT).name == name


def test_nothing_that_belongs_to_a_removed_record_is_left_for_the_next_of_its_name(shelf, recorded):
    bring(shelf, "scan.sqlite", recorded, 4096)
    (shelf.folder / "scan.sqlite-journal").write_bytes(b"left by a crash")
    assert [file.name for file in shelf.files()] == ["scan.sqlite"]
    shelf.remove("scan.sqlite")
    assert list(shelf.folder.iterdir()) == []


def test_a_file_that_goes_while_the_folder_is_listed_is_not_shown(shelf, monkeypatch):
    for name in ("a.csv", "b.csv"):
        bring(shelf, name, TEXT)
    true_stat = type(shelf.folder).stat
    looks = []

    def removed_after_the_first_look(path, **options):
        seen = true_stat(path, **options)
        if path.name == "a.csv":
            looks.append(path)
            path.unlink(missing_ok=True)
        return seen

    monkeypatch.setattr(type(shelf.folder), "stat", removed_after_the_first_look)
    shelf.files()
    assert looks
    assert [file.name for file in shelf.files()] == ["b.csv"]


@pytest.mark.parametrize(
    "computed",
    [
        "TEXT AS(hex(zeroblob(100000000)))",
        "TEXT AS/**/(hex(zeroblob(100000000))) STORED",
        "TEXT GENERATED ALWAYS AS (hex(zeroblob(100000000)))",
        "TEXT as\n(hex(zeroblob(100000000)))",
    ],
)
def test_a_record_that_computes_is_refused_however_it_is_written(shelf, recorded, tmp_path, computed):
    evil = tmp_path / "evil.sqlite"
    evil.write_bytes(recorded)
    database = sqlite3.connect(evil)
    database.execute("PRAGMA writable_schema=1")
    changed = "UPDATE sqlite_master SET sql = replace(sql, 'name TEXT NOT NULL', ?) WHERE name = 'sessions'"
    assert database.execute(changed, (f"name {computed}",)).rowcount == 1
    database.commit()
    database.close()
    with pytest.raises(SourceUnusable, match=r"evil\.sqlite has views, triggers or computed columns"):
        bring(shelf, "evil.sqlite", evil.read_bytes(), 4096)
    assert shelf.files() == [] and is_clean(shelf)


def test_a_record_with_a_value_larger_than_any_is_refused(shelf, recorded, tmp_path):
    large = tmp_path / "large.sqlite"
    large.write_bytes(recorded)
    database = sqlite3.connect(large)
    database.execute("UPDATE sessions SET name = zeroblob(?)", (MOST_VALUE_BYTES + 1,))
    database.commit()
    database.close()
    with large.open("rb") as file, shelf.receive("large.sqlite", None) as arrival:
        shutil.copyfileobj(file, arrival)
        with pytest.raises(SourceUnusable, match="too big"):
            arrival.keep()
    assert shelf.files() == [] and is_clean(shelf)


def test_two_arrive_at_once_however_many_knock_together(shelf, monkeypatch):
    together = threading.Barrier(8)
    true_room = shelf.check_room
    monkeypatch.setattr(shelf, "check_room", lambda more: (threading.Event().wait(0.05), true_room(more)))
    arrivals, refused = [], []

    def knock(number):
        together.wait()
        try:
            arrivals.append(shelf.receive(f"{number}.csv", len(TEXT)))
        except SessionBusy as error:
            refused.append(error)

    knocking = [threading.Thread(target=knock, args=(number,)) for number in range(8)]
    for one in knocking:
        one.start()
    for one in knocking:
        one.join()
    assert (len(arrivals), len(refused)) == (2, 6)
    for arrival in arrivals:
        with arrival:
            pass
    assert is_clean(shelf)


def test_what_lies_beside_a_record_that_is_looked_at_counts_as_no_arrival(shelf):
    with shelf.receive("a.sqlite", None):
        (here,) = (shelf.folder.parent / "arriving").iterdir()
        for beside in ("-wal", "-shm"):
            here.with_name(here.name + beside).touch()
        with shelf.receive("b.csv", None), pytest.raises(SessionBusy):
            shelf.receive("c.csv", None)


def test_what_is_nothing_that_is_read_here_is_not_kept(shelf, tmp_path):
    for content, refusal in ((bytes(300), FormatUnknown), (b"", FileEmpty), (b"MZ\0\0" * 9, FormatUnknown)):
        with pytest.raises(refusal):
            bring(shelf, "odd.xyz", content)
    with pytest.raises(SourceUnusable, match=r"odd\.sqlite cannot be opened as a record"):
        bring(shelf, "odd.sqlite", b"SQLite format 3\0" + bytes(500))
    with Record.open(tmp_path / "empty.sqlite"):
        pass
    with pytest.raises(SourceUnusable, match="holds no session"):
        bring(shelf, "empty.sqlite", (tmp_path / "empty.sqlite").read_bytes(), 4096)
    assert shelf.files() == [] and is_clean(shelf)


def test_size_number_and_room_on_the_disk_are_bounded(shelf, monkeypatch):
    with pytest.raises(SourceUnusable, match="too large"):
        shelf.receive("huge.ply", MAX_FILE_BYTES + 1)
    with shelf.receive("a.ply", None), shelf.receive("b.ply", None), pytest.raises(SessionBusy):
        shelf.receive("c.ply", None)
    monkeypatch.setattr(file_shelf, "MAX_FILE_BYTES", 20)  # it says less than comes
    with pytest.raises(SourceUnusable, match="too large"):
        bring(shelf, "long.csv", TEXT)
    monkeypatch.undo()
    full = FileShelf(shelf.folder, shelf.folder.parent / "arriving", lambda place: RESERVE_BYTES + 10)
    with pytest.raises(BudgetSpent):
        full.receive("part.csv", 11)
    assert is_clean(full)
