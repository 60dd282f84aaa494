"""What is deleted by itself: never without a limit, never what is in use, the oldest first, and no more than needed."""

from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.errors import BudgetSpent
from scanner_service.sessions.retention import Kept, Retention, choose
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import PushSpec
from scanner_service.storage.record import Record
from tests.unit.analysis.scans import scanline

NOW = datetime(2026, 11, 26, tzinfo=UTC)
SESSIONS = st.lists(st.tuples(st.integers(0, 400), st.integers(0, 1000), st.booleans()), max_size=12)


@given(SESSIONS, st.none() | st.integers(1, 300), st.none() | st.integers(1, 4000))
def test_the_choice_keeps_to_both_limits_or_says_by_how_much_it_cannot(sessions, days, budget):
    kept = [
        Kept(str(number), NOW - timedelta(hours=age), size, may_go)
        for number, (age, size, may_go) in enumerate(sessions)
    ]
    choice = choose(Retention(days, budget), kept, NOW)
    gone = [session_id for session_id, _ in choice.deleted]
    assert len(set(gone)) == len(gone)
    assert all(kept[int(session_id)].may_go for session_id in gone)
    left = [session for session in kept if session.session_id not in gone]
    if days is None and budget is None:
        assert not gone
    if days is not None:
        assert not [s for s in left if s.may_go and s.created < NOW - timedelta(days=days)]
    if budget is None:
        assert choice.over_bytes == 0
        return
    size = sum(session.size_bytes for session in left)
    assert choice.over_bytes == max(0, size - budget)
    assert choice.over_bytes == 0 or not any(session.may_go for session in left)
    for_budget = [kept[int(session_id)] for session_id, reason in choice.deleted if "budget" in reason]
    assert not for_budget or size + for_budget[-1].size_bytes > budget  # the last one was needed
    assert [s.created for s in for_budget] == sorted(s.created for s in for_budget)


@pytest.mark.parametrize("limits", [{"keep_days": 0}, {"keep_days": float("nan")}, {"budget_bytes": 0}])
def test_a_limit_that_keeps_nothing_is_refused(limits):
    with pytest.raises(ValueError, match="0"):
        Retention(**limits)


def test_a_budget_deletes_the_oldest_session_that_is_over_and_else_refuses_a_new_one(tmp_path):
    with Record.open(tmp_path / "record.sqlite") as record:
        book = SessionBook(record, Retention(budget_bytes=1))
        first = book.create("first", PushSpec(), SessionSettings(max_points=100))
        first.start()
        first.push(scanline([[0, 0, 0]])).result(10)
        with pytest.raises(BudgetSpent, match="delete sessions"):
            book.create("second", PushSpec(), SessionSettings(max_points=100))
        first.stop()
        book.close()
        book = SessionBook(record, Retention(budget_bytes=1))
        second = book.create("second", PushSpec(), SessionSettings(max_points=100))
        assert [row.session_id for row in record.list_sessions()] == [second.row.session_id]
        book.close()
