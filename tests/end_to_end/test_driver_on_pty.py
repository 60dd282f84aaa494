"""The driver against a simulated device behind a real pseudo-terminal: nothing lost unsaid, nothing left behind."""

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import PortAbsent, PortBusy, ScannerNotConnected, ScannerRefused, ScannerSilent
from drivers.protocols.scanner_events import (
    Disconnected,
    PassEnded,
    PassResumed,
    Rebooted,
    Reconnected,
)
from drivers.scanline import DeviceInfo, Profile, SensorGeometry
from drivers.scanners.native import NativeScanner
from simulators.devices.native import NativeDevice
from simulators.faults import Faults
from simulators.pty_port import PtyPort
from tests.end_to_end.catch import Catch, nothing_left

BAUD = 4_000_000
N_POINTS = 120


def scene(stage_mm: float) -> tuple[np.ndarray, np.ndarray]:
    x_mm = np.linspace(-6, 6, N_POINTS)
    return x_mm, np.sin(x_mm + stage_mm)


class RebootingDevice(NativeDevice):
    """Reboots when asked from another thread, between two calls of the thread that serves it."""

    reboot_wanted = False

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        if self.reboot_wanted:
            self.reboot_wanted = False
            self.reboot()
        return super().transmit(now_s, room_bytes)


def new_device(dead_man_s: float = 5.0) -> RebootingDevice:
    """A device whose buffer holds a whole pass, and whose dead-man is patient with a machine under load."""
    geometry = SensorGeometry(np.array([0.0, 0.0, 90.0]), np.array([0.0, 40.0, 90.0]), (-9.0, 9.0), 0.01)
    info = DeviceInfo("SN-1", "M", "F", "C", 77, N_POINTS, geometry)
    return RebootingDevice(info, scene, rng=np.random.default_rng(3), buffer_bytes=4_000_000, dead_man_s=dead_man_s)


@pytest.fixture(autouse=True)
def leaves_nothing_behind() -> Iterator[None]:
    with nothing_left():
        yield


def test_a_whole_pass_arrives_exactly_and_the_accounts_balance() -> None:
    device = new_device()
    with PtyPort(device, BAUD) as port, NativeScanner(str(port.path), BAUD) as scanner:
        catch = Catch(scanner)
        assert scanner.laser_on is False
        assert scanner.start_pass(0.25, 10.0, 60.0, 400.0) == 1
        catch.until(lambda: catch.count(PassEnded) > 0)
        assert catch.told == [PassEnded(1, "reached_end")]
        tally = scanner.tally()
        assert device.laser_on is False
    assert [line.position_mm for line in catch.lines] == [10.0 + 0.25 * k for k in range(201)]
    for line in catch.lines[::50]:
        x_mm, z_mm = scene(line.position_mm)
        np.testing.assert_allclose(line.x_mm, x_mm, rtol=0, atol=5.1e-5)
        np.testing.assert_allclose(line.z_mm, z_mm, rtol=0, atol=5.1e-5)
    assert tally.lines.sent == tally.lines.whole == 201
    assert tally.chunks.sent == tally.chunks.stored == 201 * 3
    assert tally.damage == {}


def test_on_a_noisy_wire_everything_is_stored_or_lost_by_reason() -> None:
    device = new_device()
    faults = Faults(bit_error_rate=2e-5, byte_loss_rate=2e-5, garbage_rate=0.01, piece_bytes=(1, 400))
    rng = np.random.default_rng(11)
    with PtyPort(device, BAUD, faults, rng=rng) as port, NativeScanner(str(port.path), BAUD) as scanner:
        catch = Catch(scanner)
        scanner.start_pass(0.1, 0.0, 30.0, 300.0)
        catch.until(lambda: catch.count(PassEnded) > 0)
        tally = scanner.tally()
        status = device.status
    assert tally.chunks.sent == status.next_sequence == 301 * 3
    assert tally.lines.sent == status.next_line == 301
    assert tally.chunks.balances
    assert tally.lines.balances
    assert tally.lines.open == 0
    assert sum(tally.chunks.lost.values()) > 0
    assert tally.lines.whole == sum(line.is_whole for line in catch.lines)
    assert tally.lines.partial == sum(not line.is_whole for line in catch.lines)
    for line in catch.lines:  # no damaged value got in
        _, z_mm = scene(line.position_mm)
        np.testing.assert_allclose(line.z_mm[~line.missing], z_mm[~line.missing], rtol=0, atol=5.1e-5)


def test_a_full_queue_loses_lines_and_says_so_while_the_reader_goes_on() -> None:
    device = new_device()
    with PtyPort(device, BAUD) as port, NativeScanner(str(port.path), BAUD, queue_lines=10) as scanner:
        scanner.start_pass(0.1, 0.0, 10.0, 500.0)
        done = threading.Event()
        for _ in range(1_200):
            lines_so_far = scanner.tally().lines
            if lines_so_far.sent == 101 and lines_so_far.open == 0:
                break
            done.wait(0.05)
        tally = scanner.tally()
        lines = [item for item in scanner.events(1.0) if isinstance(item, Profile)]
    assert len(lines) == 10
    assert tally.lines.sent == 101
    assert tally.lines.lost == {"host_overflow": 91}
    assert tally.chunks.lost == {"host_overflow": 273}


