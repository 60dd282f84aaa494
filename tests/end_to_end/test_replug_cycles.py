"""Pulled cables, again and again, each time under another number: devices come back, and nothing is left behind.

The long runs print how soon; no time is asserted, since a busy machine would decide.
"""

import statistics
import threading
import time

import numpy as np
import pytest

from drivers.scanline import DeviceInfo, SensorGeometry
from drivers.scanners.native import NativeScanner
from simulators.devices.native import NativeDevice
from simulators.pty_port import PtyPort
from tests.end_to_end.catch import open_descriptors
from tests.end_to_end.stages import BAUD, KINDS, new_device, open_stage

PATIENCE_S = 90.0


def new_scanner():
    geometry = SensorGeometry(np.zeros(3), np.zeros(3), (-9.0, 9.0), 0.01)
    info = DeviceInfo("SN-1", "M", "F", "C", 1, 60, geometry)
    return NativeDevice(info, lambda at_mm: (np.zeros(60), np.zeros(60)), rng=np.random.default_rng(1))


def cycle(port, driver, count):
    """Pull and plug `count` times; return how long each return took, from the plugging on."""
    seconds = []
    for number in range(count):
        port.unplug()
        await_state(driver, False)
        time.sleep(0.002 * (number % 7))  # plugged in at different moments of the driver's round
        port.replug()
        begun_s = time.monotonic()
        await_state(driver, True)
        seconds.append(time.monotonic() - begun_s)
    return seconds


def await_state(driver, connected):
    give_up_s = time.monotonic() + PATIENCE_S
    while driver.is_connected is not connected:
        assert time.monotonic() < give_up_s, f"the driver did not become {'' if connected else 'dis'}connected"
        time.sleep(0.001)


def tell(name, seconds):
    ordered = sorted(seconds)
    p99 = ordered[int(0.99 * (len(ordered) - 1))]
    print(f"\n{name}: {len(seconds)} cycles, median {statistics.median(ordered):.3f} s, p99 {p99:.3f} s, "
          f"most {ordered[-1]:.3f} s")  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "count"),
    [
        ("grbl", 5),
        ("native", 5),
        pytest.param("grbl", 1000, marks=pytest.mark.long),
        pytest.param("native", 1000, marks=pytest.mark.long),
        pytest.param("zaber", 200, marks=pytest.mark.long),
        pytest.param("marlin", 200, marks=pytest.mark.long),
    ],
)
def test_a_device_comes_back_from_every_replug_and_nothing_is_left_behind(kind, count, tmp_path):
    threads, descriptors = threading.active_count(), open_descriptors()
    link = tmp_path / "device"
    device = new_device(kind) if kind in KINDS else new_scanner()
    with PtyPort(device, BAUD if kind in KINDS else 3_000_000, link_path=link) as port:
        driver = open_stage(kind, str(link)) if kind in KINDS else NativeScanner(str(link), 3_000_000)
        with driver:
            during, held = threading.active_count(), open_descriptors()
            if kind in KINDS:
                driver.home()
            tell(kind, cycle(port, driver, count))
            if kind in KINDS:
                assert driver.position_known
            assert threading.active_count() == during
            assert open_descriptors() == held
    assert threading.active_count() == threads
    assert open_descriptors() == descriptors
