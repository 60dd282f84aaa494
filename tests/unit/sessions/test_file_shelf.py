"""A file that is brought to the service is there when it is whole and was looked at, and the disk has room for it."""

import pytest

from scanner_service.sessions import file_shelf
from scanner_service.sessions.errors import BudgetSpent, SessionBusy, SourceUnusable
from scanner_service.sessions.file_shelf import MAX_FILE_BYTES, RESERVE_BYTES, FileShelf, ShelfFile
from scanner_service.storage.formats import FileEmpty, FormatUnknown
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
    with pytest.raises(SourceUnusable, match="another file"):
        bring(shelf, "part.csv", TEXT.replace(b"3", b"4"))
    assert (shelf.folder / "part.csv").read_bytes() == TEXT
    assert shelf.files() == [kept] and is_clean(shelf)
    shelf.remove("part.csv")
    assert shelf.files() == []
    with pytest.raises(SourceUnusable):
        shelf.remove("../arriving")


@pytest.mark.parametrize("name", ["../x", "a/b", ".hidden", "", "x" * 121, "a\0b", "\u202egnp.csv", "a\nb"])
def test_a_name_that_is_none_is_refused_before_anything_is_written(shelf, name):
    with pytest.raises(SourceUnusable, match="letters"):
        shelf.receive(name, 3)
    assert is_clean(shelf)


def test_what_is_nothing_that_is_read_here_is_not_kept(shelf, tmp_path):
    for content, refusal in ((bytes(300), FormatUnknown), (b"", FileEmpty), (b"MZ\0\0" * 9, FormatUnknown)):
        with pytest.raises(refusal):
            bring(shelf, "odd.bin", content)
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
