"""The record on a real PostgreSQL server keeps the same promises as in a file."""

import random
import threading
import time
from collections.abc import Iterator

import pytest
from sqlalchemy import create_engine, inspect, text

from scanner_service.storage.errors import (
    NotARecord,
    RecordInUse,
    RecordNotDurable,
    RecordTooNew,
    SessionUnknown,
)
from scanner_service.storage.migrations import schema_of
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from scanner_service.storage.rows import Count, CreationKey, Limits
from scanner_service.storage.tables import SCHEMA_VERSION, metadata
from tests.unit.storage.postgres_server import Server, missing, running_server
from tests.unit.storage.record_lines import bits, line_of
from tests.unit.storage.schema_1 import make_schema_1

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())
FAST = Limits(first_retry_s=0.01, longest_retry_s=0.1)


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with running_server() as running:
        yield running


def name_of(address: str) -> str:
    return address.partition("@/")[2].partition("?")[0]


def test_what_is_acknowledged_is_there_once_in_order_bit_for_bit_also_after_reopening(server: Server) -> None:
    address = server.database()
    truth = [bits(line_of(index, points=200)) for index in range(40)]
    with Record.open(address) as record:
        session = record.create_session("pg", settings={"µ": 1.5}, origin_mm=(0.1, -0.0, 1e-300)).session_id
        answers = [record.append(session, line_of(index, points=200)) for index in (*range(40), *range(5))]
        assert [answer.result().line_number for answer in answers] == [*range(40), *range(5)]
        assert [answer.result().outcome for answer in answers] == ["stored"] * 40 + ["duplicate"] * 5
        assert record.append(session, line_of(3, seed=1, points=200)).result().outcome == "conflict"
        record.append_event(session, "kind", {"i": 1}).result()
        record.save_ledger(session, {"a": 1}).result()
        record.save_ledger(session, {"a": 2}).result()
        assert record.describe(session, notes="ü\n").notes == "ü\n"
        assert record.set_state(session, "stopped").state == "stopped"
        assert record.watermark(session)["s1"].line_count == 40
    with Record.open(address) as record:
        (row,) = record.list_sessions()
        assert (row.damaged, row.notes, row.settings, row.state) == (False, "ü\n", {"µ": 1.5}, "stopped")
        assert row.origin_mm == (0.1, 0.0, 1e-300)
        assert record.ledger(session) == {"a": 2}
        assert [bits(line) for _, line in record.lines(session)] == truth
        assert record.count(session) == Count(40, sum(len(line_of(i, points=200).index) for i in range(40)))
        assert record.verify(session).problems == ()
        assert record.lines_of_passes(session) == {("s1", 1, 0): 40}
        assert record.session_bytes(session) > 40 * 200
        assert record.used_bytes() > 0


def test_sessions_are_listed_and_deleted_as_in_a_file(server: Server) -> None:
    with Record.open(server.database()) as record:
        made = [record.create_session(f"session {number}").session_id for number in range(5)]
        assert [row.session_id for row in record.list_sessions()] == made[::-1]
        key = CreationKey("a" * 64, "b" * 64)
        first = record.create_session("keyed", key=key)
        assert record.create_session("keyed", key=key).session_id == first.session_id
        record.append(first.session_id, line_of(0)).result()
        record.delete_session(first.session_id)
        with pytest.raises(SessionUnknown):
            record.get_session(first.session_id)
        while any(count for (count,) in server.execute(name_of(record.place.name), "SELECT count(*) FROM lines")):
            time.sleep(0.01)


def test_one_service_has_the_record_and_readers_cannot_write(server: Server) -> None:
    address = server.database()
    with Record.open(address) as record:
        session = record.create_session("mine").session_id
        with pytest.raises(RecordInUse, match="in use by another service"):
            Record.open(address)
        record.append(session, line_of(0)).result()
        reader = RecordReader.open(address)
        assert [bits(line) for _, line in reader.lines(session)] == [bits(line_of(0))]
        with reader._engine.connect() as connection, pytest.raises(Exception, match="read-only"):
            connection.execute(text("DELETE FROM lines"))
        reader.close()
    Record.open(address).close()


