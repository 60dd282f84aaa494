"""What is wrong with ports, permissions and a rig, and what to do about it; changes nothing, moves nothing.

The kernel's folders are arguments, so that a machine can be described in a test.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from drivers.errors import DriverError, PortAbsent, PortError, PortNotSerial
from drivers.port import Port
from drivers.port_names import PortName, find_port, list_ports
from drivers.rig_description import DeviceChoice, PairBy, RigDescription
from drivers.scanners.known import identify, known_scanner
from drivers.stages.known import identify_stage, known_stage, open_stage

UDEV_RULE = """\
# /etc/udev/rules.d/99-scanner-service.rules
# Serial adapters: for members of dialout, left alone by ModemManager, FTDI adapters without their 16 ms delay.
SUBSYSTEM=="tty", SUBSYSTEMS=="usb", GROUP="dialout", MODE="0660", ENV{ID_MM_DEVICE_IGNORE}="1"
ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"
"""
_MEDDLERS = {
    "ModemManager": "it sends modem commands to new adapters for about 10 s; install the udev rule (`scanner doctor "
    "--udev-rule`) or switch it off (sudo systemctl disable --now ModemManager)",
    "brltty": "it takes CH340 and CP210x adapters for braille displays; where there is none, remove it (sudo apt "
    "remove brltty)",
}


class Level(StrEnum):
    """How bad it is."""

    GOOD = "good"
    WARNING = "warning"
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at: what was found, and what to do about it (empty when it is good)."""

    level: Level
    about: str
    found: str
    remedy: str = ""


def check_machine(ports: Iterable[PortName] | None = None, processes: Path = Path("/proc")) -> list[Finding]:
    """Look at the adapters that are plugged in, and at programs known to meddle with them."""
    found_ports = list(list_ports() if ports is None else ports)
    findings = [finding for port in found_ports for finding in check_port(port)]
    if all(port.is_built_in for port in found_ports):
        own = "; a scanner on a port of the computer itself is found by `scanner devices --identify`"
        findings.append(
            Finding(
                Level.WARNING,
                "ports",
                "no serial adapter is plugged in",
                "plug it in; if it is, look at `dmesg` (a cable that only charges, too little power, no driver)"
                + (own if found_ports else ""),
            )
        )
    running = _running(processes)
    for name, remedy in _MEDDLERS.items():
        if name in running:
            findings.append(Finding(Level.WARNING, name, f"{name} is running", remedy))
    return findings


def check_port(port: PortName) -> list[Finding]:
    """Open a port and close it again; tell permission, owner, delay and how to name it."""
    findings: list[Finding] = []
    try:
        Port(port.path, 115_200).close()
    except PortError as error:
        found, _, remedy = str(error).partition("; ")
        findings.append(Finding(Level.PROBLEM, port.path, found, remedy or "see the message"))
        if not port.driver and isinstance(error, PortAbsent | PortNotSerial):  # no port: no more can be said of it
            return findings
    else:
        told = f"{port.product or port.driver or 'a serial port'}, can be opened"
        if port.is_built_in:
            told = "a serial port of the computer itself, which tells nothing of what is on it; can be opened"
        findings.append(Finding(Level.GOOD, port.path, f"{told}; name it {port.lasting}"))
    if port.latency_ms is not None and port.latency_ms > 1:
        findings.append(
            Finding(
                Level.WARNING,
                port.path,
                f"the adapter holds bytes back for up to {port.latency_ms} ms",
                "install the udev rule (`scanner doctor --udev-rule`) and plug it in again, or add those ms to "
                "latency_uncertainty_ms of the rig",
            )
        )
    if port.lasting == port.path and not port.is_built_in:
        findings.append(
            Finding(
                Level.WARNING,
                port.path,
                "it has no name that survives a replug",
                "install udev, or name it usb:VID:PID[:SERIAL] where it has one",
            )
        )
    return findings


def check_rig(description: RigDescription) -> list[Finding]:
    """Open what a rig names, ask who is there, and say what does not fit; nothing is moved."""
    findings = [*_check_named_port("scanner", description.scanner), *_check_named_port("stage", description.stage)]
    if not any(finding.level is Level.PROBLEM for finding in findings):
        findings += _check_scanner(description)
        findings += _check_stage(description)
    findings += _check_plan(description)
    return findings


def _check_named_port(about: str, choice: DeviceChoice) -> list[Finding]:
    if choice.port is None:
        return []
    try:
        path = find_port(choice.port)
    except PortError as error:
        found, _, remedy = str(error).partition("; ")
        return [Finding(Level.PROBLEM, about, found, remedy)]
    findings: list[Finding] = []
    if path.startswith(("/dev/ttyUSB", "/dev/ttyACM")) and choice.port == path:
        findings.append(
            Finding(
                Level.WARNING,
                about,
                f"{path} is named by a number that may change at the next replug",
                "name it by /dev/serial/by-id or usb:VID:PID:SERIAL (`scanner devices` shows both)",
            )
        )
    return findings


