"""The engine's inbox: whoever hands something over gets an answer, also from an engine that ends meanwhile."""

import threading
from concurrent.futures import Future, wait

import numpy as np
import pytest

from scanner_service.analysis.map_settings import MapSettings
from scanner_service.sessions.engine import INBOX_LINES, Engine
from scanner_service.sessions.errors import SessionNotLive
from scanner_service.storage.record import Record
from tests.unit.analysis.scans import surface_scan

LINES = surface_scan(lambda x, y: 0.0 * x, lines=4)


@pytest.fixture
def engine(tmp_path):
    with Record.open(tmp_path / "record.sqlite") as record:
        row = record.create_session("test")
        engine = Engine(row.session_id, record, MapSettings(max_points=1000), np.zeros(3))
        yield engine
        engine.close()


def balances(ledger):
    decided = ledger.stored + ledger.duplicates + ledger.conflicts + sum(ledger.refused.values())
    return ledger.received == ledger.pending + decided


def break_down(engine):
    """Let the next line be one too many for the map, in a way that nobody foresaw."""

    def fault(line):
        raise ZeroDivisionError("a fault of the program")

    engine.live_map.add = fault


def test_after_a_fault_lines_and_questions_are_refused_and_counted(engine):
    break_down(engine)
    engine.start()
    engine.put(LINES[0])
    with pytest.raises(SessionNotLive, match="internal fault"):
        engine.ask(lambda engine: engine.live_map.version).result(10)
    with pytest.raises(SessionNotLive, match="internal fault"):
        engine.put(LINES[1])
    assert engine.ledger.received == 2
    assert engine.ledger.refused["too_late"] == 1
    assert balances(engine.ledger)


def test_everybody_is_answered_when_the_engine_closes_in_the_middle(engine):
    engine.start()
    answers = []
    barrier = threading.Barrier(9)

    def ask_much():
        barrier.wait(10)
        answers.extend([engine.ask(lambda engine: engine.live_map.version) for _ in range(250)])
        answers.extend([engine.ask_between(lambda engine: engine.live_map.version) for _ in range(250)])

    threads = [threading.Thread(target=ask_much) for _ in range(8)]
    for thread in threads:
        thread.start()
    barrier.wait(10)
    engine.close()
    for thread in threads:
        thread.join(30)
    assert len(answers) == 4000
    assert not wait(answers, timeout=10).not_done


def test_an_asker_that_has_left_disturbs_nobody_at_closing(engine):
    held = threading.Event()
    engine.start()
    first = engine.ask(lambda engine: held.wait(10))
    closing = threading.Thread(target=engine.close)
    closing.start()
    while engine._inbox.qsize() == 0:  # until the end is in the inbox: what comes now is too late
        pass
    left, stayed = engine.ask(lambda engine: 1), engine.ask(lambda engine: 2)
    left.cancel()
    held.set()
    closing.join(10)
    assert first.result(10)
    with pytest.raises(SessionNotLive):
        stayed.result(10)


def test_a_pushed_line_in_the_inbox_cannot_be_called_back(engine):
    reply = Future()
    engine.start()
    engine.put(LINES[0], reply)
    assert not reply.cancel()
    assert reply.result(10).outcome == "stored"


def test_what_is_asked_between_lines_does_not_wait_behind_a_full_inbox(engine):
    engine.start()
    held, go_on = threading.Event(), threading.Event()

    def hold(_engine):
        held.set()
        go_on.wait(30)

    engine.ask(hold)
    assert held.wait(30)
    for line in LINES:
        engine.put(line)
    in_turn = engine.ask(lambda engine: len(engine.live_map))
    for _ in range(INBOX_LINES - len(LINES) - 1):
        engine.ask(lambda engine: None)
    now = engine.ask_between(lambda engine: len(engine.live_map))  # returns though there is no room for a message
    go_on.set()
    assert now.result(30) == 0
    assert in_turn.result(30) == sum(len(line.index) for line in LINES)


def test_what_is_asked_between_lines_wakes_an_idle_engine_and_is_refused_by_one_that_ended(engine):
    engine.start()
    assert engine.ask_between(lambda engine: len(engine.live_map)).result(30) == 0
    engine.close()
    with pytest.raises(SessionNotLive):
        engine.ask_between(lambda engine: len(engine.live_map)).result(30)
