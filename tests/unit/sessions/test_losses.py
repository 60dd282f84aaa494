"""What a session tells of its losses balances in every answer, however wire, session and record run on meanwhile."""

import time
from contextlib import closing
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.boot_ledger import BootLedger
from drivers.scanline import DeviceInfo, SensorGeometry
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.reporting import report_of
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import PushSpec
from scanner_service.sessions.stored import read_session
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from tests.unit.analysis.scans import scanline

GEOMETRY = SensorGeometry(np.array([0.0, 0.0, 150.0]), np.array([0.0, 60.0, 150.0]), (-20.0, 20.0), 0.1)
ROW_MM = np.column_stack([np.arange(20) * 0.2, np.zeros(20), np.zeros(20)])


class RestlessWire:
    """A scanner whose lines come exactly while its accounts are being read: before, between and after them."""

    def __init__(self, meanwhile, boot_id=1):
        self.geometry, self.towards_sensor = GEOMETRY, np.array([0.0, 0.0, 1.0])
        self.info = DeviceInfo("A", "M", "F", "C", 1, 20, GEOMETRY)
        self._meanwhile = meanwhile
        self._account = BootLedger(boot_id=boot_id)
        self.boot_id = boot_id
        self._delivered = 0
        self.sent: list[bool] = []  # of each line whether it was lost

    def start(self, sink):
        self._sink = sink

    def stop(self):
        pass

    def progress(self):
        return None

    def tally(self):
        self._measure()
        told = self._account.tally().to_dict()
        self._measure()
        return told

    def pass_tallies(self):
        self._measure()
        passes = self._account.tally().passes
        self._measure()
        return {("A", boot, index): told for (boot, index), told in passes.items()}

    def _measure(self):
        for is_lost in self._meanwhile.pop() if self._meanwhile else ():
            number = len(self.sent)
            self.sent.append(is_lost)
            if not is_lost:
                self._account.chunk(number, number, 0, 0)
                self._account.line_closed(whole=True)
                self._sink.line(scanline(ROW_MM + np.array([0, 0.2 * number, 0]), number, boot_id=self.boot_id))
                self._delivered += 1
        while self._sink.engine.ledger.snapshot().received < self._delivered:  # until the session has heard of all
            time.sleep(0.001)


@pytest.fixture(scope="module")
def book(tmp_path_factory):
    with Record.open(tmp_path_factory.mktemp("losses") / "record.sqlite") as record:
        book = SessionBook(record)
        yield book
        book.close()


@settings(max_examples=15, deadline=None)
@given(st.lists(st.lists(st.booleans(), max_size=4), max_size=20))
def test_every_answer_balances_and_nothing_is_less_than_under_way(book, meanwhile):
    source = RestlessWire([list(lines) for lines in meanwhile])
    session = book.create("test", PushSpec(), SessionSettings(max_points=20_000), source=source)
    session.start()
    for _ in range(8):
        told = session.losses()
        lines = told["lines"]
        assert lines["received"] == lines["pending"] + lines["stored"] + lines["duplicates"] + lines["conflicts"]
        assert told["device"]["lines"]["stored"] >= lines["received"]
        for account in told["passes"]:
            of_pass = account["lines"]
            assert of_pass["under_way"] >= 0
            assert of_pass["sent"] == of_pass["stored"] + of_pass["under_way"] + sum(of_pass["lost"].values())
        assert sum(account["lines"]["stored"] for account in told["passes"]) == lines["stored"]
    session.stop()
    told = session.losses()
    behind = [number for number, is_lost in enumerate(source.sent) if not is_lost]
    sent = behind[-1] + 1 if behind else 0  # a gap is known by the line behind it
    assert told["lines"]["received"] == told["lines"]["stored"] == told["device"]["lines"]["stored"] == len(behind)
    lost = {"missing": sent - len(behind)} if sent > len(behind) else {}
    accounts = [account["lines"] for account in told["passes"]]
    balance = [[lines[of] for of in ("sent", "stored", "under_way", "lost")] for lines in accounts]
    assert balance == ([[sent, len(behind), 0, lost]] if behind else [])


def test_the_scanner_s_losses_are_those_of_all_passes_also_after_a_restart(tmp_path):
    sound, gap = [False, False, False], [False, True, False]  # a gap is known by the line behind it
    passes = [[sound], [gap, sound], [gap]]
    with Record.open(tmp_path / "r") as record:
        book = SessionBook(record)
        session = book.create("passes", PushSpec(), SessionSettings(max_points=20_000), source=RestlessWire(passes[0]))
        session.start()
        assert wait_for_account(session) == (3, {})
        session.stop()
        session.carry_out(lambda: RestlessWire(passes[1], boot_id=2))
        assert wait_for_account(session) == (9, {"missing": 1})
        session.stop()
        session_id = session.row.session_id
        book.close()
    with Record.open(tmp_path / "r") as record:
        book = SessionBook(record)
        session = book.get(session_id)
        assert wait_for_account(session) == (9, {"missing": 1})
        session.carry_out(lambda: RestlessWire(passes[2], boot_id=3))
        assert wait_for_account(session) == (12, {"missing": 2})
        session.stop()
        book.close()
    with closing(RecordReader.open(tmp_path / "r")) as reader:
        content = report_of(read_session(reader, reader.get_session(session_id), with_stages=True), datetime.now(UTC))
    told = dict(dict(content.losses)["Scanlines of each pass, from the scanner to the record"])
    assert told["A pass 0, boot 2"] == "6 sent, 5 stored; lost: 1 missing"
    assert told["all passes"] == "12 sent, 10 stored; lost: 2 missing"
    assert dict(dict(content.losses)["Scanner and wire, all passes"])["lines · sent"] == "12"


def wait_for_account(session):
    """Lines sent and lost, once the account of the wire has nothing more to tell of."""
    for _ in range(6):
        told = session.losses()
    return told["device"]["lines"]["sent"], told["device"]["lines"]["lost"]
