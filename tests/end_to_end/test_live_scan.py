"""A scan from serial bytes to rescan regions: simulator process, pty, driver, service process, WebSocket."""

import contextlib
import io
import json
import struct
import subprocess
import sys
import time

import httpx
import numpy as np
import pytest
import websockets.exceptions
import websockets.sync.client

from tests.end_to_end.running import wait_for

HEADER = struct.Struct("<4sHHQQIIII")


def device(simulator, **changes):
    source = {"kind": "device", "port": simulator.port, "baud_rate": 3_000_000, "line_rate_hz": 60.0}
    return source | {"line_spacing_mm": 0.25, "start_mm": 2.0, "end_mm": 22.0} | changes


def read_ply(content):
    """The export, read by hand: header, then one packed row a vertex."""
    head, _, body = content.partition(b"end_header\n")
    types = {"double": "<f8", "float": "<f4", "int": "<i4", "uchar": "u1"}
    fields = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
    return np.frombuffer(body, dtype=[(name, types[kind]) for kind, name in fields])


@contextlib.contextmanager
def live_client(service, session_id):
    """A client of the live stream, closed with the block."""
    url = service.url.replace("http", "ws") + f"/api/v1/sessions/{session_id}/live"
    key = {"Authorization": f"Bearer {service.key}"}
    with websockets.sync.client.connect(url, additional_headers=key, compression=None) as socket:
        yield LiveClient(socket)


class LiveClient:
    """What a viewer does: grants credit, takes messages, keeps the newest state of every point."""

    def __init__(self, socket):
        self.socket = socket
        self.points = {}
        self.version = 0
        self.status = None
        self.regions = None
        self.credit = 0
        self.is_finished = False

    def listen(self, until):
        """Take messages until the condition holds."""

        def step():
            try:
                self._hear()
            except websockets.exceptions.ConnectionClosedOK as closed:
                assert closed.rcvd.code == 1000
                self.is_finished = True
                assert until(self), "the service said that everything was sent"
            return until(self)

        wait_for(step, "the live stream", seen=lambda: (self.status, self.credit, len(self.points), self.version))

    def _hear(self):
        if self.credit == 0:
            self.socket.send(json.dumps({"credit": 8}))
            self.credit = 8
        message = self.socket.recv(timeout=10)
        if isinstance(message, str):
            told = json.loads(message)
            assert told["type"] in ("status", "regions"), told
            setattr(self, told["type"], told)
        else:
            assert self.status is not None, "points came before the first status"
            self.credit -= 1
            self._take(message)

    def _take(self, message):
        magic, kind, flags, version, based_on, n, _skipped, total, _ = HEADER.unpack_from(message)
        assert (magic, kind) == (b"SLV1", 1)
        assert flags & 1 or based_on == self.version
        at = HEADER.size
        rows = np.frombuffer(message, "<u4", n, at)
        xyz = np.frombuffer(message, "<f4", 3 * n, at + 4 * n).reshape(n, 3)
        density = np.frombuffer(message, "<f4", n, at + 16 * n)
        state = np.frombuffer(message, "<u4", n, at + 32 * n)
        assert len(message) == at + 36 * n
        assert (rows < total).all()
        if flags & 1:
            self.points = {}
        self.points.update(
            zip(rows.tolist(), zip(xyz.tolist(), density.tolist(), state.tolist(), strict=True), strict=True)
        )
        self.version = version


