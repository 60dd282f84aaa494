"""What a session writes of itself stands in the record in the order in which it happened, or its loss is told."""

import threading

import pytest

from scanner_service.sessions import chronicle as chronicle_module
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.chronicle import EVENTS_LOST, Chronicle
from scanner_service.sessions.ledger import Ledger
from scanner_service.sessions.source_specs import PushSpec
from scanner_service.storage.record import Record
from scanner_service.storage.rows import Limits
from scanner_service.storage.writer import Writer


@pytest.fixture
def record(tmp_path):
    with Record.open(tmp_path / "record.sqlite", limits=Limits(spool_bytes=4096)) as record:
        yield record


class Blockade:
    """While it stands, the record's writer does nothing and its spool is full."""

    def __init__(self, record):
        self._record = record
        self._go = threading.Event()

    def __enter__(self):
        begun = threading.Event()
        writer = next(value for value in vars(self._record).values() if isinstance(value, Writer))

        def wait(batch):
            begun.set()
            self._go.wait()

        self._held = writer.submit(wait, 4096, 0.0)
        assert begun.wait(30)
        return self

    def __exit__(self, *_):
        self._go.set()
        self._held.result(30)


def events_of(record, session_id):
    return [(event.kind, dict(event.details)) for event in record.events(session_id)]


def settled(record, session_id):
    record.append_event(session_id, "end", {}, timeout_s=30.0).result(30)
    return events_of(record, session_id)[:-1]


def test_events_stand_in_their_order_when_the_first_had_to_wait(record):
    session_id = record.create_session("ordered").session_id
    pen = Chronicle(record, session_id)
    with Blockade(record):
        pen.event("pass_accepted", {"order": 1})
        pen.event("pass_moved", {"order": 1})
    pen.event("pass_started", {"order": 1})
    assert [kind for kind, _ in settled(record, session_id)] == ["pass_accepted", "pass_moved", "pass_started"]


def test_what_is_owed_is_written_in_its_order_when_the_disk_is_watched(record):
    session_id = record.create_session("watched").session_id
    pen = Chronicle(record, session_id)
    with Blockade(record):
        for number in range(5):
            pen.event("step", {"number": number})
        pen.watch_the_disk(Ledger(), 0.0)  # the record takes none: none changes its place
    pen.watch_the_disk(Ledger(), 1.0)
    pen.close()
    assert settled(record, session_id) == [("step", {"number": number}) for number in range(5)]


def test_events_that_are_too_many_to_wait_are_counted_where_they_stood(record, monkeypatch):
    monkeypatch.setattr(chronicle_module, "_MOST_OWED", 3)
    session_id = record.create_session("many").session_id
    pen = Chronicle(record, session_id)
    with Blockade(record):
        for number in range(7):
            pen.event("step", {"number": number})
    pen.close()
    assert settled(record, session_id) == [
        (EVENTS_LOST, {"record_busy": 4}),
        *(("step", {"number": number}) for number in (4, 5, 6)),
    ]


def test_an_event_that_can_never_be_stored_is_counted_and_keeps_none_behind_it(record):
    session_id = record.create_session("odd").session_id
    pen = Chronicle(record, session_id)
    pen.event("odd", {"share": float("nan")})
    pen.event("next", {})
    assert settled(record, session_id) == [(EVENTS_LOST, {"not_storable": 1}), ("next", {})]


def test_a_session_that_closes_writes_what_it_owes(record):
    book = SessionBook(record)
    session = book.create("closed", PushSpec())
    session.start()
    session.stop()
    session_id = session.row.session_id
    with Blockade(record):
        session._chronicle.event("last", {})
        session._closing.set()  # the analyst looks at the disk no more
        session._analyst.join()
    book.close()
    assert settled(record, session_id)[-1] == ("last", {})
