"""A port is opened once, by a path and nothing else, and says plainly what is wrong."""

import os
import pty
import termios
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.errors import (
    PortAbsent,
    PortBusy,
    PortLost,
    PortNotPermitted,
    PortNotSerial,
    PortRateRefused,
)
from drivers.port import ModemLines, Port, _explain, lasting_path


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """A pseudo-terminal: its master's descriptor and its path."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(slave)
    os.close(master)


def open_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir())) if Path("/proc/self/fd").exists() else 0


def test_bytes_pass_both_ways_unchanged(terminal: tuple[int, str]) -> None:
    master, path = terminal
    port = Port(path, 115_200)
    every_byte = bytes(range(256))
    assert port.read(0.0) == b""
    assert port.write(every_byte) == 256
    assert os.read(master, 1000) == every_byte
    os.write(master, every_byte)
    assert port.read(1.0) == every_byte
    port.close()


def test_a_port_without_a_switch_for_latency_says_so_in_the_log(
    terminal: tuple[int, str], caplog: pytest.LogCaptureFixture
) -> None:
    _, path = terminal
    with caplog.at_level("INFO", "drivers.port"):
        Port(path, 115_200).close()
    assert f"{path} has no switch for low latency" in caplog.text  # a pseudo-terminal has none


def test_a_port_that_is_not_there_is_absent(tmp_path: Path) -> None:
    with pytest.raises(PortAbsent, match="does not exist or is not connected"):
        Port(str(tmp_path / "ttyUSB9"), 115_200)
    dangling = tmp_path / "link"
    dangling.symlink_to(tmp_path / "gone")
    with pytest.raises(PortAbsent):
        Port(str(dangling), 115_200)


def test_a_port_that_is_open_is_busy_and_free_again_when_closed(terminal: tuple[int, str]) -> None:
    _, path = terminal
    before = open_descriptors()
    first = Port(path, 115_200)
    for _ in range(5):
        with pytest.raises(PortBusy, match="held by another program; close that program"):
            Port(path, 115_200)
    first.close()
    Port(path, 115_200).close()
    assert open_descriptors() == before


@pytest.mark.parametrize(
    "text", ["socket://localhost:1", "spy:///dev/null?file=x", "loop://", "COM1", "", "../dev/null", "/dev/\0null"]
)
def test_what_a_user_writes_is_never_taken_for_a_url(text: str, tmp_path: Path) -> None:
    with pytest.raises(PortNotSerial, match="give one such as /dev/ttyUSB0"):
        Port(text, 115_200)


def test_files_and_other_devices_are_not_serial(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"text")
    for path in (str(tmp_path / "file"), str(tmp_path), "/dev/null"):
        with pytest.raises(PortNotSerial):
            Port(path, 115_200)


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_a_forbidden_port_names_the_group_to_join(terminal: tuple[int, str]) -> None:
    _, path = terminal
    Path(path).chmod(0)
    with pytest.raises(PortNotPermitted, match="join the group"):
        Port(path, 115_200)


def test_a_refusal_by_the_system_names_the_path_and_the_group(terminal: tuple[int, str]) -> None:
    _, path = terminal
    error = _explain(path, PermissionError(13, "Permission denied"))
    assert isinstance(error, PortNotPermitted)
    assert error.path == path
    assert path in str(error)
    assert "group" in str(error)


def test_a_rate_that_cannot_be_is_refused(terminal: tuple[int, str]) -> None:
    _, path = terminal
    before = open_descriptors()
    with pytest.raises(PortRateRefused, match="refuses -5 baud"):
        Port(path, -5)
    assert open_descriptors() == before


def test_a_pulled_port_is_lost_on_reading_and_on_writing() -> None:
    before = open_descriptors()
    master, slave = pty.openpty()
    port = Port(os.ttyname(slave), 115_200)
    os.close(slave)
    os.close(master)
    with pytest.raises(PortLost, match="was pulled out or hung up"):
        port.read(0.1)
    with pytest.raises(PortLost, match="plug it in again"):
        port.write(b"x")
    port.close()
    assert open_descriptors() == before


def test_a_port_nobody_reads_takes_what_it_can_and_never_waits(terminal: tuple[int, str]) -> None:
    _, path = terminal
    port = Port(path, 115_200)
    written = [port.write(b"x" * 10_000) for _ in range(20)]
    assert written[-1] == 0
    assert sum(written) > 0
    port.close()


def test_the_rate_of_an_open_port_can_be_changed_and_a_refused_one_leaves_the_old(terminal: tuple[int, str]) -> None:
    master, path = terminal
    port = Port(path, 9_600)
    port.set_baud_rate(38_400)
    assert termios.tcgetattr(master)[5] == termios.B38400
    port.set_baud_rate(256_000)  # no constant of POSIX has it
    with pytest.raises(PortRateRefused, match="refuses -1 baud"):
        port.set_baud_rate(-1)
    assert port.baud_rate == 256_000
    port.set_baud_rate(19_200)
    assert termios.tcgetattr(master)[5] == termios.B19200
    port.close()


def test_modem_lines_that_are_not_there_are_no_error(terminal: tuple[int, str]) -> None:
    _, path = terminal
    port = Port(path, 115_200, ModemLines(dtr=False, rts=False, hang_up=False))
    assert port.set_dtr(True) is False
    assert port.overruns() is None
    assert not termios.tcgetattr(port._fd)[2] & termios.HUPCL
    port.close()


def test_a_port_is_found_again_by_its_link_when_its_number_changes(tmp_path: Path) -> None:
    by_id = tmp_path / "by-id"
    by_id.mkdir()
    first, second = tmp_path / "ttyUSB0", tmp_path / "ttyUSB1"
    first.touch()
    link = by_id / "usb-Maker_Scanner_0001-if00-port0"
    link.symlink_to(first)
    assert lasting_path(str(first), by_id) == str(link)
    assert lasting_path(str(link), by_id) == str(link)
    second.touch()
    assert lasting_path(str(second), by_id) == str(second)
    assert lasting_path(str(tmp_path / "gone"), by_id) == str(tmp_path / "gone")