def test_a_plate_is_scanned_streamed_and_found_good(service, running):
    simulator = running.simulator("plate")
    session_id = service.create(**device(simulator))
    with live_client(service, session_id) as client:
        service.start(session_id)
        client.listen(until=lambda c: c.is_finished)
    status = service.status(session_id)
    total = status["points"]
    assert (client.status["state"], client.status["points"], len(client.points)) == ("stopped", total, total)
    assert client.regions["regions"] == []
    assert all(state & 2 for _, _, state in client.points.values())

    losses = status["losses"]
    assert losses["device"]["lines"]["sent"] == status["lines"] == 81
    assert losses["lines"]["stored"] == 81
    assert losses["points"]["places"] == total + sum(losses["points"]["dropped"].values())
    assert status["durable"]["SIM-0001"]["lines"] == 81

    rows = read_ply(service.client.get(f"/api/v1/sessions/{session_id}/export/points.ply").content)
    assert len(rows) == total
    streamed = np.array([client.points[i][0] for i in range(total)])
    np.testing.assert_allclose(streamed, np.column_stack([rows["x"], rows["y"], rows["z"]]), atol=1e-5)
    np.testing.assert_allclose([client.points[i][1] for i in range(total)], rows["scalar_density"], rtol=1e-6)
    np.testing.assert_array_equal([client.points[i][2] & 1 for i in range(total)], rows["scalar_reliable"])
    assert rows["scalar_reliable"].mean() > 0.98
    assert (rows["nz"][rows["scalar_reliable"] == 1] > 0.99).all()
    assert service.client.get(f"/api/v1/sessions/{session_id}/regions").json()["regions"] == []
    coverage = service.client.get(f"/api/v1/sessions/{session_id}/density-map").json()
    assert coverage["share"] > 0.98
    picture = service.client.get(f"/api/v1/sessions/{session_id}/density-map.png")
    assert picture.content.startswith(b"\x89PNG")


def test_a_step_throws_a_shadow_that_becomes_a_region(service, running):
    simulator = running.simulator("step")
    session_id = service.create(**device(simulator, end_mm=simulator.ready["travel_mm"][1]))
    service.start(session_id)
    service.wait_for_state(session_id, "stopped")
    regions = service.client.get(f"/api/v1/sessions/{session_id}/regions").json()["regions"]
    assert "shadow" in {region["reason"] for region in regions}
    page = service.client.get(f"/api/v1/sessions/{session_id}/points", params={"start": 10, "limit": 5}).json()
    assert len(page["points_mm"]) == 5
    assert page["next"] == 15


def test_damage_on_the_wire_is_counted_and_balances(service, running):
    simulator = running.simulator("plate", "--bit-error-rate", "2e-6", "--byte-loss-rate", "2e-6", "--seed", 3)
    session_id = service.create(**device(simulator))
    service.start(session_id)
    status = service.wait_for_state(session_id, "stopped")
    wire = status["losses"]["device"]
    chunks, lines = wire["chunks"], wire["lines"]
    assert sum(chunks["lost"].values()) > 0
    assert chunks["sent"] == chunks["stored"] + sum(chunks["lost"].values())
    assert lines["sent"] == lines["whole"] + lines["partial"] + sum(lines["lost"].values())
    assert lines["whole"] + lines["partial"] == status["losses"]["lines"]["stored"]
    assert status["losses"]["points"]["dropped"]["missing"] > 0


def test_a_pulled_cable_pauses_the_scan_and_its_return_resumes_it(service, running, tmp_path):
    link = tmp_path / "scanner-port"
    simulator = running.simulator("plate", "--link", link)
    session_id = service.create(**device(simulator, port=str(link), rearm=True))
    service.start(session_id)
    wait_for(lambda: service.status(session_id)["lines"] > 10, "some lines")
    simulator.tell("unplug")
    paused = service.wait_for_state(session_id, "paused")
    assert "waiting for it to return" in paused["message"]
    simulator.tell("replug")
    status = service.wait_for_state(session_id, "stopped")
    wire = status["losses"]["device"]["lines"]
    assert wire["sent"] == wire["whole"] + wire["partial"] + sum(wire["lost"].values())
    events = service.client.get(f"/api/v1/sessions/{session_id}/events").json()["events"]
    first, *others = [event["kind"] for event in events][:3]
    assert first == "interrupted"
    assert sorted(others) == ["reconnected", "resumed"], "the first line may be told before or after the link"


