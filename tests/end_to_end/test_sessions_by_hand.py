"""What a person does with a session: pauses, resumes, reopens, annotates, deletes it; and what the laser does then."""

import contextlib
import json
import shutil
import sqlite3
import time

import numpy as np
import pytest
import websockets.exceptions
import websockets.sync.client
from typer.testing import CliRunner

from scanner_service.cli import app
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.fingerprint import verdict_sha256
from scanner_service.sessions.replay_source import ReplaySource
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import PushSpec
from scanner_service.storage.record import Record
from tests.end_to_end.running import RunningService, RunningSimulator, wait_for
from tests.end_to_end.test_live_scan import device, live_client, read_ply
from tests.unit.analysis.scans import surface_scan


def account_of(status):
    """Lines sent, stored and lost over all passes; each pass balances."""
    sent = stored = lost = 0
    for told in status["losses"]["passes"]:
        lines, chunks = told["lines"], told["chunks"]
        assert lines["sent"] == lines["stored"] + lines["under_way"] + sum(lines["lost"].values()), told
        assert lines["stored"] == lines["whole"] + lines["partial"]
        assert chunks is None or chunks["sent"] == chunks["stored"] + sum(chunks["lost"].values()), told
        sent, stored, lost = sent + lines["sent"], stored + lines["stored"], lost + sum(lines["lost"].values())
    return sent, stored, lost


def act(service, session_id, verb):
    answer = service.client.post(f"/api/v1/sessions/{session_id}/{verb}")
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_a_paused_scan_goes_on_behind_its_last_line_as_another_pass(service, running):
    simulator = running.simulator("plate")
    session_id = service.create(**device(simulator))
    service.start(session_id)
    wait_for(lambda: service.status(session_id)["lines"] > 10, "some lines")
    paused = act(service, session_id, "pause")
    assert (paused["state"], paused["held"]) == ("paused", True)
    assert service.client.post(f"/api/v1/sessions/{session_id}/pause").status_code == 409
    wait_for(lambda: account_of(service.status(session_id))[0] == service.status(session_id)["lines"], "all lines")
    before = service.status(session_id)["lines"]
    time.sleep(0.5)
    assert service.status(session_id)["lines"] == before
    act(service, session_id, "resume")
    status = service.wait_for_state(session_id, "stopped")
    passes = status["losses"]["passes"]
    assert [told["lines"]["sent"] for told in passes] == [before, 81 - before]
    assert account_of(status) == (81, 81, 0)
    lines = service.client.get(f"/api/v1/sessions/{session_id}/scanlines", params={"limit": 200}).json()["scanlines"]
    np.testing.assert_allclose([line["position_mm"] for line in lines], 2.0 + 0.25 * np.arange(81), atol=1e-9)


def test_after_an_interruption_longer_than_the_dead_man_the_laser_stays_off_until_somebody_says_so(
    service, running, tmp_path
):
    link = tmp_path / "port"
    simulator = running.simulator("plate", "--link", link, "--dead-man", 0.5)
    session_id = service.create(**device(simulator, port=str(link)))
    service.start(session_id)
    wait_for(lambda: service.status(session_id)["lines"] > 10, "some lines")
    simulator.tell("unplug")
    service.wait_for_state(session_id, "paused")
    assert service.client.post(f"/api/v1/sessions/{session_id}/resume").status_code == 409  # there is no scanner
    time.sleep(1.5)
    simulator.tell("replug")
    wait_for(lambda: service.status(session_id)["held"], "the scanner to be back and held")
    held = service.status(session_id)
    assert held["state"] == "paused"
    assert "laser is off" in held["message"]
    time.sleep(0.7)
    assert service.status(session_id)["lines"] == held["lines"]
    resumed = act(service, session_id, "resume")
    assert resumed["message"] is None
    status = service.wait_for_state(session_id, "stopped")
    sent, stored, lost = account_of(status)
    assert (sent, lost) == (stored + lost, status["losses"]["device"]["lines"]["lost"].get("disconnected", 0))
    assert len(status["losses"]["passes"]) == 2
    kinds = [event["kind"] for event in service.client.get(f"/api/v1/sessions/{session_id}/events").json()["events"]]
    assert [kind for kind in kinds if kind in ("interrupted", "held", "resumed")] == ["interrupted", "held", "resumed"]


