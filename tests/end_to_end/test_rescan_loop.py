"""The closed loop for real: simulator process, pty, service, and `scanner rescan --auto` beside it."""

import json
import re
import subprocess
import sys

import numpy as np

from scanner_service.api.pass_schemas import RIG_OF_A_RECORDING, RigIn
from tests.end_to_end.running import ROOT
from tests.unit.storage.ply_files import grid_file


def rescan(service, session_id, *arguments):
    command = [sys.executable, "-m", "scanner_service", "rescan", session_id, *arguments, "--json"]
    return subprocess.run(
        [*command, "--data", str(service.data), "--url", service.url],
        capture_output=True, text=True, cwd=ROOT, timeout=500, check=False,
    )  # fmt: skip


def test_a_coarse_scan_is_mended_by_the_loop_and_every_step_is_in_the_record(running, service, tmp_path):
    simulator = running.simulator()
    body = {
        "name": "coarse",
        "source": {"kind": "device", "port": simulator.port, "baud_rate": 3_000_000, "line_rate_hz": 100.0,
                   "line_spacing_mm": 0.8, "start_mm": 0.0, "end_mm": 20.0},
        "settings": {"density_per_mm2": 16.0},
    }  # fmt: skip
    answer = service.client.post("/api/v1/sessions", json=body)
    session_id = answer.json()["id"]
    service.start(session_id)
    before = service.wait_for_state(session_id, "stopped")["coverage"]
    listed = rescan(service, session_id)
    assert listed.returncode == 0, listed.stderr
    assert json.loads(listed.stdout)["passes"][0]["line_spacing_mm"] < 0.8
    assert listed.stderr.startswith("planning passes …\n")  # which may take its time on a busy machine
    looped = rescan(service, session_id, "--auto", "--max-passes", "1")
    assert looped.returncode == 0, looped.stderr
    assert looped.stderr.startswith("planning passes …\n")
    result = json.loads(looped.stdout)
    assert result["loop"]["why_ended"]
    first = result["orders"][0]
    assert first["status"] == "done", first["message"]
    assert first["reached_end"] is True
    assert first["outcome"]["reached_mm2"] > 0.8 * first["outcome"]["promised_mm2"]
    assert service.status(session_id)["coverage"] > before + 0.5
    events = service.client.get(f"/api/v1/sessions/{session_id}/events?limit=1000").json()["events"]
    told = [event["kind"] for event in events]
    assert told.index("pass_accepted") < told.index("pass_started") < told.index("pass_outcome")
    assert told[-1] == "loop_ended"
    listed = service.client.get(f"/api/v1/sessions/{session_id}/regions").json()
    exported = subprocess.run(
        [sys.executable, "-m", "scanner_service", "export", session_id, "--data", str(service.data),
         "--format", "results", "--out", str(tmp_path)],
        capture_output=True, text=True, cwd=ROOT, timeout=300, check=False,
    )  # fmt: skip
    assert exported.returncode == 0, exported.stderr
    written = json.loads(next(tmp_path.rglob("regions.json")).read_text())
    for name in ("regions", "resolved"):
        assert written[name] == listed[name]
    refused = service.client.post(f"/api/v1/sessions/{session_id}/recommended-passes/99/accept")
    assert refused.status_code == 422 and "which plan" in refused.json()["detail"]
    where = f"/api/v1/sessions/{session_id}/recommended-passes"
    seen = service.client.get(where).json()["plan"]
    outdated = service.client.post(f"{where}/1/accept", json={"plan": "1" + seen[1:] if seen[0] != "1" else "2"})
    assert (outdated.status_code, outdated.json()["type"]) == (409, "/problems/plan-overtaken")
    refused = service.client.post(f"{where}/99/accept", json={"plan": seen})
    assert (refused.status_code, refused.headers["content-type"]) == (404, "application/problem+json")
    unclear = service.client.put(f"/api/v1/sessions/{session_id}/rig", json={
        "axis": "free_pose", "scanner": {"laser_mm": [0, 0, 150], "camera_mm": [0, 76, 150], "range_mm": [-30, 30],
                                         "field_of_view_mm": 50, "points_per_line": 400}})  # fmt: skip
    assert unclear.status_code == 409 and "reach_low_mm" in unclear.json()["detail"]