def test_a_scan_that_is_started_long_after_its_session_was_created_is_no_lost_scanner(service, running):
    simulator = running.simulator("plate")
    session_id = service.create(**device(simulator))
    time.sleep(1.5)  # longer than the driver takes a silence for a lost link
    service.start(session_id)
    assert service.status(session_id)["state"] == "scanning"
    status = service.wait_for_state(session_id, "stopped")
    assert "gone" not in (status["message"] or "")  # a busy machine may lose lines, and says so
    events = service.client.get(f"/api/v1/sessions/{session_id}/events").json()["events"]
    assert "interrupted" not in {event["kind"] for event in events}


def test_a_session_survives_kill_9_with_everything_that_was_acknowledged(running):
    service, simulator = running.service(), running.simulator("plate")
    session_id = service.create(**device(simulator))
    service.start(session_id)
    wait_for(lambda: service.status(session_id)["lines"] > 20, "some lines")
    acknowledged = service.status(session_id)["durable"]["SIM-0001"]
    service.kill()

    service = running.service()
    listed = service.client.get("/api/v1/sessions").json()["sessions"]
    assert [(item["id"], item["state"]) for item in listed] == [(session_id, "interrupted")]
    status = service.status(session_id)
    assert status["lines"] >= acknowledged["lines"]
    assert status["durable"]["SIM-0001"]["line_index"] >= acknowledged["line_index"]
    rows = read_ply(service.client.get(f"/api/v1/sessions/{session_id}/export/points.ply").content)
    assert len(rows) == status["points"] == listed[0]["points"]
    with live_client(service, session_id) as client:
        client.listen(until=lambda c: c.is_finished)
    assert (client.status["state"], len(client.points)) == ("interrupted", len(rows))
    assert client.regions is not None
    first = service.client.get(f"/api/v1/sessions/{session_id}/scanlines", params={"limit": 1}).json()["scanlines"][0]
    np.testing.assert_array_equal(
        first["points_mm"], np.column_stack([rows["x"], rows["y"], rows["z"]])[: len(first["index"])]
    )


def test_a_source_that_cannot_be_used_is_refused_in_one_sentence(service, running):
    simulator = running.simulator("plate")
    before = service.client.get("/api/v1/sessions").json()["sessions"]
    for source, status, told in (
        ({"port": "/dev/ttyUSB99"}, 404, "/dev/ttyUSB99"),
        ({"port": "/etc/passwd"}, 422, "not a serial device"),
        ({"port": "socket://127.0.0.1:1"}, 422, "not a serial device"),
        ({"line_spacing_mm": 0.0}, 422, "greater than 0"),
        ({"start_mm": 1.0, "end_mm": 1.0}, 422, "has no length"),
    ):
        answer = service.client.post("/api/v1/sessions", json={"source": device(simulator, **source)})
        assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json")
        assert told in answer.text
    assert service.client.get("/api/v1/sessions").json()["sessions"] == before


def test_a_port_in_use_is_refused_by_the_session_that_holds_it_and_a_pass_that_cannot_be_lets_go_of_it(
    service, running
):
    simulator = running.simulator("plate")
    first = service.create(**device(simulator, end_mm=4000.0))  # only the scanner knows how far its stage goes
    answer = service.client.post("/api/v1/sessions", json={"source": device(simulator)})
    assert answer.status_code == 409
    assert f"{simulator.port} is held by session {first}" in answer.json()["detail"]
    refused = service.client.post(f"/api/v1/sessions/{first}/start")
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/pass-refused")
    assert "check line spacing, travel and line rate" in refused.json()["detail"]
    assert service.status(first)["state"] == "failed"
    service.create(**device(simulator))


def test_a_session_that_was_never_started_lets_go_of_its_port(service, running):
    simulator = running.simulator("plate")
    session_id = service.create(**device(simulator))
    service.client.post(f"/api/v1/sessions/{session_id}/stop")
    again = service.create(**device(simulator))
    refused = service.client.delete(f"/api/v1/sessions/{again}")
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/not-confirmed")
    assert service.client.delete(f"/api/v1/sessions/{again}", params={"confirm": again}).status_code == 204
    service.create(**device(simulator))


