"""Small draws from the generators of the fault harness; `python -m tests.faults` makes the large ones."""

import logging
import sqlite3
import threading
from collections import Counter

import pytest

from tests.faults import sqlite_disk
from tests.faults.bit_flips import flip_bits
from tests.faults.kills import Pushed, kill_services, push_until
from tests.faults.power_cuts import cut_power
from tests.faults.storage_faults import every_fault, inject, sample

under_sqlite = pytest.mark.skipif(bool(sqlite_disk.available()), reason=sqlite_disk.available())


@pytest.fixture(autouse=True)
def without_a_thousand_warnings():
    """Each injected fault is told by the record, as it should be."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


def careless(mode: str) -> type[sqlite3.Connection]:
    """A writer's connection that syncs less than ours: what the harness must find out."""

    class CarelessConnection(sqlite3.Connection):
        def execute(self, sql, *arguments):
            return super().execute(sql.replace("synchronous=FULL", f"synchronous={mode}"), *arguments)

    return CarelessConnection


def kept_everything(account) -> bool:
    return not any(getattr(account, kind, 0) for kind in ("lost", "doubled", "torn", "corrupt", "died", "silent"))


@under_sqlite
def test_every_acknowledged_line_survives_power_cuts():
    account = cut_power(60, seed=11)
    assert kept_everything(account), account
    assert account.looked_for > 500


@under_sqlite
@pytest.mark.parametrize("mode", ["NORMAL", "OFF"])
def test_the_power_cuts_find_out_a_writer_that_does_not_sync(mode):
    assert cut_power(25, seed=12, connection_class=careless(mode)).lost > 0


@under_sqlite
def test_the_record_survives_a_sample_of_all_storage_faults():
    account = inject(sample(40, seed=13))
    assert kept_everything(account), account
    assert account.met > 20


def test_the_whole_service_is_killed_during_a_scan_and_loses_nothing():
    account = kill_services(kills=3, lines=600, seed=14)
    assert kept_everything(account), account
    assert account.acknowledged >= 600


def test_lines_that_a_starved_service_refuses_are_pushed_again_until_it_takes_them():
    class Starved:
        """Refuses every third line the first two times."""

        def __init__(self):
            self.stored, self.refusals = {}, Counter()

        def ask(self, method, path, body=None):
            return {"id": "S"} if body is None or "source" in body else {"lines": [*map(self.take, body["lines"])]}

        def take(self, line):
            index = line["line_index"]
            if index % 3 == 0 and self.refusals[index] < 2:
                self.refusals[index] += 1
                return {"line_index": index, "outcome": "refused", "detail": "the disk is slow"}
            is_new = index not in self.stored
            number = self.stored.setdefault(index, len(self.stored))
            return {"line_index": index, "outcome": "stored" if is_new else "duplicate", "line_number": number}

    service, pushed = Starved(), Pushed()
    push_until(service, pushed, 40, threading.Event(), seed=1)
    assert set(range(40)) <= set(pushed.acknowledged)
    assert pushed.acknowledged == service.stored
    assert pushed.refused == service.refusals.total() > 20


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_five_hundred_kills():
    assert kept_everything(kill_services(kills=500, lines=200_000, seed=15))


@pytest.mark.long
@under_sqlite
@pytest.mark.timeout(3600)
def test_five_thousand_power_cuts():
    assert kept_everything(cut_power(5_000, seed=16))


@pytest.mark.long
@under_sqlite
@pytest.mark.timeout(3600)
def test_every_storage_fault():
    assert kept_everything(inject(every_fault()))


def test_one_flipped_bit_anywhere_in_the_file_is_harmless_or_seen():
    assert kept_everything(flip_bits(60, seed=4))


@pytest.mark.long
def test_ten_thousand_flipped_bits_of_the_file_are_harmless_or_seen():
    assert kept_everything(flip_bits(10_000, seed=5))
