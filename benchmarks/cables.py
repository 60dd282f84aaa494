"""A cable pulled again and again, and a line at full rate: `python -m benchmarks.cables KIND [--cycles N]`.

Simulated device, pseudo-terminal and driver in one process: how long after the return of the cable lines (of a stage:
readings) come again, whether anything is left behind, and how much of the line's time the driver keeps up with.
"""

import argparse
import json
import os
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from drivers.scanline import DeviceInfo, Profile, SensorGeometry
from drivers.scanners.free_running import FreeRunner
from drivers.scanners.known import open_free_running
from drivers.scanners.native import NativeScanner
from drivers.stages.known import KNOWN as KNOWN_STAGES
from drivers.stages.serial_stage import SerialStage
from drivers.stages.setup import StageSetup, complete_options
from simulators.devices.grbl import GrblDevice
from simulators.devices.marlin import MarlinDevice
from simulators.devices.native import NativeDevice
from simulators.devices.rplidar import S1, RplidarDevice
from simulators.devices.zaber import ZaberDevice
from simulators.known import KNOWN_DEVICES, PassingPart
from simulators.parts import plate
from simulators.pty_port import PtyPort, SerialDevice

_PATIENCE_S = 120.0
_TICK_S = 0.05
_PAUSED_S = 0.5
_NATIVE_RATE = 3_000_000
_STAGE_RATE = 115_200
_STAGES: dict[str, Callable[[], SerialDevice]] = {"grbl": GrblDevice, "marlin": MarlinDevice, "zaber": ZaberDevice}
KINDS = ("native", *KNOWN_DEVICES, *_STAGES)


class Subject(Protocol):
    """A driver under trial."""

    def fetch(self, timeout_s: float) -> int:
        """Lines or readings that came since the last call."""

    def told(self) -> dict[str, object]:
        """Its accounts."""


@dataclass
class ScannerSubject:
    """A scanner that measures."""

    scanner: NativeScanner | FreeRunner

    def fetch(self, timeout_s: float) -> int:
        """Profiles that came."""
        return sum(isinstance(item, Profile) for item in self.scanner.events(timeout_s))

    def told(self) -> dict[str, object]:
        """The exact accounts, and whether they balance: as a whole and for each pass."""
        tally = self.scanner.tally()
        passes = all(one.lines.balances and one.chunks.balances for one in tally.passes.values())
        return {
            "account_balances": tally.lines.balances and tally.chunks.balances and passes,
            "lines": tally.to_dict()["lines"],
            "damage": tally.damage,
        }


@dataclass
class StageSubject:
    """A stage that is read, at rest."""

    stage: SerialStage

    def fetch(self, timeout_s: float) -> int:
        """Readings that came."""
        time.sleep(timeout_s)
        return len(self.stage.readings())

    def told(self) -> dict[str, object]:
        """Whether it still knows where it is."""
        return {"position_known": self.stage.position_known}


class Pauses:
    """Notes when this process as a whole was not let run: a machine that is shared, or a debugger."""

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "Pauses":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def reset(self) -> float:
        """The longest pause since the last call, in seconds."""
        longest, self.longest_s = self.longest_s, 0.0
        return longest

    def _watch(self) -> None:
        before = time.monotonic()
        while not self._over.wait(_TICK_S):
            now = time.monotonic()
            self.longest_s = max(self.longest_s, now - before - _TICK_S)
            before = now


def descriptors() -> int:
    """Open file descriptors of this process."""
    return len(list(Path("/proc/self/fd").iterdir()))


def native_device(n_points: int) -> NativeDevice:
    """A scanner over a plane, whose stage is never at its end."""
    geometry = SensorGeometry(np.array([0.0, 0.0, 100.0]), np.array([0.0, 50.0, 100.0]), (-20.0, 20.0), 0.01)
    info = DeviceInfo("SIM-0001", "M", "F", "C", 1, n_points, geometry)
    line = np.linspace(-20.0, 20.0, n_points), np.zeros(n_points)
    return NativeDevice(
        info, lambda _at_mm: line, rng=np.random.default_rng(1), travel_mm=(-1.0, 1e6), max_line_rate_hz=10_000.0
    )


def device_of(kind: str, *, is_fast: bool) -> tuple[SerialDevice, int]:
    """A device of the kind over a plate, and the rate it begins at."""
    if kind in _STAGES:
        return _STAGES[kind](), _STAGE_RATE
    if kind == "native":
        return native_device(1_280 if is_fast else 200), _NATIVE_RATE
    if kind == "rplidar" and is_fast:
        return RplidarDevice(lambda angles, _: np.full(len(angles), 900.0), S1), S1.baud_rate
    known = KNOWN_DEVICES[kind]
    return known.makes(PassingPart(plate(), 0.0, np.random.default_rng(1))), known.baud_rate