def test_stop_ends_the_pass_with_all_its_lines_told() -> None:
    device = new_device()
    with PtyPort(device, BAUD) as port, NativeScanner(str(port.path), BAUD) as scanner:
        catch = Catch(scanner)
        scanner.start_pass(0.1, 0.0, 1000.0, 300.0)
        with pytest.raises(ScannerRefused, match="stop it first"):
            scanner.start_pass(0.1, 0.0, 1.0, 300.0)
        catch.until(lambda: len(catch.lines) > 20)
        scanner.stop_pass()
        assert not device.laser_on
        catch.until(lambda: catch.count(PassEnded) > 0)
        assert catch.told == [PassEnded(1, "stopped")]
        assert scanner.tally().lines.whole == len(catch.lines) == device.status.next_line
        with pytest.raises(ScannerRefused, match="START: a value is outside"):
            scanner.start_pass(0.1, 0.0, 1.0, 1e6)
        assert not device.laser_on


def test_exit_leaves_the_laser_off_and_an_entered_port_is_busy() -> None:
    device = new_device()
    with PtyPort(device, BAUD) as port:
        scanner = NativeScanner(str(port.path), BAUD)
        scanner.enter()
        with pytest.raises(PortBusy):
            NativeScanner(str(port.path), BAUD).enter()
        scanner.start_pass(0.1, 0.0, 1000.0, 100.0)
        assert device.laser_on
        scanner.exit()
        assert not device.laser_on
        assert not device.streaming
        scanner.exit()
        with pytest.raises(ScannerNotConnected):
            scanner.laser(True)
        assert scanner.enter().device_id == "SN-1"
        scanner.exit()


def test_a_path_without_a_port_is_absent(tmp_path: Path) -> None:
    with pytest.raises(PortAbsent):
        NativeScanner(str(tmp_path / "scanner"), BAUD).enter()


def test_at_a_wrong_rate_nobody_answers_and_the_message_says_what_to_try() -> None:
    rng = np.random.default_rng(5)
    with (
        PtyPort(new_device(), 115_200, rng=rng, heeds_client_rate=True) as port,
        pytest.raises(ScannerSilent, match="9600 baud"),
    ):
        NativeScanner(str(port.path), 9_600).enter()


@pytest.mark.parametrize("cut", ["short", "long"])
def test_a_pulled_cable_is_told_and_healed_and_the_gap_is_in_the_accounts(cut: str, tmp_path: Path) -> None:
    device = new_device(dead_man_s=0.5 if cut == "long" else 5.0)
    link = tmp_path / "scanner"
    n_lines = 501
    with PtyPort(device, BAUD, link_path=link) as port, NativeScanner(str(link), BAUD) as scanner:
        catch = Catch(scanner)
        scanner.start_pass(0.1, 0.0, 50.0, 250.0)
        catch.until(lambda: len(catch.lines) >= 50)
        port.unplug()
        catch.until(lambda: catch.count(Disconnected) == 1)
        assert scanner.laser_on is None
        with pytest.raises(ScannerNotConnected):
            scanner.laser(True)
        if cut == "long":
            catch.until(lambda: not device.streaming)
            assert not device.laser_on
        port.replug()
        catch.until(lambda: catch.count(Reconnected) == 1)
        catch.until(
            lambda: bool(catch.told) and catch.told[-1:] == [PassEnded(device.status.pass_index, "reached_end")]
        )
        tally = scanner.tally()
    assert tally.lines.balances
    assert tally.chunks.balances
    assert tally.lines.sent == device.status.next_line
    assert tally.lines.lost.get("disconnected", 0) > 0
    positions = {round(line.position_mm, 6) for line in catch.lines}
    if cut == "long":  # stopped by its dead-man, started again behind the last line that was read
        assert catch.count(PassResumed) == 1
        assert positions == {round(0.1 * k, 6) for k in range(n_lines)}
    else:
        assert tally.lines.sent >= n_lines


def test_a_rebooted_device_is_told_and_its_pass_goes_on() -> None:
    device = new_device()
    with PtyPort(device, BAUD) as port, NativeScanner(str(port.path), BAUD) as scanner:
        catch = Catch(scanner)
        scanner.start_pass(0.1, 0.0, 40.0, 400.0)
        catch.until(lambda: len(catch.lines) >= 20)
        device.reboot_wanted = True
        catch.until(lambda: PassEnded(1, "reached_end") in catch.told)
        tally = scanner.tally()
    assert [type(event) for event in catch.told] == [Rebooted, PassEnded, PassResumed, PassEnded]
    assert {round(line.position_mm, 6) for line in catch.lines} == {round(0.1 * k, 6) for k in range(401)}
    assert tally.lines.balances
    assert tally.chunks.balances
