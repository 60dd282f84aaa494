"""A session's ends: by its user, by its source, by a fault; and what is let go of then."""

import os
import threading
from pathlib import Path

import pytest

from scanner_service.rescan.requirement import Requirement, RequirementUnusable
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.errors import SessionBusy, SourceUnusable
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import DeviceSpec, PushSpec, RecordSpec
from scanner_service.sessions.sources import ReplaySource
from scanner_service.sessions.withdrawals import SCAN_ENDED
from scanner_service.storage.errors import CreationKeyReused
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from scanner_service.storage.rows import CreationKey
from tests.unit.analysis.scans import scanline, surface_scan

SETTINGS = SessionSettings(max_points=20_000)
LINES = surface_scan(lambda x, y: 0.0 * x, lines=12)


@pytest.fixture
def book(tmp_path):
    with Record.open(tmp_path / "record.sqlite") as record:
        book = SessionBook(record)
        yield book
        book.close()


def replay(book, lines):
    session = book.create("test", PushSpec(), SETTINGS, source=ReplaySource(lines, len(LINES)))
    session.start()
    assert session.wait_until_over(30)
    return session


def test_a_replay_is_judged_before_it_is_over(book):
    session = replay(book, LINES)
    assert session.state == "stopped"
    assert session.results().snapshot.settled.all()
    assert session.results().snapshot.lines.line_index.tolist() == list(range(12))


def test_a_scan_is_over_when_its_last_line_is_durable(book):
    goes_on = threading.Event()

    def lines():
        book.record._writer.submit(lambda batch: goes_on.wait(20), 0, 0.0)  # a commit that takes its time
        yield from LINES
        threading.Timer(1.0, goes_on.set).start()

    session = replay(book, lines())
    (ended,) = (event.details["lines"] for event in session.past_events() if event.kind == SCAN_ENDED)
    assert (ended["pending"], ended["stored"]) == (0, 12)


def test_a_source_that_breaks_down_fails_its_session_with_what_was_scanned(book):
    def lines():
        yield from LINES[:5]
        raise ZeroDivisionError("a fault of the program")

    session = replay(book, lines())
    assert session.state == "failed"
    assert "internal fault" in session.status().message
    assert len(session.results().snapshot.lines) == 5


def test_an_engine_that_breaks_down_fails_its_session_and_closes_like_any_other(book):
    def fault(line):
        raise ZeroDivisionError("a fault of the program")

    session = book.create("test", PushSpec(), SETTINGS)
    session.engine.live_map.add = fault
    other = book.create("other", PushSpec(), SETTINGS)
    session.start()
    session.push(scanline([[0, 0, 0]])).result(10)
    session.stop()
    assert (session.state, book.record.get_session(session.row.session_id).state) == ("failed", "failed")
    assert "internal fault" in session.status().message
    book.delete(session.row.session_id)
    assert book.open_sessions() == [other]


def test_a_source_is_stopped_when_the_engine_has_broken_down(book):
    def endless():
        while True:
            yield LINES[0]

    session = book.create("test", PushSpec(), SETTINGS, source=ReplaySource(endless(), 1))
    session.engine.live_map.can_take = None
    session.start()
    assert session.wait_until_over(30)
    assert session.state == "failed"


def test_a_line_pushed_after_the_stop_is_refused(book):
    session = book.create("test", PushSpec(), SETTINGS)
    with pytest.raises(SessionBusy, match="start it"):
        session.push(scanline([[0, 0, 0]]))
    session.start()
    session.push(scanline([[0, 0, 0]])).result(10)
    session.stop()
    with pytest.raises(SessionBusy, match="stopped"):
        session.push(scanline([[0, 0, 0]], 1))


def test_an_open_session_is_found_while_another_is_being_reopened(book):
    session = book.create("test", PushSpec(), SETTINGS)
    found = []
    with book._lock:
        asking = threading.Thread(target=lambda: found.append(book.get(session.row.session_id)))
        asking.start()
        asking.join(10)
    assert found == [session]


@pytest.mark.parametrize("port", ["\0", "/dev/tty\0USB", "/etc/passwd", "/dev/../etc/passwd"])
def test_a_port_that_cannot_be_one_is_refused(port):
    with pytest.raises(SourceUnusable):
        DeviceSpec(port, 9600, 0.2, 0.0, 1.0, 50.0).open()


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_a_record_is_replayed_at_a_pace_or_not_at_all(book, speed, tmp_path):
    session = replay(book, LINES)
    reader = RecordReader.open(tmp_path / "record.sqlite")
    with pytest.raises(SourceUnusable, match="greater than 0"):
        RecordSpec.find(reader, session.row.session_id, speed).open()
    reader.close()


def times_open(path):
    """How often this process holds a file open."""
    held = Path("/proc/self/fd")
    return sum(os.path.realpath(one) == str(path) for one in held.iterdir())


@pytest.fixture
def other(tmp_path):
    """The file of another service's record, with one session."""
    with Record.open(tmp_path / "other.sqlite") as record:
        record.create_session("other", settings=SETTINGS.to_dict(), source=PushSpec().to_dict())
    return tmp_path / "other.sqlite"


def test_a_record_is_let_go_of_when_no_session_is_made_of_it(book, other, monkeypatch):
    with monkeypatch.context() as full:
        full.setattr("scanner_service.sessions.book.MAX_LIVE", 0)
        for _ in range(3):
            with pytest.raises(SessionBusy):
                book.create("refused", RecordSpec.of_file(other, None, None))
    with pytest.raises(SourceUnusable, match="greater than 0"):
        RecordSpec.of_file(other, None, -1.0).open()
    key = CreationKey("a" * 64, "b" * 64)
    made = book.create("made", RecordSpec.of_file(other, None, None), key=key)
    made.start()
    assert made.wait_until_over(30)
    assert book.create("made", RecordSpec.of_file(other, None, None), key=key) is made
    with pytest.raises(CreationKeyReused):
        book.create("made", RecordSpec.of_file(other, None, None), key=CreationKey("a" * 64, "c" * 64))
    assert times_open(other) == 0


def test_what_is_asked_for_later_outlasts_the_service_with_its_regions(tmp_path):
    asked = Requirement(density_per_mm2=90.0)
    with Record.open(tmp_path / "record.sqlite") as record:
        book = SessionBook(record)
        session = replay(book, LINES)
        assert session.results().regions == ()
        session.judge_by(asked)
        (region,) = session.results().regions
        with pytest.raises(RequirementUnusable, match="own noise"):
            session.judge_by(Requirement(noise_mm=1e-6))
        assert session.settings.target == asked
        book.close()
    with Record.open(tmp_path / "record.sqlite") as record:
        book = SessionBook(record)
        again = book.get(session.row.session_id)
        assert again.settings.target == asked
        (found,) = again.fresh_results().regions
        assert (found.region_id, found.history) == (region.region_id, region.history)
        book.close()
