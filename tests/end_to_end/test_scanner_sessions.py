"""A session on another maker's scanner, end to end: simulator process, pty, driver, conveyor rig, service, live map."""

import pytest

RIG = """
name = "conveyor"

[scanner]
kind = "{kind}"
port = "{port}"

[stage]
kind = "constant_speed"
speed_mm_per_s = [8, 8]

[pairing]
by = "time"
"""


@pytest.mark.parametrize(
    "kind", ["scip", *(pytest.param(kind, marks=pytest.mark.long) for kind in ("rplidar", "lms200", "ls100"))]
)
def test_a_part_on_a_conveyor_becomes_a_live_map(kind, running):
    simulator = running.simulator("plate", "--device", kind, "--speed", "8")
    (running.data / "rigs").mkdir(parents=True)
    (running.data / "rigs" / "conveyor.toml").write_text(RIG.format(kind=kind, port=simulator.port))
    service = running.service()
    session = service.create(
        kind="rig", rig="conveyor.toml", line_spacing_mm=0.8, start_mm=-1.0, end_mm=23.0, speed_mm_per_s=8.0
    )
    service.start(session)
    status = service.wait_for_state(session, "stopped")
    device = status["losses"]["device"]
    assert status["lines"] > 0
    assert status["points"] >= 20 * status["lines"] * (kind != "rplidar")
    assert device["lines"]["sent"] == device["lines"]["stored"] + sum(device["lines"]["lost"].values())
    assert device["rig"]["lines"] == status["lines"]
    (account,) = status["losses"]["passes"]
    assert account["lines"]["under_way"] == 0
    assert account["lines"]["sent"] == account["lines"]["stored"] + sum(account["lines"]["lost"].values())
    assert account["lines"]["stored"] == status["lines"]
    assert account["device_id"] == status["calibration"]["scanner"]["device_id"]
    if status["lines"] >= 8:  # a machine that is busy enough lets the scanner drop nearly all
        assert 0 < device["rig"]["median_step_mm"] < 24.0
        assert status["coverage"] > 0
