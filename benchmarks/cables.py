"""A cable pulled again and again, and a line at full rate: `python -m benchmarks.cables KIND [--cycles N]`.

Simulated device, pseudo-terminal and driver in one process: how long after the return of the cable profiles come again,
whether anything is left behind, and how much of the line's time the driver keeps up with.
"""

import argparse
import json
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from drivers.scanline import Profile
from drivers.scanners.known import open_free_running
from simulators.devices.rplidar import S1, RplidarDevice
from simulators.known import KNOWN_DEVICES, PassingPart
from simulators.parts import plate
from simulators.pty_port import PtyPort, SerialDevice

_PATIENCE_S = 120.0


def descriptors() -> int:
    """Open file descriptors of this process."""
    return len(list(Path("/proc/self/fd").iterdir()))


def device_of(kind: str) -> SerialDevice:
    """A device of the kind over a plate."""
    return KNOWN_DEVICES[kind].makes(PassingPart(plate(), 0.0, np.random.default_rng(1)))


def pull_and_return(kind: str, cycles: int, link: Path) -> dict[str, object]:
    """Pull the cable `cycles` times; seconds from its return until the first profile."""
    device = device_of(kind)
    rate = KNOWN_DEVICES[kind].baud_rate
    back_s: list[float] = []
    with (
        PtyPort(device, rate, rng=np.random.default_rng(2), heeds_client_rate=True, link_path=link) as port,
        open_free_running(kind, str(link), rate) as scanner,
    ):
        scanner.start_profiles()
        threads, files = threading.active_count(), descriptors()
        for _ in range(cycles):
            port.unplug()
            time.sleep(0.05)
            scanner.events(0.0)
            port.replug()
            begun_s = time.monotonic()
            while not any(isinstance(item, Profile) for item in scanner.events(0.01)):
                if time.monotonic() - begun_s > _PATIENCE_S:
                    raise TimeoutError(f"not back after {_PATIENCE_S} s")
            back_s.append(time.monotonic() - begun_s)
        more = {"threads": threading.active_count() - threads, "descriptors": descriptors() - files}
        tally = scanner.tally()
    p50, p99 = np.percentile(back_s, [50, 99])
    return {
        "cycles": cycles,
        "back_s": {"p50": round(p50, 3), "p99": round(p99, 3), "max": round(max(back_s), 3)},
        "left_behind": more,
        "account_balances": tally.lines.balances,
        "lines": tally.to_dict()["lines"],
    }


def keep_up(kind: str, seconds: float) -> dict[str, object]:
    """Read for so long: bytes a second against the line's own, and what was lost."""
    device = RplidarDevice(lambda angles, _: np.full(len(angles), 900.0), S1) if kind == "rplidar" else device_of(kind)
    rate = getattr(device, "baud_rate", KNOWN_DEVICES[kind].baud_rate)
    with (
        PtyPort(device, rate, rng=np.random.default_rng(2), heeds_client_rate=True) as port,
        open_free_running(kind, str(port.path), rate) as scanner,
    ):
        scanner.start_profiles()
        scanner.events(2.0)
        begun_s, begun_bytes, n = time.monotonic(), port.counts.sent_bytes, 0
        while time.monotonic() - begun_s < seconds:
            n += sum(isinstance(item, Profile) for item in scanner.events(0.1))
        took_s, n_bytes = time.monotonic() - begun_s, port.counts.sent_bytes - begun_bytes
        line_rate = scanner.baud_rate or rate
        tally = scanner.tally()
    return {
        "baud_rate": line_rate,
        "profiles_per_s": round(n / took_s, 2),
        "bytes_per_s": round(n_bytes / took_s),
        "share_of_line": round(n_bytes / took_s / (line_rate / 10), 3),
        "lines": tally.to_dict()["lines"],
        "damage": tally.damage,
    }


def main() -> None:
    """Print the figures as a line of JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cables")
    parser.add_argument("kind", choices=KNOWN_DEVICES)
    parser.add_argument("--cycles", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=10.0)
    given = parser.parse_args()
    figures = {"keep_up": keep_up(given.kind, given.seconds)}
    if given.cycles:
        with tempfile.TemporaryDirectory() as folder:
            figures["cable"] = pull_and_return(given.kind, given.cycles, Path(folder) / "scanner")
    print(json.dumps({"kind": given.kind} | figures), flush=True)


if __name__ == "__main__":
    main()
