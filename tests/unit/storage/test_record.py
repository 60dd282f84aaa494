"""The laws of the record: what is acknowledged is readable, once, in order, bit for bit, also after reopening."""

import json
import random
import sqlite3
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scanner_service.storage.answer import Answer
from scanner_service.storage.errors import (
    NotStorable,
    RecordBusy,
    RecordClosed,
    SessionUnknown,
)
from scanner_service.storage.record import Record
from scanner_service.storage.rows import Count, Limits, Stored, Watermark
from tests.unit.storage.record_lines import bits, line_of

FAST = Limits(first_retry_s=0.001, longest_retry_s=0.01)


@pytest.fixture
def record(tmp_path: Path) -> Iterator[Record]:
    with Record.open(tmp_path / "record.sqlite") as opened:
        yield opened


def faulty_disk(plan: list[str]) -> type[sqlite3.Connection]:
    """A connection whose commits fail by plan: `before` or `after` the transaction is in; then it works."""

    class FaultyConnection(sqlite3.Connection):
        def commit(self) -> None:
            fault = plan.pop(0) if plan else "none"
            if fault == "before":
                raise sqlite3.OperationalError("disk I/O error")
            super().commit()
            if fault == "after":
                raise sqlite3.OperationalError("disk I/O error")

    return FaultyConnection


KEYS = st.tuples(st.sampled_from(["s1", "s2"]), st.integers(1, 2), st.integers(0, 5), st.integers(0, 1))


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    appended=st.lists(KEYS, max_size=40),
    batch_lines=st.integers(1, 9),
    plan=st.lists(st.sampled_from(["none", "none", "before", "after"]), max_size=12),
)
def test_a_key_is_stored_once_in_order_whatever_the_batches_and_the_failing_commits(
    tmp_path_factory: pytest.TempPathFactory, appended: list[Any], batch_lines: int, plan: list[str]
) -> None:
    path = tmp_path_factory.mktemp("record") / "record.sqlite"
    limits = Limits(batch_lines=batch_lines, first_retry_s=0.001, longest_retry_s=0.002)
    expected: list[Stored] = []
    content: dict[tuple[str, int, int], tuple[int, int]] = {}
    for device, boot, index, seed in appended:
        number, first_seed = content.setdefault((device, boot, index), (len(content), seed))
        is_new = len(expected) == 0 or number not in {answer.line_number for answer in expected}
        expected.append(Stored(number, "stored" if is_new else "duplicate" if seed == first_seed else "conflict"))
    truth = [bits(line_of(index, seed, device, boot)) for (device, boot, index), (_, seed) in content.items()]

    with Record.open(path, limits=limits, connection_class=faulty_disk(plan)) as record:
        session = record.create_session("laws").session_id
        futures = [record.append(session, line_of(i, seed, d, b)) for d, b, i, seed in appended]
        assert [future.result() for future in futures] == expected
        assert [(number, bits(line)) for number, line in record.lines(session)] == list(enumerate(truth))
        state = record.writer_state()
        marks = dict(record.watermark(session))
    outcomes = [answer.outcome for answer in expected]
    assert (state.stored, state.duplicates, state.conflicts, state.waiting_lines, state.refused) == (
        *(outcomes.count(outcome) for outcome in ("stored", "duplicate", "conflict")),
        0,
        0,
    )
    last_boot = {device: boot for device, boot, _ in content}
    assert set(marks) == set(last_boot)
    for device, boot in last_boot.items():
        indices = [index for d, b, index in content if (d, b) == (device, boot)]
        assert marks[device] == Watermark(boot, max(indices), min(indices), len(indices))

    with Record.open(path) as again:
        assert [bits(line) for _, line in again.lines(session)] == truth
        assert again.watermark(session) == marks
        points = sum(len(line.index) for _, line in again.lines(session))
        assert again.count(session) == Count(len(truth), points)
        repeats = [again.append(session, line_of(i, seed, d, b)) for d, b, i, seed in appended]
        assert [future.result().line_number for future in repeats] == [answer.line_number for answer in expected]
        assert again.count(session).lines == len(truth)
        assert again.verify(session).damaged == again.verify(session).problems == ()


def test_a_range_of_lines_is_that_slice_of_all(record: Record) -> None:
    session = record.create_session("slices").session_id
    for index in range(70):
        record.append(session, line_of(index)).add_done_callback(Answer.result)
    record.append_event(session, "end", {}).result()
    numbers = [number for number, _ in record.lines(session)]
    assert numbers == list(range(70))
    for start, stop in ((0, 0), (3, 40), (31, 33), (60, 500), (70, None), (-5, 2)):
        got = [(number, line.line_index) for number, line in record.lines(session, start, stop)]
        assert got == [(n, n) for n in range(max(start, 0), min(70 if stop is None else stop, 70))]


