"""The pseudo-terminal as a client sees it: raw bytes, paced, unplugged, plugged in again, and nothing left behind."""

import os
import select
import termios
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import serial

from simulators.faults import Faults
from simulators.pty_port import DeviceFailed, LinkPathTaken, PtyPort, SimulatedPortError
from tests.end_to_end.running import wait_for

BAUD = 115_200
EVERY_BYTE = bytes(range(256))


class EchoDevice:
    """Sends back what it received; `greedy`, from the start or from the word "go", it counts up without end."""

    def __init__(self, greedy: bool = False) -> None:
        self.waiting = bytearray()
        self.greedy = greedy
        self.sent_bytes = 0
        self.asked_without_room = 0

    def receive(self, data: bytes, now_s: float) -> None:
        if data == b"break":
            raise RuntimeError("broken")
        if data == b"go":
            self.greedy = True
            return
        self.waiting += data

    def transmit(self, now_s: float, room_bytes: int) -> bytes:
        self.asked_without_room += room_bytes == 0
        if self.greedy:
            while len(self.waiting) < room_bytes:
                self.waiting += EVERY_BYTE
        data = bytes(self.waiting[:room_bytes])
        del self.waiting[:room_bytes]
        self.sent_bytes += len(data)
        return data

    def next_due_s(self, now_s: float) -> float | None:
        return now_s if self.waiting or self.greedy else None


def client(path: Path, baud: int = BAUD) -> serial.Serial:
    return serial.Serial(str(path), baud, timeout=60.0)


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def read_until_hang_up(descriptor: int) -> None:
    """Raises OSError when the terminal hangs up."""
    while True:
        select.select([descriptor], [], [], 5.0)
        if not os.read(descriptor, 4096):
            raise OSError("hung up")


def test_every_byte_value_passes_unchanged_both_ways() -> None:
    with PtyPort(EchoDevice(), BAUD) as port, client(port.path) as host:
        host.write(EVERY_BYTE * 2)
        assert host.read(512) == EVERY_BYTE * 2
    assert port.counts.sent_bytes == port.counts.received_bytes == 512


def test_bytes_written_before_the_client_opens_are_not_echoed_to_the_device() -> None:
    device = EchoDevice(greedy=True)
    with PtyPort(device, BAUD) as port, client(port.path) as host:
        assert len(host.read(256)) == 256
    assert port.counts.received_bytes == 0


def test_no_more_than_a_tenth_of_the_baud_rate_arrives_in_a_second() -> None:
    began = time.monotonic()
    with PtyPort(EchoDevice(), BAUD) as port, client(port.path) as host:
        host.write(b"go")
        assert host.read(6000) == (EVERY_BYTE * 24)[:6000]
        took = time.monotonic() - began
    assert BAUD / 10 * took >= 6000


