"""The desk writes one export after another, bounds what it keeps, and tells what went wrong."""

import time

import pytest

from scanner_service.sessions.errors import SessionBusy, SourceUnusable
from scanner_service.sessions.export_desk import MOST_KEPT, MOST_WAITING, ExportDesk
from scanner_service.sessions.settings import SessionSettings
from scanner_service.storage.errors import SessionUnknown
from scanner_service.storage.exports.errors import FormatNotWritten
from scanner_service.storage.exports.manifest import verify_folder
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record
from tests.unit.analysis.scans import surface_scan


@pytest.fixture
def session(tmp_path):
    """A record with a session; its path and the session's id."""
    path = tmp_path / "record.sqlite"
    with Record.open(path) as record:
        row = record.create_session("plate", state="stopped", settings=SessionSettings(max_points=2000).to_dict())
        for line in surface_scan(lambda x, y: 0.0 * x, lines=4):
            record.append(row.session_id, line).result(10)
    return path, row.session_id


@pytest.fixture
def desk(session, tmp_path):
    (tmp_path / "exports" / "old").mkdir(parents=True)
    desk = ExportDesk(tmp_path / "exports", lambda: RecordReader.open(session[0]))
    yield desk
    desk.close()


def wait_for(desk, session_id, job_id):
    while desk.job(session_id, job_id).state in ("waiting", "writing"):
        time.sleep(0.02)
    return desk.job(session_id, job_id)


def test_what_an_earlier_process_left_is_removed_and_exports_are_kept_up_to_a_number(desk, session, tmp_path):
    assert list((tmp_path / "exports").iterdir()) == []
    ordered = []
    for _ in range(MOST_KEPT + 3):
        ordered.append(desk.order(session[1], ["pcd"]).job_id)
        wait_for(desk, session[1], ordered[-1])
    kept = [job.job_id for job in desk.jobs(session[1])]
    assert kept == ordered[::-1][: len(kept)]
    assert len(kept) <= MOST_KEPT
    assert {path.name for path in (tmp_path / "exports").iterdir()} == set(kept)
    assert verify_folder(tmp_path / "exports" / kept[0]).problems == ()


def test_an_export_that_fails_says_why_and_leaves_nothing_and_the_next_one_is_written(desk, session, tmp_path):
    (tmp_path / "moved").mkdir()
    session[0].rename(tmp_path / "moved" / "record.sqlite")
    with pytest.raises(Exception, match="there is no record"):
        desk.order(session[1], ["ply"])
    (tmp_path / "moved" / "record.sqlite").rename(session[0])
    job = desk.order(session[1], ["ply"])
    done = wait_for(desk, session[1], job.job_id)
    assert done.state == "done"
    folder = desk.file(session[1], job.job_id, "points.ply").parent
    desk.take_back(session[1], job.job_id)
    assert not folder.exists()


def test_orders_are_refused_before_they_wait(desk, session):
    with pytest.raises(FormatNotWritten):
        desk.order(session[1], ["obj"])
    with pytest.raises(SessionUnknown):
        desk.order("none", ["ply"])
    with pytest.raises(SourceUnusable):
        desk.job(session[1], "none")
    assert desk.jobs(session[1]) == []


def test_no_more_wait_than_are_allowed(desk, session, monkeypatch):
    import threading

    go_on = threading.Event()
    monkeypatch.setattr(
        "scanner_service.sessions.export_desk.export_session", lambda *_, **__: go_on.wait(30) and {"files": {}}
    )
    for _ in range(MOST_WAITING):
        desk.order(session[1], ["ply"])
    with pytest.raises(SessionBusy, match="wait already"):
        desk.order(session[1], ["ply"])
    go_on.set()
