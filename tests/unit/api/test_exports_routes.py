"""Exports over the network: ordered, watched, fetched, taken back; by whom, and what is refused."""

import hashlib
import time

import httpx
import pytest

from scanner_service.api.app import make_app
from scanner_service.api.keys import Role
from scanner_service.api.server import ServerThread
from scanner_service.api.service import Service
from scanner_service.sessions.exporting import FORMATS
from scanner_service.sessions.readiness import warm_up
from scanner_service.sessions.replay_source import ReplaySource
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import PushSpec
from tests.unit.analysis.scans import surface_scan


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """A service with one finished session: its address, keys by role, and the session's id."""
    warm_up()  # nobody is refused once all is compiled
    service = Service.open(tmp_path_factory.mktemp("data"))
    lines = surface_scan(lambda x, y: 0.0 * x, lines=12)
    session = service.book.create(
        "plate", PushSpec(), SessionSettings(max_points=20_000), source=ReplaySource(lines, 12)
    )
    session.start()
    assert session.wait_until_over(60)
    keys = {role: service.access.create_key(role, role.name) for role in Role}
    with ServerThread(make_app(service)) as listening:
        yield listening.url, keys, session.row.session_id
    service.close()


@pytest.fixture
def clients(served):
    """A client for each role."""
    url, keys, _ = served
    made = {
        role: httpx.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=60, trust_env=False)
        for role, key in keys.items()
    }
    yield made
    for client in made.values():
        client.close()


@pytest.fixture
def path(served):
    return f"/api/v1/sessions/{served[2]}/exports"


def finished(client, url):
    """The answer for an export once it is done or failed."""
    while (said := client.get(url).json())["state"] in ("waiting", "writing"):
        assert 0 <= said["share"] <= 1
        time.sleep(0.05)
    return said


def test_an_export_is_ordered_watched_fetched_and_taken_back(clients, path):
    operator, viewer = clients[Role.OPERATOR], clients[Role.VIEWER]
    ordered = operator.post(path, json={"formats": ["csv", "ply", "record", "report"]})
    assert ordered.status_code == 202
    said = finished(viewer, ordered.headers["location"])
    assert (said["state"], said["failure"]) == ("done", None)
    names = [file["name"] for file in said["files"]]
    assert set(names) == {"points.csv", "points.ply", "session.sqlite", "report.html", "report.pdf", "manifest.json"}
    for file in said["files"]:
        got = viewer.get(file["url"])
        assert got.status_code == 200
        assert got.headers["content-disposition"].startswith("attachment")
        if "sha256" in file:
            assert hashlib.sha256(got.content).hexdigest() == file["sha256"]
            assert len(got.content) == file["bytes"]
    assert [job["id"] for job in viewer.get(path).json()["exports"]] == [said["id"]]
    assert operator.delete(f"{path}/{said['id']}").status_code == 204
    assert viewer.get(f"{path}/{said['id']}").status_code == 404
    assert viewer.get(said["files"][0]["url"]).status_code == 404


def test_the_formats_are_told_with_what_is_missing(clients, path):
    formats = clients[Role.VIEWER].get(path).json()["formats"]
    assert [one["name"] for one in formats] == list(FORMATS)
    for one in formats:
        assert one["available"] == (one["why_not"] is None)
        assert one["what"]


def test_a_viewer_may_not_order_or_take_back(clients, path):
    assert clients[Role.VIEWER].post(path, json={"formats": ["ply"]}).status_code == 403
    assert clients[Role.VIEWER].delete(f"{path}/abc").status_code == 403


@pytest.mark.parametrize(
    ("body", "status"),
    [({"formats": ["obj"]}, 422), ({"formats": []}, 422), ({}, 422), ({"formats": ["ply"] * 99}, 422), ([], 422)],
)
def test_orders_that_cannot_be_meant_are_refused(clients, path, body, status):
    refused = clients[Role.OPERATOR].post(path, json=body)
    assert refused.status_code == status
    assert refused.headers["content-type"] == "application/problem+json"


def test_what_is_not_there_is_404(clients, served, path):
    admin = clients[Role.ADMIN]
    assert admin.post("/api/v1/sessions/none/exports", json={"formats": ["ply"]}).status_code == 404
    assert admin.get(f"{path}/none").status_code == 404
    job = admin.post(path, json={"formats": ["results"]}).json()
    said = finished(admin, f"{path}/{job['id']}")
    for name in ("points.ply", "%2e%2e%2fmanifest.json", "manifest.json%00"):
        assert admin.get(f"{path}/{said['id']}/files/{name}").status_code in (400, 404)
    other = f"/api/v1/sessions/other/exports/{said['id']}"
    assert admin.get(other).status_code == 404


def test_a_library_that_is_not_installed_is_told_as_such(clients, path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pye57", None)
    refused = clients[Role.OPERATOR].post(path, json={"formats": ["e57"]})
    assert refused.status_code == 501
    assert "pip install -e '.[e57]'" in refused.json()["detail"]
