"""What a user asks for goes in over REST, is judged by, and comes out again; what cannot be meant is refused."""

import struct
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from scanner_service.api.app import make_app
from scanner_service.api.keys import read_local_key
from scanner_service.api.server import ServerThread
from scanner_service.api.service import Service
from scanner_service.sessions.readiness import warm_up
from tests.unit.rescan.test_reference import block


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("service")


@pytest.fixture(scope="module")
def client(folder: Path) -> Iterator[httpx.Client]:
    warm_up()  # nobody is refused once all is compiled
    service = Service.open(folder)
    try:
        with ServerThread(make_app(service)) as listening:
            key = {"Authorization": f"Bearer {read_local_key(folder)}"}
            with httpx.Client(base_url=listening.url, headers=key, trust_env=False, timeout=120) as http:
                yield http
    finally:
        service.close()


def _write_stl(path: Path, corners: np.ndarray) -> None:
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *triangle.ravel(), 0) for triangle in corners)
    path.write_bytes(b"\0" * 80 + struct.pack("<I", len(corners)) + rows)


def _line(number: int) -> dict:
    x, y = np.arange(0.05, 8.0, 0.15), 0.05 + 0.2 * number
    return {
        "line_index": number,
        "points_mm": [[float(at), y, 0.0] for at in x],
        "laser_mm": [4.0, y, 150.0],
        "plane_normal": [0.0, 1.0, 0.0],
        "travel": [0.0, 1.0, 0.0],
        "position_mm": y,
        "line_spacing_mm": 0.2,
    }


