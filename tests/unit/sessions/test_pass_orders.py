"""What becomes of orders: one that is doubted is decided by somebody, and a restart remembers it."""

import json

import numpy as np
import pytest

from scanner_service.rescan.passes.outcome import Outcome
from scanner_service.sessions.errors import SessionBusy
from scanner_service.sessions.pass_orders import OrderBook, PassStatus, accepted_event, outcome_event
from scanner_service.sessions.reckoning import Brought
from scanner_service.storage.rows import EventRow
from tests.unit.rescan.passes.posed_scans import FROM_ABOVE
from tests.unit.rescan.passes.test_reaches_end import wanted


@pytest.mark.parametrize(("failure", "fate"), [(None, PassStatus.DONE), ("the port is gone", PassStatus.FAILED)])
def test_a_doubted_order_is_decided_once_and_outlasts_a_restart(failure, fate):
    planned = wanted(FROM_ABOVE, 40.0)
    doubtful = Outcome((), np.zeros((0, 3)), doubt="was the part moved?")
    orders, events = OrderBook(), []

    def happens(kind, details):
        events.append(EventRow("s", len(events), "", kind, 0, json.loads(json.dumps(details))))

    for number in (1, 2):
        order = orders.take(planned, 1)
        happens("pass_accepted", accepted_event(order))
        order.end(Brought(doubtful, [number], [("A", 1, number)], True), failure)
        happens("pass_outcome", outcome_event(order))
    assert [one.status for one in orders.all()] == [PassStatus.DOUBTED] * 2
    assert "pass order 1 is doubted" in orders.doubt() and "--withdraw 1" in orders.doubt()
    orders.withdrawn(("A", 1, 1))
    happens("pass_withdrawn", {"device_id": "A", "boot_id": 1, "pass_index": 1})
    orders.get(2).keep()
    happens("pass_kept", {"order": 2})
    with pytest.raises(SessionBusy, match="only one that is doubted is kept"):
        orders.get(2).keep()
    again = OrderBook()
    again.restore(events)
    for book_of_orders in (orders, again):
        assert [one.status for one in book_of_orders.all()] == [PassStatus.WITHDRAWN, fate]
        assert book_of_orders.doubt() is None


def test_decisions_that_come_before_the_outcome_lose_no_order():
    planned = wanted(FROM_ABOVE, 40.0)
    orders, events = OrderBook(), []

    def happens(kind, details):
        events.append(EventRow("s", len(events), "", kind, 0, json.loads(json.dumps(details))))

    for number in (1, 2, 3):
        order = orders.take(planned, 1)
        happens("pass_accepted", accepted_event(order))
        doubtful = Outcome((), np.zeros((0, 3)), doubt="was the part moved?")
        if number == 1:
            happens("pass_kept", {"order": 1})  # does not fit: nobody doubts it yet
        elif number == 2:
            orders.withdrawn(("A", 1, 2))
            happens("pass_withdrawn", {"device_id": "A", "boot_id": 1, "pass_index": 2})
        orders.ended(order, Brought(doubtful, [number], [("A", 1, number)], True), None)
        happens("pass_outcome", outcome_event(order) | {"status": "done"})
    fates = [PassStatus.DOUBTED, PassStatus.WITHDRAWN, PassStatus.DOUBTED]
    assert [one.status for one in orders.all()] == fates
    again = OrderBook()
    again.restore(events)
    assert [one.status for one in again.all()] == fates