def test_a_database_of_another_program_a_newer_record_and_a_wrong_address_are_refused(server: Server) -> None:
    address = server.database()
    server.execute(name_of(address), "CREATE TABLE lines (id int)")
    with pytest.raises(NotARecord, match="another program"):
        Record.open(address)
    server.execute(name_of(address), "DROP TABLE lines; CREATE TABLE record (id int)")
    with pytest.raises(NotARecord, match="another program"):
        Record.open(address)
    newer = server.database()
    Record.open(newer).close()
    server.execute(name_of(newer), f"UPDATE record SET schema_version = {SCHEMA_VERSION + 1}")
    for opened in (Record.open, RecordReader.open):
        with pytest.raises(RecordTooNew, match="update first"):
            opened(newer)
    with pytest.raises(RecordNotDurable) as refusal:
        Record.open("postgresql://scanner:secret@/nowhere?host=/nonexistent")
    assert "secret" not in str(refusal.value) and "\n" not in str(refusal.value)
    for wrong in ("mysql://a@b/c", "postgresql+psycopg2://a@b/c", "nonsense://"):
        with pytest.raises(NotARecord):
            Record.open(wrong)


def test_a_record_of_schema_1_is_brought_up_to_date(server: Server) -> None:
    address = server.database()
    engine = create_engine(address.replace("postgresql://", "postgresql+psycopg://"))
    with engine.begin() as connection:
        session = make_schema_1(connection)
        connection.execute(text("COMMENT ON TABLE record IS 'record of scanner-service'"))
    engine.dispose()
    with Record.open(address) as record:
        assert [bits(line) for _, line in record.lines(session)] == [bits(line_of(index)) for index in range(3)]
        assert not record.get_session(session).damaged
        assert record.describe(session, notes="old").notes == "old"
    engine = create_engine(address.replace("postgresql://", "postgresql+psycopg://"))
    with engine.connect() as connection:
        assert schema_of(connection) == SCHEMA_VERSION
        assert set(inspect(connection).get_table_names()) == set(metadata.tables)
    engine.dispose()


def test_connections_that_break_at_any_moment_lose_and_double_nothing(server: Server) -> None:
    address, rng = server.database(), random.Random(3)
    done = threading.Event()

    def break_connections() -> None:
        kill = (
            f"SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = '{name_of(address)}' "
            "AND pid <> pg_backend_pid()"
        )
        while not done.wait(rng.uniform(0, 0.05)):
            server.execute("postgres", kill)

    with Record.open(address, limits=Limits(batch_lines=4, first_retry_s=0.001, longest_retry_s=0.01)) as record:
        session = record.create_session("broken").session_id
        breaking = threading.Thread(target=break_connections)
        breaking.start()
        futures = [record.append(session, line_of(index), timeout_s=60) for index in range(120)]
        answers = [future.result(60) for future in futures]
        done.set()
        breaking.join()
        assert record.writer_state().retries > 0
        assert [(answer.line_number, answer.outcome) for answer in answers] == [(n, "stored") for n in range(120)]
        assert record.writer_state().stored == 120
    with Record.open(address) as record:
        assert [bits(line) for _, line in record.lines(session)] == [bits(line_of(index)) for index in range(120)]


def test_a_server_that_dies_is_waited_for_and_one_that_may_forget_is_refused(server: Server) -> None:
    address = server.database()
    with Record.open(address, limits=FAST) as record:
        session = record.create_session("dying").session_id
        before = [record.append(session, line_of(index)) for index in range(50)]
        before[10].result(30)
        server.stop("immediate")
        after = [record.append(session, line_of(index)) for index in range(50, 60)]
        while record.writer_state().state == "ok":
            time.sleep(0.01)
        server.start()
        answers = [future.result(60) for future in (*before, *after)]
        assert [(answer.line_number, answer.outcome) for answer in answers] == [(n, "stored") for n in range(60)]
        assert [bits(line) for _, line in record.lines(session)] == [bits(line_of(i)) for i in range(60)]
    server.stop("immediate")
    server.start("fsync=off")
    with pytest.raises(RecordNotDurable, match="fsync = off"):
        Record.open(address)