@pytest.mark.parametrize("request_", [b"{}", "[" * 1024, '{"credit": 0}'])
def test_a_request_that_is_not_understood_ends_the_stream_and_says_so(service, request_):
    session_id = service.create(kind="push")
    with live_client(service, session_id) as client:
        client.socket.send(request_)
        with pytest.raises(websockets.exceptions.ConnectionClosed) as closed:
            while True:
                told = client.socket.recv(timeout=10)
    assert closed.value.rcvd.code == 1008
    assert json.loads(told)["type"] == "error"


def test_numbers_beyond_the_record_are_refused_and_no_fault(service):
    session_id = service.create(kind="push")
    answer = service.client.get(f"/api/v1/sessions/{session_id}/events", params={"after": 10**20})
    assert answer.status_code == 422


def test_pushed_scanlines_are_answered_when_durable_and_stored_once(service):
    session_id = service.create(kind="push")
    service.start(session_id)
    lines = [
        {
            "line_index": i,
            "points_mm": [[0.15 * k, 0.2 * i, 0.0] if k % 7 else None for k in range(40)],
            "laser_mm": [3.0, 0.2 * i, 100.0],
            "plane_normal": [0, 1, 0],
            "travel": [0, 1, 0],
            "line_spacing_mm": 0.2,
        }
        for i in range(20)
    ]
    url = f"/api/v1/sessions/{session_id}/scanlines"
    first = service.client.post(url, json={"lines": lines})
    assert {line["outcome"] for line in first.json()["lines"]} == {"stored"}
    again = service.client.post(url, json={"lines": lines[:3]})
    assert (again.status_code, {line["outcome"] for line in again.json()["lines"]}) == (200, {"duplicate"})
    other = service.client.post(url, json={"lines": [lines[0] | {"points_mm": lines[1]["points_mm"]}]})
    assert (other.status_code, other.json()["lines"][0]["outcome"]) == (409, "conflict")
    status = service.client.post(f"/api/v1/sessions/{session_id}/stop").json()
    assert (status["state"], status["lines"], status["points"]) == ("stopped", 20, 20 * 34)
    with live_client(service, session_id) as client:  # more may be pushed later: the stream stays open
        client.listen(until=lambda c: len(c.points) == 20 * 34 and c.regions)
        service.start(session_id)
        service.client.post(url, json={"lines": [lines[0] | {"line_index": 20}]})
        client.listen(until=lambda c: c.status["state"] == "scanning" and len(c.points) == 21 * 34)
    status = service.client.post(f"/api/v1/sessions/{session_id}/stop").json()
    assert status["losses"]["points"]["dropped"] == {"dropout": 21 * 6}
    summary = service.client.get(f"/api/v1/sessions/{session_id}/summary").json()
    assert summary["scanlines"] == 21
    bad = service.client.post(url, content=json.dumps({"lines": [lines[0] | {"line_spacing_mm": -1}]}))
    assert bad.status_code in (415, 422)
    nan = io.BytesIO(b'{"lines": [{"line_index": NaN}]}').read()
    refused = service.client.post(url, content=nan, headers={"content-type": "application/json"})
    assert refused.status_code == 400
    assert service.client.post(url, json={"lines": lines[:1]}).status_code == 409


def test_a_fresh_one_time_address_opens_the_viewer_once(service):
    command = [sys.executable, "-m", "scanner_service", "open", "--data", service.data, "--url", service.url, "--json"]
    told = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    address = json.loads(told.stdout)["viewer"]
    first = httpx.get(address)
    assert (first.status_code, first.headers["location"]) == (303, "/")
    assert "HttpOnly" in first.headers["set-cookie"]
    assert httpx.get(address).status_code == 401


def test_nothing_is_told_without_a_key(service):
    for path in ("/api/v1/sessions", "/metrics"):
        assert httpx.get(service.url + path).status_code == 401
    assert httpx.get(service.url + "/healthz").json() == {"status": "ok"}
    assert b"scanner_record_stored_lines" in service.client.get("/metrics").content
