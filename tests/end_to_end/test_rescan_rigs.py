"""Recommended passes on the rig of a rig file: a native scanner that a Marlin stage carries."""

import contextlib
import json
import subprocess
import sys

import pytest

from simulators.pty_port import PtyPort
from tests.end_to_end.running import ROOT
from tests.end_to_end.stages import BAUD, new_device

RIG = """
name = "bench"
[scanner]
kind = "native"
port = "{scanner}"
baud_rate = 3000000
line_rate_hz = [1, 100]
[stage]
kind = "marlin"
port = "{stage}"
baud_rate = {baud}
travel_mm = [0, 45]
speed_mm_per_s = [0, 50]
[pairing]
by = "device"
"""


@pytest.fixture
def rig(running):
    """A service with a rig file, and both devices of the rig."""
    service, simulator = running.service(), running.simulator("plate")
    with contextlib.ExitStack() as stack:
        stage = stack.enter_context(PtyPort(new_device("marlin"), BAUD))
        (running.data / "rigs").mkdir(parents=True, exist_ok=True)
        text = RIG.format(scanner=simulator.port, stage=stage.path, baud=BAUD)
        (running.data / "rigs" / "bench.toml").write_text(text)
        yield service


def rescan(service, session_id, *arguments):
    command = [sys.executable, "-m", "scanner_service", "rescan", session_id, *arguments]
    return subprocess.run(
        [*command, "--data", str(service.data), "--url", service.url],
        capture_output=True, text=True, cwd=ROOT, timeout=500, check=False,
    )  # fmt: skip


@pytest.mark.long
def test_the_loop_drives_the_rig_of_a_rig_file(rig):
    service = rig
    body = {
        "name": "coarse",
        "source": {"kind": "rig", "rig": "bench.toml", "line_spacing_mm": 0.8, "start_mm": 1.0, "end_mm": 21.0,
                   "home": True},
        "settings": {"density_per_mm2": 16.0},
    }  # fmt: skip
    answer = service.client.post("/api/v1/sessions", json=body)
    assert answer.status_code == 201, answer.text
    session_id = answer.json()["id"]
    service.start(session_id)
    before = service.wait_for_state(session_id, "stopped")
    listed = rescan(service, session_id)
    assert listed.returncode == 0, listed.stderr
    looped = rescan(service, session_id, "--auto", "--max-passes", "1", "--json")
    assert looped.returncode == 0, looped.stderr
    result = json.loads(looped.stdout)
    first = result["orders"][0]
    assert first["status"] == "done", first["message"]
    assert first["outcome"]["reached_mm2"] > 0.8 * first["outcome"]["promised_mm2"]
    assert service.status(session_id)["lines"] > before["lines"]
