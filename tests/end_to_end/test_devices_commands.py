"""`scanner devices`, `scanner doctor` and `scanner scan` as a user types them, on simulated devices."""

import contextlib
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from scanner_service.cli import app
from simulators.devices.grbl import GrblDevice
from simulators.devices.scip import ScipDevice
from simulators.devices.zaber import ZaberDevice
from simulators.pty_port import PtyPort
from tests.unit.drivers.conversation_bench import flat_scene

BAUD = 115_200
RIG = """
[scanner]
kind = "{scanner_kind}"
port = "{scanner}"
field_of_view_mm = [-100, 100]
[stage]
kind = "{stage_kind}"
port = "{stage}"
baud_rate = {baud}
travel_mm = [-100, 0]
speed_mm_per_s = [0, 30]
[pairing]
by = "time"
latency_ms = 30
"""


def run(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return result.exit_code, result.stdout, result.stderr


@pytest.fixture
def bench(tmp_path):
    """A lidar and a GRBL stage, each on its pty, and a function that writes a rig file for them."""
    with contextlib.ExitStack() as stack:
        lidar = ScipDevice(flat_scene())
        lidar_port = stack.enter_context(
            PtyPort(lidar, lidar.baud_rate, rng=np.random.default_rng(1), heeds_client_rate=True)
        )
        stage_port = stack.enter_context(PtyPort(GrblDevice(), BAUD))

        def write(**changes):
            values = {
                "scanner_kind": "scip",
                "scanner": lidar_port.path,
                "stage_kind": "grbl",
                "stage": stage_port.path,
                "baud": BAUD,
            }
            path = tmp_path / "bench.toml"
            path.write_text(RIG.format(**(values | changes)))
            return path

        write.lidar_port, write.stage_port = lidar_port, stage_port
        yield write


def test_a_device_on_a_port_is_identified_and_a_stage_told_from_a_scanner(bench):
    status, told, _ = run("devices", "--identify", "--port", bench.stage_port.path, "--json")
    assert status == 0
    device = json.loads(told)[0]["device"]
    assert (device["what"], device["kind"], device["baud_rate"]) == ("stage", "grbl", BAUD)
    assert "1.1h" in device["identity"]


def test_the_doctor_finds_a_sound_rig_sound_and_warns_of_what_will_be_refused(bench):
    status, told, _ = run("doctor", bench())
    assert status == 0, told
    assert "ok       scanner: URG-04LX" in told
    assert "ok       stage: GRBL" in told
    assert "does not know where it is" in told
    assert "--home" in told


@pytest.mark.long
def test_the_doctor_names_the_kind_that_answers_instead(bench):
    status, told, _ = run("doctor", bench(stage_kind="marlin"), "--json")
    assert status == 1
    problem = next(item for item in json.loads(told) if item["level"] == "problem")
    assert 'kind = "grbl" and baud_rate = 115200' in problem["remedy"]


def test_the_doctor_tells_absent_busy_and_bad_files_apart(bench, tmp_path):
    status, told, _ = run("doctor", bench(stage="/dev/ttyUSB99"))
    assert status == 1
    assert "/dev/ttyUSB99 does not exist" in told
    assert "plug the device in and check the path" in told
    from drivers.port import Port

    held = Port(str(bench.stage_port.path), BAUD)
    status, told, _ = run("doctor", "--port", bench.stage_port.path)
    held.close()
    assert status == 1
    assert "held by another program" in told
    assert "close that program" in told
    (tmp_path / "bad.toml").write_text("[scanner]\nkind = 1\n")
    status, _, complaint = run("doctor", tmp_path / "bad.toml")
    assert status == 1
    assert "[scanner] kind: must be a text" in complaint


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("/dev/nothere", "/dev/nothere does not exist or is not connected"),
        ("/dev/null", "/dev/null is not a serial device"),
        ("/dev", "/dev is not a serial device"),
        ("", "'' is no path of a serial device"),
        ("usb:1234:5678", "no adapter usb:1234:5678 is plugged in"),
        ("usb:zz", "write usb:VID:PID or usb:VID:PID:SERIAL"),
    ],
)
def test_a_port_that_is_not_there_is_told_in_one_sentence_and_nothing_else(name, said):
    for command in (("devices", "--port", name), ("devices", "--identify", "--port", name), ("doctor", "--port", name)):
        status, told, complaint = run(*command)
        if command[:2] == ("devices", "--identify") and name == "/dev/null":
            continue  # a character device: only opening it tells, see below
        if command[0] == "devices" and name == "/dev/null":
            assert status == 0
            continue
        assert status == 1, command
        assert said in told + complaint
        assert "survives a replug" not in told
        assert "Errno" not in told + complaint
    if name == "/dev/null":
        _, told, _ = run("devices", "--identify", "--port", name, "--json")
        assert said in json.loads(told)[0]["device"]["problem"]


def test_the_udev_rule_is_printed_as_it_stands():
    status, told, _ = run("doctor", "--udev-rule")
    assert status == 0
    assert 'ATTR{latency_timer}="1"' in told
    assert "ID_MM_DEVICE_IGNORE" in told


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--start", -5, "--end", -500, "--line-spacing", 0.5), "the end at -500 mm is outside"),
        (("--start", -5, "--end", -5, "--line-spacing", 0.5), "has no length"),
        (("--start", -5, "--end", -9, "--line-spacing", 0.5, "--at-rest", "--speed", 1), "leave out --speed"),
        (("--start", -5, "--end", -9, "--line-spacing", 0.5), "home it, or state where it is"),
    ],
)
def test_a_scan_that_cannot_be_is_refused_in_one_sentence(bench, tmp_path, options, said):
    status, _, complaint = run("scan", bench(), *options, "--out", tmp_path / "out")
    assert status == 1
    assert said in complaint


def test_a_scan_with_a_rig_writes_the_same_files_as_any_other(tmp_path):
    """A lidar 300 mm above a flat plate on a Zaber stage, line by line at rest."""
    stage = ZaberDevice()
    with contextlib.ExitStack() as stack:
        lidar = ScipDevice(lambda angles, _: np.where(np.abs(angles) < 0.5, 300.0 / np.cos(angles), np.nan))
        lidar_port = stack.enter_context(
            PtyPort(lidar, lidar.baud_rate, rng=np.random.default_rng(1), heeds_client_rate=True)
        )
        stage_port = stack.enter_context(PtyPort(stage, BAUD))
        rig = tmp_path / "plate.toml"
        rig.write_text(
            f'[scanner]\nkind = "scip"\nport = "{lidar_port.path}"\nfield_of_view_mm = [-100, 100]\n'
            f'[stage]\nkind = "zaber"\nport = "{stage_port.path}"\ntravel_mm = [0, 100]\nspeed_mm_per_s = [0, 50]\n'
            "options = { microstep = 0.001 }\n"
            "[mounting]\nstage_from_sensor = { translation_mm = [0, 0, 300] }\n"
        )
        out = tmp_path / "out"
        status, told, complaint = run(
            "scan", rig, "--start", 10, "--end", 30, "--line-spacing", 5, "--at-rest", "--home", "--out", out, "--json"
        )
    assert status == 0, complaint
    summary = json.loads(told)
    assert summary["scanlines"] == 5
    assert summary["line_spacing_mm"]["median"] == 5.0
    assert (out / "points.ply").stat().st_size > 10_000
    assert (out / "density.png").exists()
    assert not stage.axes.is_moving(1e12)
