"""What a user asks for goes in over REST, is judged by, and comes out again; what cannot be meant is refused."""

import struct
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from scanner_service.api.app import make_app
from scanner_service.api.keys import read_local_key
from scanner_service.api.server import ServerThread
from scanner_service.api.service import Service
from tests.unit.rescan.test_reference import block


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("service")


@pytest.fixture(scope="module")
def client(folder: Path) -> Iterator[httpx.Client]:
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
