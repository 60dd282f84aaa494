"""Which serial ports there are and what names lead to them, read from the kernel; opens none of them.

The kernel may give a replugged adapter another number. Names that last: a link in /dev/serial/by-id (vendor, product,
serial number), one in /dev/serial/by-path (which socket), or `usb:VID:PID:SERIAL`, which is looked up here.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from drivers.errors import PortAbsent, PortError, PortNotSerial

_CLASS = Path("/sys/class/tty")
_LINKS = Path("/dev/serial")
_DEVICES = Path("/dev")


@dataclass(frozen=True, slots=True)
class PortName:
    """A serial port that is there. Texts are empty, `latency_ms` None, where the kernel does not tell.

    `vendor` and `product_id` are the four hexadecimal digits of USB, `driver` the kernel's, `latency_ms` how long an
    FTDI adapter collects bytes before it hands them on.
    """

    path: str
    by_id: str = ""
    by_path: str = ""
    vendor: str = ""
    product_id: str = ""
    serial: str = ""
    product: str = ""
    driver: str = ""
    latency_ms: int | None = None

    @property
    def lasting(self) -> str:
        """The name to write into a rig file: the one that survives a replug best."""
        return self.by_id or self.by_path or self.path

    @property
    def is_built_in(self) -> bool:
        """True for a port of the computer itself: its name stays, and nothing need be plugged in there."""
        return not self.vendor and Path(self.path).name.startswith("ttyS")

    @property
    def usb_name(self) -> str:
        """`usb:VID:PID[:SERIAL]`, empty for a port that is none of USB."""
        if not self.vendor:
            return ""
        return f"usb:{self.vendor}:{self.product_id}" + (f":{self.serial}" if self.serial else "")


def list_ports(tty_class: Path = _CLASS, links: Path = _LINKS, devices: Path = _DEVICES) -> list[PortName]:
    """Return the serial ports with hardware behind them, by path; none where the kernel tells of none."""
    by_id, by_path = _targets(links / "by-id"), _targets(links / "by-path")
    found: list[PortName] = []
    for entry in _children(tty_class):
        device = entry / "device"
        driver = _link_name(device / "driver")
        if not driver or driver == "serial8250" or (driver == "port" and not _text(entry / "irq").strip("0")):
            continue
        path = str(devices / entry.name)
        usb = _usb_device(device)
        vendor, product_id = _text(usb / "idVendor") if usb else "", _text(usb / "idProduct") if usb else ""
        latency = _text(device / "latency_timer")
        found.append(
            PortName(
                path,
                by_id.get(entry.name, ""),
                by_path.get(entry.name, ""),
                vendor,
                product_id,
                _text(usb / "serial") if usb else "",
                _text(usb / "product") if usb else "",
                driver,
                int(latency) if latency.isdigit() else None,
            )
        )
    return sorted(found, key=lambda port: port.path)


def find_port(name: str, ports: list[PortName] | None = None) -> str:
    """Return the path of a port by its name, which is a path already or `usb:VID:PID[:SERIAL]`.

    Raises
    ------
    PortAbsent : no such adapter is plugged in.
    PortNotSerial : the name is none of a port.
    PortError : several adapters answer to the name.
    """
    if not name.startswith("usb:"):
        return name
    parts = name.split(":")
    if not 3 <= len(parts) <= 4 or not all(parts):
        raise PortNotSerial(name, f"{name!r} is no name of a port; write usb:VID:PID or usb:VID:PID:SERIAL")
    wanted = [part.lower() for part in parts[1:3]]
    serial = parts[3] if len(parts) == 4 else None
    matching = [
        port
        for port in (list_ports() if ports is None else ports)
        if [port.vendor.lower(), port.product_id.lower()] == wanted and serial in (None, port.serial)
    ]
    if not matching:
        raise PortAbsent(name, f"no adapter {name} is plugged in; plug it in, or see `scanner devices` for those there")
    if len(matching) > 1:
        names = ", ".join(port.usb_name if port.serial else port.by_path or port.path for port in matching)
        raise PortError(name, f"{len(matching)} adapters answer to {name}; name one of {names}")
    return matching[0].path


def is_among(name: str, others: Iterable[str]) -> bool:
    """Return whether one of the other names leads to the same port as `name`, which is there."""

    def real(one: str) -> Path | None:
        try:
            return Path(find_port(one)).resolve()
        except (PortError, OSError, RuntimeError, ValueError):  # absent, a loop of links, half a character
            return None

    here = real(name)
    return here is not None and any(real(other) == here for other in others)


def _children(folder: Path) -> list[Path]:
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def _targets(folder: Path) -> dict[str, str]:
    """Return for each device's own name the first link in `folder` that leads to it."""
    found: dict[str, str] = {}
    for link in _children(folder):
        found.setdefault(link.resolve().name, str(link))
    return found


def _link_name(link: Path) -> str:
    try:
        return link.resolve(strict=True).name
    except (OSError, RuntimeError):
        return ""


def _usb_device(device: Path) -> Path | None:
    """Return the folder of the USB device behind a tty: the first one upwards that has a vendor."""
    try:
        folder = device.resolve(strict=True)
    except (OSError, RuntimeError):
        return None
    for above in (folder, *list(folder.parents)[:6]):
        if (above / "idVendor").is_file():
            return above
    return None


def _text(file: Path) -> str:
    try:
        text = file.read_text(encoding="utf-8", errors="replace")[:256].strip()
    except OSError:
        return ""
    return "".join(character for character in text if character.isprintable())