def test_a_scan_is_judged_by_what_was_asked_for_and_measured_against_the_nominal_part(
    client: httpx.Client, folder: Path
) -> None:
    _write_stl(folder / "replay" / "nominal.stl", block())
    assert set(client.get("/api/v1/sessions/presets").json()["presets"]) >= {"standard", "inspection"}
    top = {"low_mm": [-1.0, -1.0, -0.05], "high_mm": [9.0, 9.0, 1.0]}
    settings = {
        "requirement": {"preset": "standard", "line_spacing_mm": 0.1, "interest": top},
        "reference": {"file": "nominal.stl"},
    }
    made = client.post("/api/v1/sessions", json={"source": {"kind": "push"}, "settings": settings})
    assert made.status_code == 201, made.text
    assert made.json()["settings"]["reference"]["sha256"]
    path = f"/api/v1/sessions/{made.json()['id']}"
    client.post(f"{path}/start")
    lines = [_line(number) for number in range(20)]  # half of the top
    assert client.post(f"{path}/scanlines", json={"lines": lines}).status_code == 200
    client.post(f"{path}/stop")
    found = client.get(f"{path}/regions").json()
    assert found["requirement"]["line_spacing_mm"] == 0.1
    assert {region["reason"] for region in found["regions"]} == {"sparse", "untouched"}
    assert all(region["id"] and region["status"] == "open" and region["history"] for region in found["regions"])
    coverage = client.get(f"{path}/coverage").json()
    assert coverage["kind"] == "reference" and coverage["required"] == 0.95 and coverage["holds"] is False
    assert coverage["reference"]["touched_mm2"] == pytest.approx(0.5 * coverage["reference"]["area_mm2"], rel=0.2)
    events = client.get(f"{path}/events").json()["events"]
    assert "regions_followed" in {event["kind"] for event in events}


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"requirement": {"preset": "best"}}, "presets are"),
        ({"requirement": {"chord_error_mm": 0.01, "noise_mm": 0.02}}, "chord error"),
        ({"requirement": {"noise_mm": 0.005}}, "own noise"),
        ({"density_per_mm2": 3.0, "requirement": {"density_per_mm2": 4.0}}, "twice"),
        ({"reference": {"file": "absent.stl"}}, "no file absent.stl"),
        ({"reference": {"file": "open.stl"}}, "watertight"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_the_reason(
    client: httpx.Client, folder: Path, settings: dict, says: str
) -> None:
    _write_stl(folder / "replay" / "open.stl", block()[2:])
    before = client.get("/api/v1/sessions").json()
    answer = client.post("/api/v1/sessions", json={"source": {"kind": "push"}, "settings": settings})
    assert answer.status_code == 422, answer.text
    assert says in answer.json()["detail"]
    assert client.get("/api/v1/sessions").json() == before


@pytest.fixture(scope="module")
def scanned(client: httpx.Client) -> str:
    """The address of a session that was scanned with 0.2 mm between its lines, and is over."""
    made = client.post("/api/v1/sessions", json={"source": {"kind": "push"}})
    path = f"/api/v1/sessions/{made.json()['id']}"
    client.post(f"{path}/start")
    assert client.post(f"{path}/scanlines", json={"lines": [_line(n) for n in range(12)]}).status_code == 200
    assert client.post(f"{path}/stop").json()["requirement"]["coverage_share"] is None
    return path


def test_what_is_asked_for_may_change_after_the_scan_and_everything_is_judged_anew(
    client: httpx.Client, scanned: str
) -> None:
    assert client.get(f"{scanned}/regions").json()["regions"] == []
    asked = {"density_per_mm2": 60.0, "coverage_share": 0.9}
    answered = client.put(f"{scanned}/requirement", json=asked)
    assert answered.status_code == 200, answered.text
    assert answered.json()["holds"] is False and answered.json()["coverage"] < 0.9
    assert {name: answered.json()["requirement"][name] for name in asked} == asked
    sparse = client.get(f"{scanned}/regions").json()
    assert {(one["reason"], one["required_per_mm2"]) for one in sparse["regions"]} == {("sparse", 60.0)}
    told = answered.json()["requirement"]
    assert client.put(f"{scanned}/requirement", json=told).json()["requirement"] == told, "what is told asks for itself"

    loose = client.put(f"{scanned}/requirement", json={"preset": "standard"}).json()
    assert (loose["requirement"]["preset"], loose["holds"]) == ("standard", True)
    assert client.get(f"{scanned}/regions").json()["regions"] == []
    status = client.get(scanned).json()
    assert (status["requirement"], status["holds"]) == (loose["requirement"], True)
    deadline = time.monotonic() + 120.0
    while True:  # events are written behind the answer
        kinds = [event["kind"] for event in client.get(f"{scanned}/events").json()["events"]]
        if kinds[-1] == "regions_followed" or time.monotonic() > deadline:
            break
        time.sleep(0.05)
    assert kinds.count("requirement_changed") == 3
    assert kinds[-1] == "regions_followed", "what a later opening goes on with is of the new verdict"


def test_a_nominal_part_is_brought_and_measured_against_after_the_scan(
    client: httpx.Client, folder: Path, scanned: str
) -> None:
    _write_stl(folder / "brought.stl", block())
    content = (folder / "brought.stl").read_bytes()
    kept = client.put("/api/v1/files/brought.stl", content=content)
    assert (kept.status_code, kept.json()["kind"]) == (201, "mesh"), kept.text
    for name, odd in (("cut.stl", content[:-20]), ("noise.obj", bytes(range(256)))):
        refused = client.put(f"/api/v1/files/{name}", content=odd)
        assert refused.status_code == 422 and name in refused.json()["detail"], refused.text
    _write_stl(folder / "open.stl", block()[2:])
    refused = client.put("/api/v1/files/open.stl", content=(folder / "open.stl").read_bytes())
    assert refused.status_code == 422 and "watertight" in refused.json()["detail"]

    before = client.get(f"{scanned}/requirement").json()
    measured = client.put(f"{scanned}/reference", json={"file": "brought.stl"}).json()
    assert (measured["coverage_kind"], measured["reference"]["file"]) == ("reference", "brought.stl")
    assert 0 < measured["coverage"] < before["coverage"], "most of the block was never scanned"
    assert "untouched" in {one["reason"] for one in client.get(f"{scanned}/regions").json()["regions"]}
    assert client.put(f"{scanned}/reference", json={"file": "absent.stl"}).status_code == 422
    assert client.delete(f"{scanned}/reference").json() == before


def test_a_refused_requirement_names_its_fields_and_leaves_what_was_asked_for(
    client: httpx.Client, scanned: str
) -> None:
    before = client.get(f"{scanned}/requirement").json()
    for asked, fields in (
        ({"noise_mm": 0.005}, ["noise_mm"]),
        ({"chord_error_mm": 0.02, "noise_mm": 0.03}, ["chord_error_mm", "noise_mm"]),
        ({"line_spacing_mm": 0.04}, ["line_spacing_mm", "finest_line_spacing_mm"]),
        ({"preset": "best"}, ["preset"]),
        ({"interest": {"low_mm": [0, 0, 0], "high_mm": [1, 0, 1]}}, ["interest"]),
    ):
        refused = client.put(f"{scanned}/requirement", json=asked)
        assert (refused.status_code, refused.json()["fields"]) == (422, fields), refused.text
    refused = client.put(f"{scanned}/requirement", json={"density_per_mm2": 0})
    assert (refused.status_code, refused.json()["errors"][0]["at"]) == (422, "body.density_per_mm2")
    assert client.get(f"{scanned}/requirement").json() == before


@pytest.mark.parametrize("settings", [{"density_per_mm2": 7.0}, {"requirement": {"density_per_mm2": 7.0}}])
def test_a_density_is_told_in_one_place_wherever_it_was_asked_for(client: httpx.Client, settings: dict) -> None:
    made = client.post("/api/v1/sessions", json={"source": {"kind": "push"}, "settings": settings}).json()
    assert made["requirement"]["density_per_mm2"] == made["settings"]["target"]["density_per_mm2"] == 7.0
    assert "density_per_mm2" not in made["settings"]