ONCE, ITS_KEY = {"name": "once", "source": {"kind": "push"}}, {"Idempotency-Key": "7f3a"}


def created_twice(service):
    first, again = (service.client.post("/api/v1/sessions", json=ONCE, headers=ITS_KEY) for _ in range(2))
    assert (first.status_code, again.status_code) == (201, 201)
    assert first.json()["id"] == again.json()["id"]
    other = service.client.post("/api/v1/sessions", json=ONCE | {"name": "other"}, headers=ITS_KEY)
    assert (other.status_code, other.json()["type"]) == (422, "/problems/idempotency-key-reused")
    return first.json()["id"]


def pushed(service, session_id, numbers, places):
    lines = [
        {
            "line_index": i,
            "points_mm": [[0.15 * k, 0.2 * i, 0.0] for k in range(places)],
            "laser_mm": [3.0, 0.2 * i, 100.0],
            "line_spacing_mm": 0.2,
        }
        for i in numbers
    ]
    answer = service.client.post(f"/api/v1/sessions/{session_id}/scanlines", json={"lines": lines})
    assert answer.status_code == 200, answer.text


def pushed_in_two_goes(service):
    session_id = service.create(kind="push")
    for first in (0, 10):
        service.start(session_id)
        pushed(service, session_id, range(first, first + 10), 40)
        if first == 0:
            act(service, session_id, "stop")
    pushed(service, session_id, (3, 4), 40)
    address = f"/api/v1/sessions/{session_id}/points?limit=10000"
    wait_for(lambda: service.client.get(address).json()["total"] == 800, "the points to be judged")
    service.wait_until_kept(session_id)
    ledger = service.client.get(f"/api/v1/sessions/{session_id}/ledger").json()
    return session_id, ledger, service.client.get(address).json()


def pushed_at_length(service):
    session_id = service.create(kind="push")
    service.start(session_id)
    for first in range(0, 600, 100):
        pushed(service, session_id, range(first, first + 100), 200)
    return session_id


def withdrawn(service):
    session_id = service.create(kind="push")
    service.start(session_id)
    lines = [
        {
            "pass_index": number,
            "line_index": 10 * number + i,
            "points_mm": [[0.15 * k, 0.2 * i, 0.1 * number] for k in range(30)],
            "laser_mm": [2.0, 0.2 * i, 100.0],
            "line_spacing_mm": 0.2,
        }
        for number in range(2)
        for i in range(10)
    ]
    session = f"/api/v1/sessions/{session_id}"
    service.client.post(f"{session}/scanlines", json={"lines": lines})
    second = {"device_id": "client", "boot_id": 0, "pass_index": 1}
    assert service.client.post(f"{session}/passes/withdraw", json=second).json()["withdrawn_points"] == 300
    again = service.client.post(f"{session}/passes/withdraw", json=second).json()
    assert (again["withdrawn_points"], again["points"]) == (0, 300)
    assert again["losses"]["points"]["left_out"] == {"withdrawn": 300}
    service.client.post(f"{session}/stop")
    before = service.client.get(f"{session}/summary").json()
    assert (before["points"], before["points_counted"]) == (600, 300)
    assert len(service.client.get(f"{session}/scanlines").json()["scanlines"]) == 20
    return session, before


def scanned_to_the_end_and_half(service, simulators):
    """A scan that is over and one in its middle, whose account is in the record."""

    def simulated(part):
        simulator = RunningSimulator(part)
        simulators.callback(simulator.end)
        return simulator

    step = simulated("step")
    whole_id = service.create(**device(step, end_mm=step.ready["travel_mm"][1]))
    service.client.patch(f"/api/v1/sessions/{whole_id}", json={"notes": "fixture 7", "name": "step"})
    service.start(whole_id)
    over = service.wait_for_state(whole_id, "stopped")
    regions = service.client.get(f"/api/v1/sessions/{whole_id}/regions").json()["regions"]
    half_id = service.create(**device(simulated("plate")))
    service.start(half_id)
    wait_for(lambda: (service.status(half_id)["losses"]["passes"] or [{"lines": {"stored": 0}}])[0]["lines"]["stored"]
             > 20, "some lines")  # fmt: skip
    wait_for(lambda: service.kept_account(half_id).get("elapsed_s", 0) > 0, "an account in the record")
    return whole_id, over, regions, half_id