def enter(
    kind: str, path: str, rate: int, line_rate_hz: float
) -> tuple[Subject, NativeScanner | FreeRunner | SerialStage]:
    """The driver, entered and at work."""
    if kind in _STAGES:
        known = KNOWN_STAGES[kind]
        options = complete_options(kind, known.options, known.probe_options)
        stage = known.opens(StageSetup(path, rate, options=options))
        assert isinstance(stage, SerialStage)
        stage.enter()
        stage.home()
        return StageSubject(stage), stage
    if kind == "native":
        native = NativeScanner(path, rate)
        native.enter()
        native.start_pass(0.1, 0.0, 9e5, line_rate_hz)
        return ScannerSubject(native), native
    scanner = open_free_running(kind, path, rate)
    assert isinstance(scanner, FreeRunner)
    scanner.enter()
    scanner.start_profiles()
    return ScannerSubject(scanner), scanner


def pull_and_return(kind: str, cycles: int, link: Path) -> dict[str, object]:
    """Pull the cable `cycles` times; seconds from its return until the first line or reading."""
    device, rate = device_of(kind, is_fast=False)
    back_s: list[float] = []
    paused: list[float] = []
    before = threading.active_count(), descriptors()
    with (
        Pauses() as pauses,
        PtyPort(device, rate, rng=np.random.default_rng(2), heeds_client_rate=True, link_path=link) as port,
    ):
        subject, driver = enter(kind, str(link), rate, 200.0)
        threads, files = threading.active_count(), descriptors()
        for number in range(cycles):
            port.unplug()
            time.sleep(0.05 + 0.002 * (number % 7))  # it comes back at different moments of the driver's round
            subject.fetch(0.0)
            port.replug()
            pauses.reset()
            begun_s = time.monotonic()
            while not subject.fetch(0.01):
                if time.monotonic() - begun_s > _PATIENCE_S:
                    raise TimeoutError(f"not back after {_PATIENCE_S} s")
            took_s, pause_s = time.monotonic() - begun_s, pauses.reset()
            (paused if pause_s > _PAUSED_S else back_s).append(took_s)
        during = {"threads": threading.active_count() - threads, "descriptors": descriptors() - files}
        told = subject.told()
        driver.exit()
    after = {"threads": threading.active_count() - before[0], "descriptors": descriptors() - before[1]}
    p50, p99 = np.percentile(back_s, [50, 99])
    return {
        "cycles": cycles,
        "while_the_process_was_paused_s": [round(took_s, 3) for took_s in paused],
        "back_s": {"p50": round(p50, 3), "p99": round(p99, 3), "max": round(max(back_s), 3)},
        "left_behind": during,
        "left_behind_after_exit": after,
    } | told


def keep_up(kind: str, seconds: float, line_rate_hz: float) -> dict[str, object]:
    """Read for so long: bytes a second against the line's own, and what was lost."""
    device, rate = device_of(kind, is_fast=True)
    with PtyPort(device, rate, rng=np.random.default_rng(2), heeds_client_rate=kind != "native") as port:
        subject, driver = enter(kind, str(port.path), rate, line_rate_hz)
        subject.fetch(2.0)
        begun_s, begun_bytes, busy_s, n = time.monotonic(), port.counts.sent_bytes, time.process_time(), 0
        while time.monotonic() - begun_s < seconds:
            n += subject.fetch(0.1)
        took_s, n_bytes = time.monotonic() - begun_s, port.counts.sent_bytes - begun_bytes
        busy_s = time.process_time() - busy_s
        line_rate = getattr(driver, "baud_rate", None) or rate
        told = subject.told()
        driver.exit()
    return {
        "baud_rate": line_rate,
        "a_second": round(n / took_s, 2),
        "bytes_per_s": round(n_bytes / took_s),
        "share_of_line": round(n_bytes / took_s / (line_rate / 10), 3),
        "cpu_share_of_driver_and_simulator": round(busy_s / took_s, 3),
    } | told


def main() -> None:
    """Print the figures as a line of JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cables")
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("--cycles", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--line-rate", type=float, default=100.0, help="of the native scanner at full rate, in Hz")
    given = parser.parse_args()
    figures: dict[str, object] = {"load_before": os.getloadavg()[0]}
    if given.seconds:
        figures["keep_up"] = keep_up(given.kind, given.seconds, given.line_rate)
    if given.cycles:
        with tempfile.TemporaryDirectory() as folder:
            figures["cable"] = pull_and_return(given.kind, given.cycles, Path(folder) / "device")
    figures["load_after"] = os.getloadavg()[0]
    print(json.dumps({"kind": given.kind} | figures), flush=True)


if __name__ == "__main__":
    main()
