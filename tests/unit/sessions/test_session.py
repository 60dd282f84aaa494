"""A session's ends: by its user, by its source, by a fault; and what is let go of then."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from scanner_service.rescan.requirement import Requirement, RequirementUnusable
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.errors import KernelsCompiling, SessionBusy, SourceUnusable
from scanner_service.sessions.ledger import Ledger
from scanner_service.sessions.readiness import Preparing, preparing, refuse_until_ready, warm_up
from scanner_service.sessions.replay_source import ReplaySource
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import DeviceSpec, PushSpec, RecordSpec
from scanner_service.sessions.wires import Wires
from scanner_service.sessions.withdrawals import SCAN_ENDED
from scanner_service.storage.errors import CreationKeyReused, SessionUnknown
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


class Disk:
    """A disk that does not answer from `fails` on, until somebody waits for the ledger, and lets it `go_on`."""

    def __init__(self, monkeypatch, record):
        self.is_waited_for = threading.Event()
        self.go_on = threading.Event()
        self._record = record
        waiting = Ledger.wait_until_decided

        def told(ledger, timeout_s):
            self.is_waited_for.set()
            self.go_on.wait()
            return waiting(ledger, timeout_s)

        monkeypatch.setattr(Ledger, "wait_until_decided", told)

    def fails(self):
        begun = threading.Event()
        self._record._writer.submit(lambda batch: (begun.set(), self.go_on.wait()), 0, 0.0)
        begun.wait()


@pytest.fixture
def disk(book, monkeypatch):
    disk = Disk(monkeypatch, book.record)
    yield disk
    disk.go_on.set()


@pytest.fixture
def aside():
    """Runs what might never return."""
    with ThreadPoolExecutor(4) as pool:
        yield pool.submit


def test_a_scan_is_over_when_its_last_line_is_durable(book, disk, aside):
    def lines():
        disk.fails()
        yield from LINES

    session = book.create("test", PushSpec(), SETTINGS, source=ReplaySource(lines(), len(LINES)))
    session.start()
    aside(lambda: disk.is_waited_for.wait(60) and disk.go_on.set())  # the disk goes on when it is waited for, only then
    over = session.wait_until_over(300)
    disk.go_on.set()
    assert over
    assert session.wait_until_over(30)
    (ended,) = (event.details["lines"] for event in session.past_events() if event.kind == SCAN_ENDED)
    assert (ended["pending"], ended["stored"]) == (0, 12)


def test_while_the_last_lines_wait_for_the_disk_nobody_else_does(book, disk, aside):
    session = book.create("test", PushSpec(), SETTINGS)
    session.start()
    disk.fails()
    replies = [session.push(line) for line in LINES]
    stopping = aside(session.stop)
    assert disk.is_waited_for.wait(60)
    for verb in (session.start, session.pause, session.resume, lambda: session.push(LINES[0])):
        with pytest.raises(SessionBusy, match="being stopped"):
            aside(verb).result(60)
    status = aside(session.status).result(60)
    assert (status.state, status.losses["lines"]["pending"]) == ("scanning", 12)
    again = aside(session.stop)  # whoever wants the same waits until it is done
    disk.go_on.set()
    stopping.result(60)
    again.result(60)
    assert session.state == book.record.get_session(session.row.session_id).state == "stopped"
    assert {reply.result(60).outcome for reply in replies} == {"stored"}


def test_a_verdict_that_is_waited_for_is_told_until_it_is_there(book, disk, aside):
    session = book.create("test", PushSpec(), SETTINGS)
    session.start()
    assert session.status().judging is None
    session.push(LINES[0]).result(60)
    stopping = aside(session.stop)
    assert disk.is_waited_for.wait(60)
    told = session.status().judging
    assert (told.why, told.step, told.share) == ("scan_ended", "storing the last scanlines", 0.0)
    disk.go_on.set()
    stopping.result(60)
    assert session.status().judging is None

    steps, found = [], session._judgement._found_again

    def watched(*of):
        steps.append(session.status().judging)
        answer = found(*of)
        steps.append(session.status().judging)
        return answer

    session._judgement._found_again = watched
    session.terms.judge_by(Requirement(density_per_mm2=90.0))
    assert [(told.why, told.step) for told in steps] == [
        ("asked_anew", "reading the map"),
        ("asked_anew", "measuring coverage"),
    ]
    assert steps[0].share < steps[1].share < 1.0
    assert session.status().judging is None


def crossing(monkeypatch, record, verb):
    """The first call of a record's verb is kept between its answer and its caller; `done` lets it go."""
    reached, done, call = threading.Event(), threading.Event(), getattr(record, verb)

    def kept(*of, **more):
        answer = call(*of, **more)
        if not reached.is_set():
            reached.set()
            assert done.wait(60)
        return answer

    monkeypatch.setattr(record, verb, kept)
    return reached, done