@pytest.fixture(scope="module")
def restarted(tmp_path_factory):
    """A service that was killed and started again, and what its sessions told before: one restart for several tests."""
    data = tmp_path_factory.mktemp("restarted") / "data"
    with contextlib.ExitStack() as simulators, contextlib.ExitStack() as services:
        first = RunningService(data)
        services.callback(first.end)
        told = {each.__name__: each(first) for each in (created_twice, withdrawn, pushed_in_two_goes, pushed_at_length)}
        told["scanned"] = scanned_to_the_end_and_half(first, simulators)
        first.kill()
        again = RunningService(data)
        services.callback(again.end)
        yield again, told


def test_a_killed_scan_is_reopened_with_its_ledger_its_notes_and_the_same_verdict(restarted):
    service, told_before = restarted
    session_id, over, regions, killed_id = told_before["scanned"]
    told = service.client.post(f"/api/v1/sessions/{session_id}/open")
    assert told.status_code == 202
    wait_for(
        lambda: service.client.get(f"/api/v1/sessions/{session_id}/open").json()["is_open"], "the session to be open"
    )
    again = service.status(session_id)
    assert (again["notes"], again["name"], again["lines"]) == ("fixture 7", "step", over["lines"])
    assert again["losses"]["passes"] == over["losses"]["passes"]
    assert again["losses"]["device"] == over["losses"]["device"]
    assert again["points_per_s"] == pytest.approx(over["points_per_s"], rel=0.2)
    assert again["calibration"]["scanner"]["device_id"] == "SIM-0001"
    assert service.client.get(f"/api/v1/sessions/{session_id}/regions").json()["regions"] == regions
    killed = service.status(killed_id)
    sent, stored, lost = account_of(killed)
    assert stored == killed["lines"] > 20
    assert sent == stored + lost
    assert killed["points_per_s"] > 0
    assert service.client.post(f"/api/v1/sessions/{'0' * 14}/open").status_code == 404


def test_a_creation_that_is_sent_again_makes_no_second_session_also_after_a_restart(restarted):
    service, told = restarted
    assert service.client.post("/api/v1/sessions", json=ONCE, headers=ITS_KEY).json()["id"] == told["created_twice"]
    listed = service.client.get("/api/v1/sessions").json()["sessions"]
    assert [session["name"] for session in listed].count("once") == 1
    too_long = service.client.post("/api/v1/sessions", json=ONCE, headers={"Idempotency-Key": "x" * 256})
    assert too_long.status_code == 422


def test_a_creation_that_is_sent_again_is_answered_when_its_file_is_gone(service, tmp_path):
    scan = service.data / "replay" / "scan.csv"
    scan.write_text("line,x_mm,y_mm,z_mm\n" + "".join(f"{n},{x},{n},0\n" for n in range(3) for x in range(5)))
    asked = {"name": "gone", "source": {"kind": "replay", "file": "scan.csv", "laser_mm": [2, 1, 90]}}
    key = {"Idempotency-Key": "once"}
    first = service.client.post("/api/v1/sessions", json=asked, headers=key)
    assert first.status_code == 201, first.text
    scan.unlink()
    again = service.client.post("/api/v1/sessions", json=asked, headers=key)
    assert (again.status_code, again.json()["id"]) == (201, first.json()["id"])
    assert service.client.post("/api/v1/sessions", json=asked).status_code == 422


