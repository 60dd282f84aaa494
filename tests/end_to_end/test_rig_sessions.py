"""Rigs as a user scans with them, over a part whose shape is known: a plate with a step of 5 mm at y = 20 mm.

The part ends up where it is, whichever way its lines get their places, and every scanline of every pass is accounted
for, from the scanner to the record.
"""

import contextlib
import json

import numpy as np
import pytest
from plyfile import PlyData
from typer.testing import CliRunner

from scanner_service.cli import app
from simulators.known import KNOWN_DEVICES, PassingPart
from simulators.parts import PARTS
from simulators.process import simulated_device
from simulators.pty_port import PtyPort

STEP_AT_MM, STEP_MM = 20.0, 5.0

ENCODER = """
[scanner]
kind = "native"
port = "{port}"
baud_rate = 3000000
line_rate_hz = [1, 100]
[stage]
kind = "encoder"
travel_mm = [-5, 60]
speed_mm_per_s = [0, 40]
"""
CONVEYOR = """
[scanner]
kind = "scip"
port = "{port}"
field_of_view_mm = [-60, 60]
options = {{ from_deg = -15, to_deg = 15 }}
[stage]
kind = "constant_speed"
speed_mm_per_s = [10, 10]
[mounting]
stage_from_sensor = {{ translation_mm = [0, 0, 150] }}
[pairing]
by = "{by}"
latency_ms = 60
"""


def scan(rig, out, *options):
    """Scan with a rig file; the summary, and the points (n, 3) of points.ply."""
    given = ["scan", rig, *options, "--out", out, "--json"]
    result = CliRunner().invoke(app, [str(argument) for argument in given])
    assert result.exit_code == 0, result.stderr
    vertices = PlyData.read(out / "points.ply")["vertex"]
    return json.loads(result.stdout), np.column_stack([vertices["x"], vertices["y"], vertices["z"]])


def assert_all_accounted(summary):
    """Sent = stored + lost on every pass, nothing under way any more, and what is stored is what the map holds."""
    passes = summary["losses"]["passes"]
    assert passes
    for account in passes:
        lines, chunks = account["lines"], account["chunks"]
        assert lines["under_way"] == 0
        assert lines["sent"] == lines["stored"] + sum(lines["lost"].values())
        assert lines["stored"] == lines["whole"] + lines["partial"]
        assert chunks["sent"] == chunks["stored"] + sum(chunks["lost"].values())
    assert sum(account["lines"]["stored"] for account in passes) == summary["scanlines"]
    on_the_wire = summary["losses"]["device"]["lines"]
    assert sum(account["lines"]["sent"] for account in passes) == on_the_wire["sent"]
    return passes


@pytest.mark.parametrize(("start", "end"), [(-1.0, 41.0), pytest.param(41.0, -1.0, marks=pytest.mark.long)])
def test_lines_that_an_encoder_places_show_the_step_where_it_is_forwards_and_backwards(tmp_path, start, end):
    device = simulated_device(PARTS["step"](), np.random.default_rng(5), device_id="ENC-1")
    with PtyPort(device, 3_000_000) as port:
        rig = tmp_path / "encoder.toml"
        rig.write_text(ENCODER.format(port=port.path))
        summary, points = scan(rig, tmp_path / "out", "--start", start, "--end", end, "--line-spacing", 0.4)
    (account,) = assert_all_accounted(summary)
    assert account["device_id"] == "ENC-1"
    assert account["lines"]["lost"] == {}
    assert account["lines"]["stored"] == 106  # 42 mm in steps of 0.4, both ends
    low = points[(points[:, 1] > 1.0) & (points[:, 1] < STEP_AT_MM - 0.4)]
    high = points[(points[:, 1] > STEP_AT_MM + 0.4) & (points[:, 1] < 39.0)]
    np.testing.assert_allclose(low[:, 2], 0.0, atol=0.15)
    np.testing.assert_allclose(high[:, 2], STEP_MM, atol=0.15)
    steps = np.diff(np.unique(np.round(points[:, 1], 4))) / 0.4
    np.testing.assert_allclose(steps, np.round(steps), atol=5e-3)
    assert (np.round(steps) > 1).sum() <= 1  # the step throws the camera's shadow: some lines see nothing there
    assert summary["losses"]["device"]["rig"]["median_step_mm"] == pytest.approx(np.sign(end - start) * 0.4, abs=1e-3)
    assert summary["losses"]["device"]["rig"]["reversed_steps"] == 0


@pytest.mark.parametrize("by", ["count", pytest.param("time", marks=pytest.mark.long)])
def test_a_lidar_over_a_conveyor_finds_the_step_within_a_line_or_two(tmp_path, by):
    known = KNOWN_DEVICES["scip"]
    device = known.makes(PassingPart(PARTS["step"](), 10.0, np.random.default_rng(6)))
    with contextlib.ExitStack() as stack:
        port = stack.enter_context(
            PtyPort(device, known.baud_rate, rng=np.random.default_rng(7), heeds_client_rate=True)
        )
        rig = tmp_path / "conveyor.toml"
        rig.write_text(CONVEYOR.format(port=port.path, by=by))
        options = ("--start", -1, "--end", 39, "--line-spacing", 1.0, "--speed", 10)
        summary, points = scan(rig, tmp_path / "out", *options)
    (account,) = assert_all_accounted(summary)
    # On a busy machine the lidar has no time for some scans, and the first ones come late: the ledger has them all.
    unseen = sum(n for reason, n in account["lines"]["lost"].items() if reason != "outside_pass")
    assert account["lines"]["stored"] + unseen >= 30
    middle = points[np.abs(points[:, 0]) < 12.0]
    rows = np.unique(np.round(middle[:, 1], 3))
    heights = np.array([np.median(middle[np.isclose(middle[:, 1], row, atol=2e-3), 2]) for row in rows])
    edge_mm = rows[heights > STEP_MM / 2].min()
    # A conveyor is at the start when the first line is measured; the simulated part was there a little earlier.
    assert abs(edge_mm - STEP_AT_MM) < 3.0 + unseen
    on_plate = rows[(rows > 2.0) & (rows < edge_mm - 1.0)]
    assert np.abs(heights[np.isin(rows, on_plate)]).max() < 1.0  # the lidar's noise is 1 mm, a median's is less
    rig_told = summary["losses"]["device"]["rig"]
    step_mm = rig_told["median_step_mm"]
    assert step_mm == pytest.approx(max(1, round(step_mm)), abs=1e-6 if by == "count" else 0.3)
    assert rig_told["nominal_spacing_mm"] == 1.0
