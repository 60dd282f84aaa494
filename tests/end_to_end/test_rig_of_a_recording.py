"""The rig of a recorded scan: the body that the documents show is one that the service takes, as it stands."""

import json
import re

import numpy as np

from scanner_service.api.pass_schemas import RIG_OF_A_RECORDING, RigIn
from tests.end_to_end.running import ROOT
from tests.unit.storage.ply_files import grid_file


def shown_body():
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
