"""The disk of a running service is full in the middle of a scan: it stays up, keeps what it can, counts the rest, says
so, and goes on by itself. A limit of the operating system on the size of files stands for the full disk."""

import resource
import sys

import pytest

from tests.end_to_end.running import wait_for
from tests.end_to_end.test_live_scan import device
from tests.end_to_end.test_sessions_by_hand import account_of

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs limits that another process can set")


def limit_files(service, size_bytes):
    resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, (size_bytes, resource.RLIM_INFINITY))


def test_a_full_disk_costs_what_does_not_fit_into_memory_and_not_the_service(running, monkeypatch):
    monkeypatch.setenv("SCANNER_SPOOL_MB", "0.06")
    service, simulator = running.service(), running.simulator("plate")
    session_id = service.create(**device(simulator))
    service.start(session_id)
    wait_for(lambda: service.status(session_id)["lines"] > 10, "some lines")
    limit_files(service, max(path.stat().st_size for path in service.data.glob("record.sqlite*")))
    wait_for(lambda: (service.status(session_id)["message"] or "").startswith("the record cannot be written"), "word")
    assert service.client.get("/readyz").status_code == 503

    def is_full():
        passes = service.status(session_id)["losses"]["passes"]
        return any("record_busy" in told["lines"]["lost"] for told in passes)

    wait_for(is_full, "lines that do not fit")
    ill = service.status(session_id)
    account_of(ill)
    service.wait_for_state(session_id, "stopped")
    limit_files(service, resource.RLIM_INFINITY)
    wait_for(lambda: service.client.get("/readyz").status_code == 200, "the record to be ready")
    wait_for(lambda: service.status(session_id)["losses"]["lines"]["pending"] == 0, "what waited")
    status = service.status(session_id)
    sent, stored, lost = account_of(status)
    assert (sent, stored + lost) == (81, 81)
    assert lost == status["losses"]["lines"]["refused"]["record_busy"] > 0
    assert stored == status["lines"] >= ill["lines"]
    events = f"/api/v1/sessions/{session_id}/events"

    def kinds():
        return [event["kind"] for event in service.client.get(events).json()["events"]]

    wait_for(lambda: {"record_resumed", "losses"} <= set(kinds()), "the events of the failure")
    (told,) = (e for e in service.client.get(events).json()["events"] if e["kind"] == "record_resumed")
    assert 0 < told["details"]["lines_lost"] <= lost
    service.wait_until_kept(session_id)
    service.kill()
    service = running.service()
    again = service.status(session_id)
    assert again["lines"] == stored
    assert again["losses"]["passes"] == status["losses"]["passes"]