def test_what_the_client_does_not_fetch_stays_with_the_device() -> None:
    device = EchoDevice()
    with PtyPort(device, 3_000_000) as port, client(port.path, 3_000_000) as host:
        host.write(b"go")
        settled, before = 0, -1
        while settled < 3 or not device.asked_without_room:
            time.sleep(0.05)
            settled, before = (settled + 1 if device.sent_bytes == before else 0), device.sent_bytes
        assert device.asked_without_room > 0, "it is told the time all the while, to drop what is out of date"
        fetched = host.read(before)
        is_whole = fetched == (EVERY_BYTE * (before // 256 + 1))[:before]
        assert is_whole, "held back, not lost"


def test_the_rate_that_the_client_sets_is_known() -> None:
    with PtyPort(EchoDevice(), BAUD) as port:
        assert port.client_baud_rate() == BAUD
        with client(port.path, 57_600):
            assert port.client_baud_rate() == 57_600
        with client(port.path, 250_000):
            assert port.client_baud_rate() == 250_000


def test_a_client_at_the_wrong_rate_reads_noise() -> None:
    port = PtyPort(EchoDevice(), BAUD, rng=np.random.default_rng(1), heeds_client_rate=True)
    with port, client(port.path, 57_600) as host:
        host.write(EVERY_BYTE)
        assert host.read(200) != EVERY_BYTE[:200]
    assert port.counts.misread_bytes >= 256 + 200


def test_a_client_at_the_right_rate_reads_everything() -> None:
    port = PtyPort(EchoDevice(), BAUD, rng=np.random.default_rng(1), heeds_client_rate=True)
    with port, client(port.path) as host:
        host.write(EVERY_BYTE)
        assert host.read(256) == EVERY_BYTE
    assert port.counts.misread_bytes == 0


def test_faults_on_the_wire_are_counted() -> None:
    faults = Faults(byte_loss_rate=0.05, piece_bytes=(1, 7))
    with PtyPort(EchoDevice(), BAUD, faults=faults, rng=np.random.default_rng(2)) as port, client(port.path) as host:
        host.write(EVERY_BYTE * 4)
        wait_for(lambda: port.fault_counts.bytes_in == 1024, "all bytes to be on the wire")
        arrived = host.read(port.fault_counts.bytes_out)
        assert host.in_waiting == 0
    counts = port.fault_counts
    assert counts.bytes_in == 1024
    assert counts.lost_bytes > 10
    assert len(arrived) == counts.bytes_out == 1024 - counts.lost_bytes


def test_unplugging_hangs_up_and_plugging_in_again_serves_under_the_same_link(tmp_path: Path) -> None:
    link = tmp_path / "scanner"
    with PtyPort(EchoDevice(), BAUD, link_path=link) as port:
        assert port.path == link
        for _ in range(20):
            descriptor = os.open(link, os.O_RDWR | os.O_NOCTTY)
            port.unplug()
            assert not link.is_symlink()
            with pytest.raises(OSError, match=r"hung up|Input/output"):
                read_until_hang_up(descriptor)
            port.replug()
            with client(link) as host:
                host.write(b"here again")
                assert host.read(10) == b"here again"
            os.close(descriptor)
    assert not link.is_symlink()


def test_an_unplugged_device_runs_on_and_what_it_sent_is_counted() -> None:
    device = EchoDevice(greedy=True)
    with PtyPort(device, 3_000_000) as port:
        port.unplug()
        assert not port.is_plugged
        with pytest.raises(SimulatedPortError, match="not plugged in"):
            _ = port.path
        before = device.sent_bytes
        deadline = time.monotonic() + 10.0
        while device.sent_bytes < before + 10_000 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert port.counts.unplugged_bytes >= 10_000


def test_neither_descriptors_nor_threads_are_left_behind(tmp_path: Path) -> None:
    before, threads = descriptors(), threading.active_count()
    for _ in range(20):
        port = PtyPort(EchoDevice(greedy=True), BAUD, link_path=tmp_path / "scanner")
        port.start()
        port.unplug()
        port.replug()
        port.stop()
        port.stop()
    assert (descriptors(), threading.active_count()) == (before, threads)


def test_it_serves_in_the_foreground_until_told_to_stop(tmp_path: Path) -> None:
    link, stop = tmp_path / "scanner", threading.Event()
    before = descriptors()
    port = PtyPort(EchoDevice(), BAUD, link_path=link)

    def use_it() -> None:
        while not link.exists():
            time.sleep(0.01)
        with client(link) as host:
            host.write(b"hello")
            received.append(host.read(5))
        stop.set()

    received: list[bytes] = []
    user = threading.Thread(target=use_it)
    user.start()
    port.run(stop)
    user.join()
    assert received == [b"hello"]
    assert not link.is_symlink()
    assert descriptors() == before


def test_a_device_that_raises_hangs_up_and_the_reason_comes_out_at_the_end() -> None:
    port = PtyPort(EchoDevice(), BAUD)
    port.start()
    descriptor = os.open(port.path, os.O_RDWR | os.O_NOCTTY)
    os.write(descriptor, b"break")
    with pytest.raises(OSError, match=r"hung up|Input/output"):
        read_until_hang_up(descriptor)
    os.close(descriptor)
    with pytest.raises(DeviceFailed, match="RuntimeError: broken"):
        port.stop()


def test_a_file_in_the_place_of_the_link_is_left_alone(tmp_path: Path) -> None:
    taken = tmp_path / "scanner"
    taken.write_text("mine")
    before = descriptors()
    with pytest.raises(LinkPathTaken, match="name another"):
        PtyPort(EchoDevice(), BAUD, link_path=taken).start()
    assert taken.read_text() == "mine"
    assert descriptors() == before


def test_a_link_left_by_a_dead_simulator_is_taken_over(tmp_path: Path) -> None:
    link = tmp_path / "scanner"
    link.symlink_to("/dev/pts/999999")
    with PtyPort(EchoDevice(), BAUD, link_path=link), client(link) as host:
        host.write(b"mine now")
        assert host.read(8) == b"mine now"


def test_the_terminal_is_raw_before_anyone_opens_it() -> None:
    with PtyPort(EchoDevice(), BAUD) as port:
        descriptor = os.open(port.path, os.O_RDWR | os.O_NOCTTY)
        local_flags = termios.tcgetattr(descriptor)[3]
        os.close(descriptor)
    assert not local_flags & (termios.ECHO | termios.ICANON | termios.ISIG)
