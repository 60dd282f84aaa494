"""Clients that others published, unchanged and in processes of their own, talk to the simulated devices over a pty."""

import contextlib
import importlib.util
import json
import os
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from simulators.devices.rplidar import A1, A3, S1, Model, RplidarDevice
from simulators.devices.scip import ScipDevice
from simulators.devices.scip_scans import URG_04LX
from simulators.pty_port import PtyPort

CLIENTS = Path(__file__).parent / "clients"
PATIENCE_S = 90


def wall(angles_rad: np.ndarray, _elapsed_s: float) -> np.ndarray:
    """A wall 800 mm ahead, seen within 60 degrees; nothing elsewhere."""
    return np.where(np.abs(angles_rad) < np.radians(60), 800.0 / np.cos(angles_rad), np.nan)


def ask(script: str, *arguments: object) -> dict:
    """Run a client and return what it printed last."""
    answer = subprocess.run(
        [sys.executable, str(CLIENTS / script), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert answer.returncode == 0, answer.stderr
    return json.loads(answer.stdout.splitlines()[-1])


def needs(module: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(importlib.util.find_spec(module) is None, reason=f"{module} is not installed")


@contextlib.contextmanager
def tcp_bridge(path: Path) -> Iterator[int]:
    """A TCP port of this machine whose one client talks to the terminal at `path`."""
    stop = threading.Event()
    server = socket.create_server(("127.0.0.1", 0))
    terminal = os.open(path, os.O_RDWR | os.O_NOCTTY)

    def carry() -> None:
        server.settimeout(PATIENCE_S)
        with server, server.accept()[0] as client:
            while not stop.is_set():
                readable, _, _ = select.select([client, terminal], [], [], 0.05)
                if terminal in readable:
                    client.sendall(os.read(terminal, 4096))
                if client in readable:
                    data = client.recv(4096)
                    if not data:
                        return
                    os.write(terminal, data)

    thread = threading.Thread(target=carry, daemon=True)
    thread.start()
    try:
        yield server.getsockname()[1]
    finally:
        stop.set()
        thread.join()
        os.close(terminal)


@needs("hokuyolx")
def test_hokuyolx_reads_the_simulated_lidar() -> None:
    device = ScipDevice(wall, baud_rate=750_000)
    with PtyPort(device, 750_000) as port, tcp_bridge(port.path) as number:
        found = ask("ask_hokuyolx.py", number)
    assert found["serial"] == "H0000001"
    assert found["model"] == URG_04LX.name
    assert found["steps"] == [44, 725, 384, 1024]
    angles = (np.arange(44, 726) - 384) * 2 * np.pi / 1024
    expected = np.where(np.isnan(wall(angles, 0.0)), 0, np.rint(np.nan_to_num(wall(angles, 0.0))))
    assert len(found["scans"]) == 3
    for scan in (found["single"], *found["scans"]):
        np.testing.assert_array_equal(scan, expected)


def check_samples(samples: list, tolerance_mm: float) -> None:
    """Clockwise degrees and millimetres of the wall; a turn's beginning is told where the angle begins anew."""
    _, angles, distances = (np.array(column, dtype=float) for column in zip(*samples, strict=True))
    ahead = -((angles + 180.0) % 360.0 - 180.0)
    seen = distances > 0
    inside, outside = np.abs(ahead) < 59, np.abs(ahead) > 61
    assert seen[inside].all()
    assert not seen[outside].any()
    np.testing.assert_allclose(distances[inside], 800.0 / np.cos(np.radians(ahead[inside])), rtol=0, atol=tolerance_mm)
    assert inside.sum() > 50


@needs("pyrplidar")
def test_pyrplidar_reads_the_simulated_lidar() -> None:
    device = RplidarDevice(wall)
    with PtyPort(device, A1.baud_rate) as port:
        found = ask("ask_pyrplidar.py", port.path, A1.baud_rate)
    assert found["info"] == [24, 1, 29, 7, bytes(range(0x10, 0x20)).hex().upper()]
    assert found["health"] == [0, 0]
    assert found["rate"] == [508, 254]
    assert (found["count"], found["typical"]) == (2, 1)
    assert [mode[:2] for mode in found["modes"]] == [["Standard", 0x81], ["Express", 0x82]]
    check_samples(found["express"], 8.0)  # angles are rounded to 1/64 degree, distances to whole mm
    check_samples(found["standard"], 2.0)
    assert [k for k, sample in enumerate(found["standard"]) if sample[0]] == [
        0,
        197,
        394,
    ]  # 508 us at 10 turns a second
    assert not device.laser_on
    assert device.motor_pwm == 0


@needs("rplidar")
def test_rplidar_roboticia_reads_the_simulated_lidar() -> None:
    device = RplidarDevice(wall)
    with PtyPort(device, A1.baud_rate) as port:
        found = ask("ask_roboticia.py", port.path, A1.baud_rate)
    assert found["info"]["model"] == 24
    assert found["info"]["firmware"] == [1, 29]
    assert found["health"] == ["Good", 0]
    check_samples(found["normal"], 2.0)
    late_deg = 254e-6 * 10 * 360  # this client counts the samples of a capsule from 1, the manufacturer's from 0
    check_samples([[new, angle - late_deg, distance] for new, angle, distance in found["express"]], 8.0)
    assert 6 <= sum(sample[0] for sample in found["normal"]) <= 9
    assert not device.laser_on


@needs("pyrplidarsdk")
@pytest.mark.parametrize("model", [A1, A3, S1], ids=["express", "ultra", "dense"])
def test_the_manufacturers_own_sdk_reads_the_simulated_lidar(model: Model) -> None:
    def two_walls(angles_rad: np.ndarray, _elapsed_s: float) -> np.ndarray:
        """One 800 mm ahead, 1.5 m beyond half a radian to the right; nothing else, so that left and right differ."""
        seen = np.where(angles_rad < -0.5, 1500.0, 800.0) / np.cos(angles_rad)
        return np.where((angles_rad > -1.0) & (angles_rad < 0.3), seen, np.nan)

    device = RplidarDevice(two_walls, model)
    device.motor_pwm = 660  # the wrapper of the SDK leaves the motor to others
    with PtyPort(device, model.baud_rate) as port:
        found = ask("ask_slamtec_sdk.py", port.path, model.baud_rate, 3)
    major, minor = model.firmware
    assert found["info"][:3] == [model.number, major << 8 | minor, model.hardware]
    assert found["info"][3] == bytes(range(0x10, 0x20)).hex()
    assert found["health"][1] == 0
    assert found["scans"]
    samples_a_turn = 1e6 / model.modes[model.typical].us_per_sample / 10.0
    for angles, ranges, _ in found["scans"]:
        ahead = -((np.array(angles) + np.pi) % (2 * np.pi) - np.pi)
        depth_mm = np.array(ranges) * 1000.0 * np.cos(ahead)
        assert len(ahead) == pytest.approx(samples_a_turn * 1.3 / (2 * np.pi), rel=0.08)
        near = (ahead > -0.47) & (ahead < 0.28)
        far = (ahead > -0.98) & (ahead < -0.53)
        np.testing.assert_allclose(depth_mm[near], 800.0, atol=2.5)  # steps of 2 mm, angles of 1/64 degree
        np.testing.assert_allclose(depth_mm[far], 1500.0, atol=4.5)
        assert near.sum() > 10
        assert far.sum() > 10
    assert not device.laser_on
