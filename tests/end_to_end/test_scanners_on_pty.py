"""Drivers of other makers' scanners against simulated devices on a real pseudo-terminal, with true rates and cables."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import PortBusy, ScannerNotConnected, ScannerSilent
from drivers.protocols.scanner_events import Disconnected, PassEnded, Reconnected
from drivers.scanners.known import KNOWN, identify, open_free_running
from simulators.devices.lms import LmsDevice
from simulators.devices.rplidar import A2, RplidarDevice
from simulators.devices.scip import ScipDevice
from simulators.pty_port import PtyPort
from tests.end_to_end.catch import Catch, nothing_left
from tests.unit.drivers.conversation_bench import flat_scene

DEVICES = {
    "scip": lambda: ScipDevice(flat_scene()),
    "lms200": lambda: LmsDevice(flat_scene(), rng=np.random.default_rng(2)),
    "rplidar": lambda: RplidarDevice(flat_scene(), A2),
}


@pytest.fixture(autouse=True)
def leaves_nothing_behind() -> Iterator[None]:
    with nothing_left():
        yield


def plugged(name: str, **options: object) -> PtyPort:
    device = DEVICES[name]()
    return PtyPort(device, device.baud_rate, rng=np.random.default_rng(1), heeds_client_rate=True, **options)


@pytest.mark.parametrize("name", DEVICES)
def test_a_scanner_is_found_measures_and_is_left_with_its_laser_off(name: str) -> None:
    with plugged(name) as port:
        found = identify(str(port.path), [name])
        assert found is not None
        assert found.scanner is KNOWN[name]
        with open_free_running(name, str(port.path), found.baud_rate) as scanner:
            catch = Catch(scanner)
            with pytest.raises(PortBusy):
                open_free_running(name, str(port.path)).enter()
            shines_always = name == "lms200"
            assert scanner.laser_on is shines_always
            scanner.start_profiles()
            assert scanner.laser_on is True
            catch.until(lambda: len(catch.lines) >= 5)
            scanner.stop_profiles()
            assert scanner.laser_on is shines_always
            catch.until(lambda: catch.count(PassEnded) == 1)
            tally = scanner.tally()
        assert port._device.laser_on is shines_always
        assert scanner.laser_on is None
        with pytest.raises(ScannerNotConnected):
            scanner.start_profiles()
    assert tally.lines.balances
    assert tally.lines.stored == len(catch.lines)
    for line in catch.lines:
        ahead = np.abs(line.x_mm) < 100
        np.testing.assert_allclose(line.z_mm[ahead & ~np.isnan(line.z_mm)], -200, atol=20)


@pytest.mark.parametrize("name", DEVICES)
def test_a_replugged_cable_is_healed_under_another_name(name: str, tmp_path: Path) -> None:
    link = tmp_path / "scanner"
    with plugged(name, link_path=link) as port, open_free_running(name, str(link)) as scanner:
        catch = Catch(scanner)
        scanner.start_profiles()
        catch.until(lambda: len(catch.lines) >= 3)
        for cycle in range(2):
            before = len(catch.lines)
            port.unplug()
            catch.until(lambda cycle=cycle: catch.count(Disconnected) == cycle + 1)
            assert scanner.laser_on is None
            port.replug()
            catch.until(lambda cycle=cycle: catch.count(Reconnected) == cycle + 1)
            catch.until(lambda before=before: len(catch.lines) >= before + 2)
        scanner.stop_profiles()
        tally = scanner.tally()
    assert tally.lines.balances
    assert [line.line_index for line in catch.lines] == sorted({line.line_index for line in catch.lines})


def test_a_port_on_which_nobody_is_says_so_and_lets_go() -> None:
    class Mute:
        def receive(self, data: bytes, now_s: float) -> None:
            pass

        def transmit(self, now_s: float, room_bytes: int) -> bytes:
            return b""

        def next_due_s(self, now_s: float) -> float | None:
            return None

    sentence = r"no LMS2xx answers at 9600, .* check its power"
    with PtyPort(Mute(), 9_600) as port, pytest.raises(ScannerSilent, match=sentence):
        open_free_running("lms200", str(port.path)).enter()