@pytest.mark.parametrize("late", ["change_settings", "get_session"])
def test_a_new_name_and_another_requirement_cross_and_both_stay(book, monkeypatch, aside, late):
    session = book.create("old", PushSpec(), SETTINGS)
    asked = Requirement(density_per_mm2=90.0)
    changes = {
        "change_settings": lambda: session.terms.judge_by(asked),
        "get_session": lambda: book.describe(session.row.session_id, name="new", notes="seen"),
    }
    reached, done = crossing(monkeypatch, book.record, late)
    first = aside(changes.pop(late))
    assert reached.wait(60)
    aside(*changes.values()).result(60)
    done.set()
    first.result(60)
    assert (session.row.name, session.row.notes, session.settings.target) == ("new", "seen", asked)
    assert session.row.settings["target"] == book.record.get_session(session.row.session_id).settings["target"]


def test_of_two_names_that_cross_the_one_in_the_record_is_told(book, monkeypatch, aside):
    session = book.create("old", PushSpec(), SETTINGS)
    reached, done = crossing(monkeypatch, book.record, "get_session")
    first = aside(lambda: book.describe(session.row.session_id, name="first"))
    assert reached.wait(60)
    aside(lambda: book.describe(session.row.session_id, name="second")).result(60)
    done.set()
    first.result(60)
    assert session.row.name == book.record.get_session(session.row.session_id).name == "second"


@pytest.fixture
def stored(book):
    """The id of a session that nobody holds open."""
    row = book.record.create_session("stored", settings=SETTINGS.to_dict(), source=PushSpec().to_dict())
    return row.session_id


def test_while_a_session_is_made_another_is_opened_and_its_place_is_kept(book, stored, monkeypatch, aside):
    reached, done = crossing(monkeypatch, book.record, "create_session")
    making = aside(book.create, "made", PushSpec(), SETTINGS)
    assert reached.wait(60)
    assert aside(book.get, stored).result(60).row.name == "stored"
    with monkeypatch.context() as full:
        full.setattr("scanner_service.sessions.book.MAX_LIVE", 2)
        with pytest.raises(SessionBusy, match="scanning or waiting"):
            aside(book.create, "too many", PushSpec(), SETTINGS).result(60)
    done.set()
    made = making.result(60)
    assert book.get(made.row.session_id) is made


def test_a_session_is_refused_before_anything_is_opened_while_it_is_too_early(tmp_path, stored, book):
    def too_early():
        raise KernelsCompiling("in a moment")

    early = SessionBook(book.record, check_ready=too_early)
    with pytest.raises(KernelsCompiling, match="in a moment"):
        early.create("early", DeviceSpec("/dev/pts/none", 9600, 0.2, 0.0, 1.0, 50.0), SETTINGS)  # which is not there
    with pytest.raises(KernelsCompiling):
        early.get(stored)
    with pytest.raises(SessionUnknown):
        early.get("nobody")
    assert [row.name for row in early.rows()] == ["stored"]
    early.close()
    warm_up()
    assert preparing() is None
    assert [str(Preparing("the map", 2, 4, 3.2, compiles)).split()[0] for compiles in (False, True)] == [
        "loading",
        "compiling",
    ]
    refuse_until_ready()  # nobody is refused once all is compiled