def _check_scanner(description: RigDescription) -> list[Finding]:
    choice = description.scanner
    try:
        known = known_scanner(choice.kind)
        rates = None if choice.baud_rate is None else (choice.baud_rate, *known.baud_rates)
        found = identify(find_port(choice.port or ""), [choice.kind], rates)
        others = None if found else identify(find_port(choice.port or ""))
    except DriverError as error:
        return [_problem("scanner", error)]
    if found is not None:
        told = f"{found.info.model} {found.info.device_id}, firmware {found.info.firmware}, at {found.baud_rate} baud"
        if choice.baud_rate not in (None, found.baud_rate) and not known.tries_rates:
            return [Finding(Level.PROBLEM, "scanner", told, f"write baud_rate = {found.baud_rate} under [scanner]")]
        return [Finding(Level.GOOD, "scanner", told)]
    if others is not None:
        return [
            Finding(
                Level.PROBLEM,
                "scanner",
                f"no {choice.kind} answers there, but a {others.scanner.name} does: {others.info.model}",
                f'write kind = "{others.scanner.name}" under [scanner], or name the other port',
            )
        ]
    return [
        Finding(
            Level.PROBLEM,
            "scanner",
            f"nothing answers on {choice.port} at any of its rates",
            "check its power and the cable (one of data, not of charge only), and that the port is the scanner's",
        )
    ]


def _check_stage(description: RigDescription) -> list[Finding]:
    choice = description.stage
    try:
        known = known_stage(choice.kind)
        if not known.baud_rates:
            return [Finding(Level.GOOD, "stage", f"{known.title}: nothing to ask")]
        stage = open_stage(description)
    except DriverError as error:
        return [_problem("stage", error)]
    try:
        told = stage.enter().identity
        position_known = stage.position_known
    except DriverError as error:
        return [_look_further(choice, error)]
    finally:
        stage.exit()
    findings = [Finding(Level.GOOD, "stage", told)]
    if known.is_driven and not position_known:
        findings.append(
            Finding(
                Level.WARNING,
                "stage",
                "it does not know where it is, and will refuse to move",
                "home it when you scan (`scanner scan --home`), or state where it is (--at MM)",
            )
        )
    return findings


def _look_further(choice: DeviceChoice, error: DriverError) -> Finding:
    """The stage did not answer as it is described: see whether it does at another rate, or as another kind."""
    if isinstance(error, PortError):
        return _problem("stage", error)
    try:
        path = find_port(choice.port or "")
        found = identify_stage(path, [choice.kind]) or identify_stage(path)
    except DriverError as further:
        return _problem("stage", further)
    if found is None:
        return _problem("stage", error)
    return Finding(
        Level.PROBLEM,
        "stage",
        f"{found.identity} ({found.stage.name}) answers at {found.baud_rate} baud",
        f'write kind = "{found.stage.name}" and baud_rate = {found.baud_rate} under [stage]',
    )


def _check_plan(description: RigDescription) -> list[Finding]:
    """What can be said without opening anything."""
    findings: list[Finding] = []
    by_time = description.pairing.by is PairBy.TIME
    speed = description.limits.speed_mm_per_s[1]
    if by_time and speed < float("inf"):
        off_mm = speed * description.pairing.latency_uncertainty_s
        findings.append(
            Finding(
                Level.GOOD if off_mm <= 0.05 else Level.WARNING,
                "pairing",
                f"at {speed:g} mm/s the uncertainty of the latency alone is worth {off_mm:.3g} mm along the travel",
                "" if off_mm <= 0.05 else "scan slower, at rest (--at-rest), or wire an encoder to the scanner",
            )
        )
    if _latency_matters(description.scanner.kind) and by_time and description.pairing.latency_s == 0.0:
        findings.append(
            Finding(
                Level.WARNING,
                "pairing",
                "latency_ms is 0: lines will lie behind by the scanner's latency times the speed",
                "scan an edge forwards and backwards: half of their distance over the speed is the latency",
            )
        )
    return findings


def _latency_matters(kind: str) -> bool:
    """True for a scanner that runs free, whose latency the rig file must tell."""
    try:
        return known_scanner(kind).runs_free
    except DriverError:
        return False


def _problem(about: str, error: DriverError) -> Finding:
    found, _, remedy = str(error).partition("; ")
    return Finding(Level.PROBLEM, about, found, remedy or "see docs/devices")


def _running(processes: Path) -> set[str]:
    """Return the names of the programs that run."""
    names: set[str] = set()
    try:
        entries = [entry for entry in processes.iterdir() if entry.name.isdigit()]
    except OSError:
        return names
    for entry in entries:
        try:
            names.add((entry / "comm").read_text(encoding="utf-8", errors="replace").strip())
        except OSError:
            continue
    return names