def test_a_pass_of_a_part_that_must_be_turned_says_what_to_do_and_costs_no_order(running, service):
    simulator = running.simulator("step")
    body = {
        "name": "shadowed",
        "source": {"kind": "device", "port": simulator.port, "baud_rate": 3_000_000, "line_rate_hz": 100.0,
                   "line_spacing_mm": 0.5, "start_mm": 12.0, "end_mm": 32.0},
        "settings": {"density_per_mm2": 10.0},
    }  # fmt: skip
    session_id = service.client.post("/api/v1/sessions", json=body).json()["id"]
    service.start(session_id)
    service.wait_for_state(session_id, "stopped")
    plan = service.client.get(f"/api/v1/sessions/{session_id}/recommended-passes?reason=shadow").json()
    passes = plan["passes"]
    assert all(item["region"] for one in passes for item in one["serves"])
    turned = next(one for one in passes if one["turn_part"])
    refused = rescan(service, session_id, "--reason", "shadow", "--pass", str(turned["number"]), "--plan", plan["plan"])
    assert refused.returncode == 1 and "--turned" in refused.stderr
    orders = service.client.get(f"/api/v1/sessions/{session_id}/pass-orders").json()["orders"]
    assert [order["status"] for order in orders] == ["cancelled"]
    where = f"/api/v1/sessions/{session_id}"
    order = service.client.post(f"{where}/recommended-passes/{turned['number']}/accept?reason=shadow",
                                json={"plan": plan["plan"]}).json()["order"]  # fmt: skip
    begun = service.client.post(f"{where}/pass-orders/{order}/carry-out", json={"part_is_turned": False})
    assert (begun.status_code, begun.json()["type"]) == (409, "/problems/part-not-turned")
    assert '{"part_is_turned": true}' in begun.json()["detail"]
    told = service.client.get(f"{where}/pass-orders/{order}").json()
    assert (told["status"], told["message"]) == ("accepted", None)
    unknown = service.client.get(f"{where}/recommended-passes?region=4711")
    assert unknown.status_code == 404 and "no region 4711" in unknown.json()["detail"]


def shown_body():
    """The body with which the documents state the rig of a recorded scan."""
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    return re.search(r"/rig -d '(\{.*?\})'\n", text, re.DOTALL).group(1)


def test_the_body_that_is_shown_is_the_example_of_the_schema():
    assert json.loads(shown_body()) == RIG_OF_A_RECORDING
    assert RigIn.model_json_schema()["examples"] == [RIG_OF_A_RECORDING]


def test_passes_are_planned_for_a_recorded_scan_once_its_rig_is_stated_as_the_documents_show(service):
    y_mm, x_mm = np.meshgrid(np.arange(-6.0, 6.0, 0.25), np.arange(-8.0, 8.0, 0.25), indexing="ij")
    z_mm = np.where(np.abs(x_mm) < 2.0, 6.0, 0.0)  # a bar, of which nobody sees the sides from above
    points = np.column_stack([x_mm.ravel(), y_mm.ravel(), z_mm.ravel()])
    recorded = grid_file("ascii", points.tolist(), [[k] for k in range(len(points))], *x_mm.shape)
    brought = service.client.put("/api/v1/files/bar.ply", content=recorded)
    assert brought.status_code == 201, brought.text
    source = {
        "kind": "replay",
        "file": "bar.ply",
        "units": "mm",
        "laser_mm": [0.0, 0.0, 150.0],
        "line_spacing_mm": 0.25,
    }
    session_id = service.create(**source)
    where = f"/api/v1/sessions/{session_id}"
    service.start(session_id)
    service.wait_for_state(session_id, "stopped")
    unknown = service.client.get(f"{where}/recommended-passes")
    assert unknown.status_code == 409 and "PUT .../rig" in unknown.json()["detail"]
    stated = service.client.put(f"{where}/rig", content=shown_body(), headers={"Content-Type": "application/json"})
    assert stated.status_code == 200, stated.text
    plan = service.client.get(f"{where}/recommended-passes")
    assert plan.status_code == 200, plan.text
    assert plan.json()["plan"] and plan.json()["passes"]