def test_a_record_file_is_replayed_over_rest_with_its_own_settings_and_verdict(service, tmp_path):
    path = tmp_path / "made.sqlite"
    with Record.open(path) as record:
        book = SessionBook(record)
        lines = surface_scan(lambda x, y: 0.1 * x, lines=12)
        settings = SessionSettings(max_points=5000, noise_mm=0.02)
        made = book.create("made", PushSpec(), settings, (1.0, 2.0, 3.0), ReplaySource(lines, len(lines)))
        made.start()
        assert made.wait_until_over(60)
        verdict = verdict_sha256(made.results())
        book.close()
    shutil.copy(path, service.data / "replay" / "made.sqlite")
    (service.data / "replay" / "other.sqlite").write_bytes(b"SQLite format 3\0" + bytes(84))
    with contextlib.closing(sqlite3.connect(service.data / "replay" / "views.sqlite")) as views:
        shutil.copy(path, service.data / "replay" / "views.sqlite")
        views.executescript("ALTER TABLE lines RENAME TO hidden; CREATE VIEW lines AS SELECT * FROM hidden")
    session_id = service.create(kind="replay", file="made.sqlite")
    service.start(session_id)
    service.wait_for_state(session_id, "stopped")
    status = service.status(session_id)
    assert (status["lines"], status["origin_mm"]) == (12, [1.0, 2.0, 3.0])
    assert status["settings"] == settings.to_dict()
    told = service.client.get(f"/api/v1/sessions/{session_id}/summary")
    assert told.json()["verdict_sha256"] == verdict
    for source, why in (
        ({"file": "other.sqlite"}, "other.sqlite cannot be opened as a record"),
        ({"file": "views.sqlite"}, "views"),
        ({"file": "made.sqlite", "session": "nobody"}, "no session"),
        ({"file": "made.sqlite", "units": "mm"}, "leave them out"),
    ):
        refused = service.client.post("/api/v1/sessions", json={"source": {"kind": "replay", **source}})
        assert refused.status_code == 422 and why in refused.json()["detail"], refused.text
        assert str(service.data) not in refused.text
    refused = service.client.post(
        "/api/v1/sessions", json={"source": {"kind": "replay", "file": "made.sqlite"}, "origin_mm": [0, 0, 0]}
    )
    assert refused.status_code == 422 and "own settings" in refused.json()["detail"]


def test_a_file_is_brought_over_rest_played_and_removed(service):
    scan = b"line,x_mm,y_mm,z_mm,laser_x_mm,laser_y_mm,laser_z_mm\n"
    scan += b"".join(b"%d,%d,%d,0,2,%d,90\n" % (n, x, n, n) for n in range(4) for x in range(5))
    brought = service.client.put("/api/v1/files/my scan.csv", content=scan)
    assert (brought.status_code, brought.json()) == (
        201,
        {"name": "my scan.csv", "bytes": len(scan), "kind": "csv profiles"},
    )
    listed = service.client.get("/api/v1/files").json()["files"]
    others = [file for file in listed if file != brought.json()]
    assert len(others) == len(listed) - 1
    session_id = service.create(kind="replay", file="my scan.csv")
    service.start(session_id)
    service.wait_for_state(session_id, "stopped")
    assert service.status(session_id)["lines"] == 4
    refused = service.client.put("/api/v1/files/my scan.csv", content=scan + b"4,0,4,0,2,4,90\n")
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/name-taken")
    assert "another file" in refused.json()["detail"]
    assert service.client.put("/api/v1/files/x.bin", content=bytes(99)).status_code == 422
    assert service.client.put("/api/v1/files/..%2Fx.csv", content=scan).status_code in (400, 404, 422)
    assert service.client.delete("/api/v1/files/my scan.csv").status_code == 204
    assert service.client.delete("/api/v1/files/my scan.csv").status_code == 404
    assert service.client.get("/api/v1/files").json()["files"] == others
    assert service.status(session_id)["lines"] == 4


def test_a_command_that_fails_leaves_no_empty_folder(tmp_path):
    out = tmp_path / "a" / "b"
    done = CliRunner().invoke(app, ["export", "latest", "--record", str(tmp_path / "none.sqlite"), "--out", str(out)])
    assert done.exit_code == 1 and "there is no record" in done.output
    assert not any(tmp_path.iterdir())


