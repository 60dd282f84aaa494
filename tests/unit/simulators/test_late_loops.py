"""A simulated wire that is served late loses no scan that a wire served in time would have carried."""

from collections.abc import Callable

import numpy as np
import pytest

from drivers.protocols.lms import mode_request
from simulators.devices.lms import LmsDevice
from simulators.devices.scip import ScipDevice
from simulators.pacing import Pacer
from tests.unit.drivers.conversation_bench import flat_scene


def scip(late_s: float) -> tuple[int, int]:
    """Scans made and sent by a lidar that fills 93 % of its line."""
    device = ScipDevice(flat_scene(), baud_rate=115_200)
    device.receive(b"MD0044072501100\n", 0.0)
    return serve(device, late_s)


def lms(late_s: float) -> tuple[int, int]:
    """The same of an LMS2xx that fills 55 % of its line."""
    device = LmsDevice(flat_scene(), rng=np.random.default_rng(1), variant=(180, 50))
    device.baud_rate = 500_000
    device.receive(mode_request(0x24), 0.0)
    return serve(device, late_s)


def serve(device: ScipDevice | LmsDevice, late_s: float) -> tuple[int, int]:
    now_s, pacer = 0.0, Pacer(device.baud_rate, 0.0)
    while now_s < 20.0:
        data = device.transmit(now_s, pacer.room_bytes(now_s))
        pacer.spend(len(data))
        due_s = device.next_due_s(now_s)
        now_s = max(now_s + 0.002, due_s or 0.0) + late_s
    return device.scans_made, device.scans_sent


@pytest.mark.parametrize(
    ("device", "late_s"), [(scip, 0.001), (scip, 0.02), (scip, 0.045), (lms, 0.001), (lms, 0.008), (lms, 0.012)]
)
def test_a_late_loop_costs_no_scan(device: Callable[[float], tuple[int, int]], late_s: float) -> None:
    made, sent = device(late_s)
    assert made > 90
    assert sent >= made - 1  # the last one may be on the wire
