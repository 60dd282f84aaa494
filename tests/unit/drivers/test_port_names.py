"""Names of ports, on a machine that is described in files: adapters with and without a serial number, and replugged."""

from pathlib import Path

import pytest

from drivers.doctor import Level, check_machine, check_port
from drivers.errors import PortAbsent, PortError, PortNotSerial
from drivers.port_names import PortName, find_port, list_ports


class Machine:
    """The folders of a kernel in a temporary folder."""

    def __init__(self, root: Path) -> None:
        self.tty, self.dev, self.links = root / "class", root / "dev", root / "dev" / "serial"
        self._devices = root / "devices"
        for folder in (self.tty, self.dev, self.links / "by-id", self.links / "by-path", self._devices):
            folder.mkdir(parents=True)

    def plug(self, name: str, vendor: str, product: str, serial: str, socket: str, latency: str = "") -> None:
        usb = self._devices / socket
        device = usb / "1.0" / name
        driver = self._devices / "drivers" / "ftdi_sio"
        for folder in (device, driver, self.tty / name):
            folder.mkdir(parents=True, exist_ok=True)
        (usb / "idVendor").write_text(vendor + "\n")
        (usb / "idProduct").write_text(product + "\n")
        (usb / "product").write_text("USB <-> Serial\x00\n")
        if serial:
            (usb / "serial").write_text(serial + "\n")
        if latency:
            (device / "latency_timer").write_text(latency + "\n")
        (device / "driver").symlink_to(driver)
        (self.tty / name / "device").symlink_to(device)
        (self.dev / name).write_text("")
        if serial:
            (self.links / "by-id" / f"usb-{serial}").symlink_to(self.dev / name)
        (self.links / "by-path" / f"pci-{socket}").symlink_to(self.dev / name)

    def ports(self) -> list[PortName]:
        return list_ports(self.tty, self.links, self.dev)


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_an_adapter_is_listed_with_the_names_that_survive_a_replug(machine: Machine) -> None:
    machine.plug("ttyUSB0", "0403", "6001", "A1B2", "usb1-3", "16")
    (machine.tty / "tty7").mkdir()  # a console: nothing is behind it
    (port,) = machine.ports()
    assert (port.vendor, port.product_id, port.serial, port.latency_ms) == ("0403", "6001", "A1B2", 16)
    assert port.product == "USB <-> Serial"
    assert port.lasting.endswith("by-id/usb-A1B2")
    assert port.usb_name == "usb:0403:6001:A1B2"
    findings = [item for item in check_port(port) if "16 ms" in item.found]
    assert findings[0].level is Level.WARNING
    assert "udev rule" in findings[0].remedy


def test_a_replugged_adapter_is_found_under_its_new_number(machine: Machine) -> None:
    machine.plug("ttyUSB3", "0403", "6001", "A1B2", "usb1-3")
    machine.plug("ttyUSB0", "0403", "6001", "C3D4", "usb1-4")
    assert find_port("usb:0403:6001:A1B2", machine.ports()).endswith("ttyUSB3")
    assert find_port("usb:0403:6001:C3D4", machine.ports()).endswith("ttyUSB0")
    assert find_port("/dev/ttyUSB9") == "/dev/ttyUSB9"


def test_adapters_that_cannot_be_told_apart_are_named_by_their_sockets(machine: Machine) -> None:
    machine.plug("ttyUSB0", "1a86", "7523", "", "usb1-3")
    machine.plug("ttyUSB1", "1a86", "7523", "", "usb1-4")
    with pytest.raises(PortError, match=r"2 adapters answer to usb:1A86:7523; name one of .*pci-usb1-3.*pci-usb1-4"):
        find_port("usb:1A86:7523", machine.ports())
    with pytest.raises(PortAbsent, match="plug it in"):
        find_port("usb:0403:6001", machine.ports())
    for wrong in ("usb:", "usb:1a86", "usb:1a86:7523:A:B", "usb:::"):
        with pytest.raises(PortNotSerial):
            find_port(wrong, machine.ports())


def test_a_machine_without_adapters_and_with_meddling_programs_is_told(tmp_path: Path) -> None:
    process = tmp_path / "4711"
    process.mkdir()
    (process / "comm").write_text("ModemManager\n")
    findings = check_machine([], tmp_path)
    assert [finding.about for finding in findings] == ["ports", "ModemManager"]
    assert all(finding.level is Level.WARNING and finding.remedy for finding in findings)
    assert list_ports(tmp_path / "none", tmp_path / "none", tmp_path) == []


def test_a_port_of_the_computer_itself_is_no_adapter_and_needs_no_other_name(tmp_path: Path) -> None:
    own, adapter = PortName("/dev/ttyS0", driver="port"), PortName("/dev/ttyUSB0", vendor="0403", driver="ftdi_sio")
    assert [port.is_built_in for port in (own, adapter)] == [True, False]
    said = check_machine([own], tmp_path)
    assert not any("survives a replug" in item.found for item in said)
    (about_adapters,) = (item for item in said if "no serial adapter is plugged in" in item.found)
    assert "a port of the computer itself" in about_adapters.remedy
    both = check_machine([own, adapter], tmp_path)
    assert not any("no serial adapter" in item.found for item in both)
    assert [item.about for item in both if "survives a replug" in item.found] == ["/dev/ttyUSB0"]