def test_the_command_line_does_what_the_service_does(service, running):
    simulator = running.simulator("plate")
    session_id = service.create(**device(simulator))
    runner, where = CliRunner(), ["--data", str(service.data), "--url", service.url]

    def run(*arguments, **said):
        done = runner.invoke(app, ["sessions", *arguments, *where], **said)
        assert done.exit_code == 0, done.output
        return done.output

    run("start", session_id[:10])
    wait_for(lambda: service.status(session_id)["lines"] > 5, "some lines")
    assert run("pause", session_id).startswith("paused")
    assert run("resume", session_id).startswith("scanning")
    service.wait_for_state(session_id, "stopped")
    run("note", session_id, "a scratch at the edge")
    assert session_id in run("list")
    shown = json.loads(run("show", session_id, "--json"))
    assert (shown["notes"], shown["lines"]) == ("a scratch at the edge", 81)
    assert "SIM-0001" in run("show", session_id)
    kept = runner.invoke(app, ["sessions", "delete", session_id, *where], input="n\n")
    assert kept.exit_code == 1
    assert "81 lines" in kept.output
    run("delete", session_id, "--yes")
    gone = runner.invoke(app, ["sessions", "show", session_id, *where])
    assert gone.exit_code == 1
    assert "holds no session" in gone.output


def test_a_withdrawn_pass_stays_out_of_the_map_and_in_the_record(restarted):
    service, told = restarted
    session, before = told["withdrawn"]
    after = service.client.get(f"{session}/summary").json()
    assert (after["points_counted"], after["unreliable"]) == (300, before["unreliable"])


def test_points_and_ledger_are_the_same_after_push_stop_start_and_push_to_the_same_pass(restarted):
    service, told = restarted
    session_id, ledger, live = told["pushed_in_two_goes"]
    again = service.client.get(f"/api/v1/sessions/{session_id}/points?limit=10000").json()
    for name in set(live) - {"version"}:
        assert again[name] == live[name], name
    after = service.client.get(f"/api/v1/sessions/{session_id}/ledger").json()
    assert after["passes"] == ledger["passes"]
    assert after["lines"] == ledger["lines"]


def test_a_revoked_key_and_a_logout_end_the_streams_that_were_opened_with_them(tmp_path):
    from scanner_service.api.app import make_app
    from scanner_service.api.keys import Role
    from scanner_service.api.server import ServerThread
    from scanner_service.api.service import Service
    from scanner_service.sessions.readiness import warm_up
    from scanner_service.sessions.source_specs import PushSpec

    warm_up()  # nobody is refused once all is compiled
    service = Service.open(tmp_path)
    try:
        session = service.book.create("watched", PushSpec())
        keys = [service.access.create_key(Role.VIEWER, name) for name in ("gone", "kept")]
        with ServerThread(make_app(service)) as listening:
            url = f"{listening.url.replace('http', 'ws')}/api/v1/sessions/{session.row.session_id}/live"
            first, second = (
                websockets.sync.client.connect(url, additional_headers={"Authorization": f"Bearer {key}"})
                for key in keys
            )
            with first, second:
                for socket in (first, second):
                    assert json.loads(socket.recv(timeout=20))["type"] == "status"
                (stored,) = (key for key in service.access.keys if key.label == "gone")
                assert service.access.revoke_key(stored.key_id)
                with pytest.raises(websockets.exceptions.ConnectionClosed) as closed:
                    while True:
                        told = json.loads(first.recv(timeout=20))
                assert (told["type"], closed.value.rcvd.code) == ("error", 1008)
                told = [json.loads(second.recv(timeout=20))["type"] for _ in range(5)]
                assert "status" in told and "error" not in told
    finally:
        service.close()


def test_the_live_stream_tells_how_far_a_session_is_that_is_being_reopened(restarted):
    service, before = restarted
    session_id = before["pushed_at_length"]
    with live_client(service, session_id) as client:
        told = [json.loads(client.socket.recv(timeout=30))]
        while told[-1]["type"] != "status":
            told.append(json.loads(client.socket.recv(timeout=30)))
    opening = [message for message in told if message["type"] == "opening"]
    assert [message["lines"] for message in opening] == sorted(message["lines"] for message in opening)
    assert all(0 <= message["progress"] <= 1 and message["of"] == 600 for message in opening)
    rows = read_ply(service.client.get(f"/api/v1/sessions/{session_id}/export/points.ply").content)
    assert len(rows) == told[-1]["points"] == 600 * 200
