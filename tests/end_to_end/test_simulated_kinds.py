"""`--device`: each kind of scanner as its own process, over a part, and read by its driver."""

import threading

import numpy as np
import pytest

from drivers.scanline import Profile
from drivers.scanners.known import open_free_running
from simulators.parts import plate
from simulators.process import serve_simulated_scanner
from simulators.pty_port import UnknownDevice
from tests.end_to_end.running import wait_for


@pytest.mark.parametrize(
    ("kind", "ahead_mm"), [("scip", -150.0), ("lms200", -150.0), ("rplidar", -150.0), ("ls100", 0.0)]
)
def test_a_scanner_of_each_kind_is_simulated_over_a_part(kind, ahead_mm, running):
    """Over a flat plate whose top is z = 0 a lidar 150 mm above reads -150 straight ahead, a line scanner 0."""
    simulator = running.simulator("plate", "--device", kind, "--speed", "8")
    assert simulator.ready["device"] == kind
    lines = []
    with open_free_running(kind, simulator.port, simulator.ready["baud_rate"]) as scanner:
        scanner.start_profiles()

        def enough():
            lines.extend(item for item in scanner.events(0.1) if isinstance(item, Profile))
            return len(lines) >= 8

        wait_for(enough, f"eight profiles of {kind}")
        scanner.stop_profiles()
    middle = np.concatenate([line.z_mm[np.abs(line.x_mm) < 5] for line in lines[2:]])  # before, the plate's edge comes
    assert len(middle) >= 18
    np.testing.assert_allclose(middle, ahead_mm, atol=12.0)
    assert abs(np.median(middle) - ahead_mm) < 2.0


def test_a_device_that_is_not_known_is_told():
    with pytest.raises(UnknownDevice, match="no device 'sonar'; the devices are native, scip"):
        serve_simulated_scanner(plate(), stop=threading.Event(), announce=print, kind="sonar")
    with pytest.raises(UnknownDevice, match="begins at 19200 baud"):
        serve_simulated_scanner(plate(), stop=threading.Event(), announce=print, kind="scip", baud_rate=115_200)