def test_events_are_numbered_and_know_how_many_lines_came_before(record: Record) -> None:
    session = record.create_session("events").session_id
    record.append_event(session, "pass-opened", {"pass": 0, "ledger": {"sent": 1.5, "ü": None}})
    for index in range(3):
        record.append(session, line_of(index))
    record.append_event(session, "pass-closed", {"pass": 0}).result()
    first, second = record.events(session)
    assert (first.number, first.kind, first.line_number) == (0, "pass-opened", 0)
    assert first.details == {"pass": 0, "ledger": {"sent": 1.5, "ü": None}}
    assert (second.number, second.line_number) == (1, 3)
    assert list(record.events(session, after=0)) == [second]
    assert not first.damaged


def test_sessions_come_newest_first_in_pages_even_when_the_clock_goes_back(tmp_path: Path) -> None:
    moments = iter([datetime(2026, 1, 1, 0, 0, second, tzinfo=UTC) for second in (30, 30, 20, 40, 10, 50)])
    with Record.open(tmp_path / "r", clock=lambda: next(moments), rng=random.Random(1)) as record:
        made = [record.create_session(f"n{number}") for number in range(5)]
        ids = [session.session_id for session in made]
        assert ids == sorted(ids) and len(set(ids)) == 5
        assert record.list_sessions() == made[::-1]
        assert record.list_sessions(limit=2, after=ids[3]) == [made[2], made[1]]


def test_a_session_keeps_what_it_was_given_and_its_state_changes(record: Record) -> None:
    origin = (0.1, -1e300, 5e-324)
    made = record.create_session("Part ü", settings={"a": [1, 2.5]}, origin_mm=origin, source={"device": "s1"})
    assert record.get_session(made.session_id) == made
    assert (made.origin_mm, made.settings, made.damaged) == (origin, {"a": [1, 2.5]}, False)
    changed = record.set_state(made.session_id, "closed")
    assert record.get_session(made.session_id) == changed
    assert (changed.state, changed.created_utc, changed.damaged) == ("closed", made.created_utc, False)


def test_a_deleted_session_is_gone_at_once_and_leaves_the_others(tmp_path: Path) -> None:
    with Record.open(tmp_path / "r") as record:
        kept, gone = (record.create_session(name).session_id for name in ("kept", "gone"))
        for index in range(600):
            record.append(gone, line_of(index, points=2))
        record.append(kept, line_of(0)).result()
        record.delete_session(gone)
        for refused in (record.get_session, record.lines, record.events, record.count, record.watermark):
            with pytest.raises(SessionUnknown):
                refused(gone)
        with pytest.raises(SessionUnknown):
            record.append(gone, line_of(601)).result()
        with pytest.raises(SessionUnknown):
            record.delete_session(gone)
        assert [session.session_id for session in record.list_sessions()] == [kept]
    # closed with the deletion barely begun: it is finished after reopening
    with Record.open(tmp_path / "r") as record:
        while rows_left(tmp_path / "r", gone):
            record.set_state(kept, "waiting")
        assert [line.line_index for _, line in record.lines(kept)] == [0]


def rows_left(path: Path, session: str) -> int:
    database = sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True)
    try:
        (left,) = database.execute("SELECT count(*) FROM sessions WHERE session_id = ?", (session,)).fetchone()
        return int(left)
    finally:
        database.close()


def test_nothing_is_acknowledged_while_the_disk_fails_and_everything_is_once_it_works(tmp_path: Path) -> None:
    plan = ["none"]
    with Record.open(tmp_path / "r", limits=FAST, connection_class=faulty_disk(plan)) as record:
        session = record.create_session("faults").session_id
        plan[:] = ["before"] * 10_000
        future = record.append(session, line_of(0))
        while (state := record.writer_state()).state == "ok":
            pass
        assert str(state) == "failing: disk I/O error" and state.waiting_lines == 1 and not future.done()
        assert list(record.lines(session)) == []
        plan.clear()
        assert future.result(timeout_s=20) == Stored(0, "stored")
        assert (record.writer_state().state, record.writer_state().waiting_lines) == ("ok", 0)


