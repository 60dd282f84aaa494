"""A turntable rig over REST, end to end: lidar and controller on ptys, rig file, service, record, exported points."""

import io

import numpy as np
import pytest
from plyfile import PlyData

from tests.end_to_end.rig_bench import TURNTABLE, Devices
from tests.end_to_end.test_rigs_on_pty import PILLAR_OFF_MM, PILLAR_RADIUS_MM, SENSOR_AWAY_MM, pillar, stack

__all__ = ["stack"]  # the fixture

STOPS_MM = (-5.0, -17.5, -30.0)


def test_a_pillar_beside_the_axis_stands_where_it_is_after_a_pass_ordered_over_rest(stack, running):
    devices = Devices(
        stack,
        axis=TURNTABLE,
        mounting=f"translation_mm = [0, -{SENSOR_AWAY_MM}, 30], rotation_deg = [90, 90, 0]",
        scene=pillar,
    )
    (running.data / "rigs").mkdir(parents=True)
    (running.data / "rigs" / "turntable.toml").write_text(devices.rig_text)
    service = running.service()
    order = {"start_mm": STOPS_MM[0], "end_mm": STOPS_MM[-1], "line_spacing_mm": 12.5, "speed_mm_per_s": 0.0}
    beyond = service.client.post(
        "/api/v1/sessions",
        json={"name": "too far", "source": {"kind": "rig", "rig": "turntable.toml"} | order | {"end_mm": -101.0}},
    )
    assert 400 <= beyond.status_code < 500
    assert "-101" in beyond.text

    session = service.create(kind="rig", rig="turntable.toml", home=True, **order)
    service.start(session)
    status = service.wait_for_state(session, "stopped")
    assert status["lines"] == len(STOPS_MM)
    (account,) = status["losses"]["passes"]
    lines = account["lines"]
    assert lines["under_way"] == 0
    assert lines["sent"] == lines["stored"] + sum(lines["lost"].values())
    assert lines["stored"] == len(STOPS_MM)
    assert lines["lost"]["between_stops"] > 0
    rig = status["losses"]["device"]["rig"]
    assert rig["median_step_mm"] == pytest.approx(-12.5, abs=2e-3)
    assert not devices.lidar.laser_on

    exported = service.client.get(f"/api/v1/sessions/{session}/export/points.ply")
    assert exported.status_code == 200, exported.text
    vertices = PlyData.read(io.BytesIO(exported.content))["vertex"]
    points = np.column_stack([vertices["x"], vertices["y"], vertices["z"]]).astype(float)
    assert len(points) > 150
    off_mm = np.hypot(points[:, 0] - PILLAR_OFF_MM, points[:, 1]) - PILLAR_RADIUS_MM
    assert np.abs(off_mm).max() < 0.75  # the lidar rounds to whole millimetres
    # A degree of the turn is a millimetre of arc here: the sensor looked from as many degrees around the part.
    seen_from_deg = np.degrees(np.arctan2(points[:, 0], -points[:, 1]))
    assert np.ptp(seen_from_deg) > 10.0