def test_while_a_session_is_closed_to_make_room_nobody_waits_but_who_wants_that_one(book, monkeypatch, aside):
    old, kept = (book.create(name, PushSpec(), SETTINGS) for name in ("old", "kept"))
    old.start()
    old.stop()
    monkeypatch.setattr("scanner_service.sessions.book.MAX_LIVE", 2)
    reached, done = crossing(monkeypatch, old, "close")
    making = aside(book.create, "new", PushSpec(), SETTINGS)
    assert reached.wait(60)
    assert aside(book.get, kept.row.session_id).result(60) is kept
    assert aside(book.pass_desk, kept).result(60) is book.pass_desk(kept)
    asking = aside(book.get, old.row.session_id)
    assert not asking.done()
    done.set()
    assert making.result(60).row.name == "new"
    with pytest.raises(SessionBusy, match="scanning or waiting"):  # its place is taken
        asking.result(60)


def test_while_a_session_is_deleted_another_is_opened_and_it_is_gone_for_all(book, stored, monkeypatch, aside):
    session_id = book.create("gone", PushSpec(), SETTINGS).row.session_id
    reached, done = crossing(monkeypatch, book.record, "delete_session")
    deleting = aside(book.delete, session_id)
    assert reached.wait(60)
    assert aside(book.get, stored).result(60).row.name == "stored"
    for ask in (book.get, book.delete):
        with pytest.raises(SessionUnknown):
            aside(ask, session_id).result(60)
    done.set()
    deleting.result(60)
    with pytest.raises(SessionUnknown):
        book.get(session_id)


def test_a_session_that_is_made_while_all_are_closed_is_closed_too(book, monkeypatch, aside):
    stopped = threading.Event()
    source = ReplaySource(LINES, len(LINES), let_go=stopped.set)
    reached, done = crossing(monkeypatch, book.record, "create_session")
    making = aside(lambda: book.create("late", PushSpec(), SETTINGS, source=source))
    assert reached.wait(60)
    book.close()
    done.set()
    with pytest.raises(SessionBusy, match="being closed"):
        making.result(60)
    assert stopped.is_set()
    assert book.open_sessions() == []


def test_a_session_that_is_renamed_while_it_is_reopened_has_the_new_name(tmp_path, monkeypatch):
    with Record.open(tmp_path / "record.sqlite") as record:
        session_id = record.create_session("old", settings=SETTINGS.to_dict(), source=PushSpec().to_dict()).session_id
        book, lines = SessionBook(record), record.lines

        def lines_of_the_renamed(*of, **more):
            book.describe(session_id, name="new")
            return lines(*of, **more)

        monkeypatch.setattr(record, "lines", lines_of_the_renamed)
        assert book.get(session_id).row.name == "new"
        book.close()


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


def test_a_pass_that_is_just_being_set_off_is_stopped_as_well(book, monkeypatch, aside):
    session = replay(book, LINES)
    known, follow, stopped, stopping = session.source, Wires.followed_by, threading.Event(), []
    monkeypatch.setattr(known, "stop", stopped.set)

    def stopped_meanwhile(wires, source):
        stopping.append(aside(session.stop))
        assert stopped.wait(60)  # the source before; the further one is not there yet
        return follow(wires, source)

    monkeypatch.setattr(Wires, "followed_by", stopped_meanwhile)
    is_over = threading.Event()

    def lines():
        while not is_over.is_set():
            yield LINES[0]

    further = ReplaySource(lines(), 1)
    session.carry_out(lambda: further)
    stopping[0].result(60)
    assert session.state == "stopped"
    plays_on = further._thread.is_alive()
    is_over.set()
    assert not plays_on


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
        session.terms.judge_by(asked)
        (region,) = session.results().regions
        with pytest.raises(RequirementUnusable, match="own noise"):
            session.terms.judge_by(Requirement(noise_mm=1e-6))
        assert session.settings.target == asked
        book.close()
    with Record.open(tmp_path / "record.sqlite") as record:
        book = SessionBook(record)
        again = book.get(session.row.session_id)
        assert again.settings.target == asked
        (found,) = again.fresh_results().regions
        assert (found.region_id, found.history) == (region.region_id, region.history)
        book.close()