def test_after_a_failed_commit_the_next_attempt_begins_outside_of_any_transaction(tmp_path: Path) -> None:
    plan, said = ["none"], []

    class Noting(sqlite3.Cursor):
        def execute(self, *arguments: Any) -> Any:
            try:
                return super().execute(*arguments)
            except sqlite3.Error as error:
                said.append(str(error))
                raise

    class Noted(faulty_disk(plan)):  # type: ignore[misc]
        def cursor(self, factory: type[sqlite3.Cursor] = Noting) -> Any:
            return super().cursor(factory)

    with Record.open(tmp_path / "r", limits=FAST, connection_class=Noted) as record:
        session = record.create_session("open").session_id
        plan[:] = ["before"] * 3  # fewer than make the writer open a new connection
        assert record.append(session, line_of(0)).result(timeout_s=60) == Stored(0, "stored")
        assert record.writer_state().retries == 3
    assert said == []


def test_a_full_spool_refuses_counts_and_takes_no_more_than_its_bound(tmp_path: Path) -> None:
    plan = ["none"]
    limits = Limits(spool_bytes=20_000, first_retry_s=0.001, longest_retry_s=0.01)
    with Record.open(tmp_path / "r", limits=limits, connection_class=faulty_disk(plan)) as record:
        session = record.create_session("full").session_id
        plan[:] = ["before"] * 10_000
        taken = []
        with pytest.raises(RecordBusy):
            for index in range(1000):
                taken.append(record.append(session, line_of(index)))
        with pytest.raises(RecordBusy):
            record.append(session, line_of(1000), timeout_s=0.01)
        state = record.writer_state()
        assert state.refused == 2 and state.waiting_lines == len(taken) > 5 and state.waiting_bytes <= 20_000
        plan.clear()
        assert [future.result(timeout_s=20).line_number for future in taken] == list(range(len(taken)))


def test_closing_on_a_dead_disk_says_how_many_lines_are_not_confirmed(tmp_path: Path) -> None:
    plan = ["none"]
    record = Record.open(tmp_path / "r", limits=FAST, connection_class=faulty_disk(plan))
    session = record.create_session("dead").session_id
    plan[:] = ["before"] * 1_000_000
    futures = [record.append(session, line_of(index)) for index in range(4)]
    assert record.close(timeout_s=0.05) == 4
    for future in futures:
        with pytest.raises(RecordClosed):
            future.result(timeout_s=60)
    with pytest.raises(RecordClosed):
        record.append(session, line_of(9))
    record.close()


def test_a_removed_file_stops_acknowledgements_until_it_is_back(tmp_path: Path) -> None:
    path, aside = tmp_path / "r", tmp_path / "aside"
    with Record.open(path, limits=FAST) as record:
        session = record.create_session("moved").session_id
        path.rename(aside)
        future = record.append(session, line_of(0))
        while record.writer_state().state == "ok":
            pass
        assert "removed or replaced" in record.writer_state().reason and not future.done()
        aside.rename(path)
        assert future.result(timeout_s=20) == Stored(0, "stored")


def test_a_line_of_no_session_is_refused_and_the_others_of_its_batch_are_stored(record: Record) -> None:
    session = record.create_session("one").session_id
    good, bad, also_good = (record.append(s, line_of(i)) for i, s in enumerate((session, "nowhere", session)))
    assert (good.result().line_number, also_good.result().line_number) == (0, 1)
    with pytest.raises(SessionUnknown):
        bad.result()
    assert record.writer_state().refused == 1


def test_what_cannot_be_kept_exactly_is_refused_before_it_is_queued(record: Record) -> None:
    session = record.create_session("exact").session_id
    with pytest.raises(NotStorable):
        record.append_event(session, "kind", {"x": float("nan")})
    with pytest.raises(NotStorable):
        record.append_event(session, "a\0b", {})
    with pytest.raises(NotStorable):
        record.create_session("\ud800")
    with pytest.raises(NotStorable):
        record.create_session("nan", origin_mm=(0.0, float("nan"), 0.0))
    with pytest.raises(NotStorable):
        record.create_session("set", settings={"a": {1, 2}})
    assert json.dumps([row.name for row in record.list_sessions()]) == '["exact"]'


def test_the_log_stays_bounded_while_a_reader_dawdles(tmp_path: Path) -> None:
    limits = Limits(checkpoint_bytes=1 << 18, wal_bytes=1 << 20)
    with Record.open(tmp_path / "r", limits=limits) as record:
        session = record.create_session("log").session_id
        record.append(session, line_of(0, points=1280)).result()
        dawdling = record.lines(session)
        next(dawdling)
        for index in range(1, 1200):
            record.append(session, line_of(index, points=200)).result() if index % 50 == 0 else record.append(
                session, line_of(index, points=1280)
            )
        record.append_event(session, "end", {}).result()
        assert (tmp_path / "r-wal").stat().st_size < 4 << 20
        assert record.writer_state().checkpoint_problem == ""
