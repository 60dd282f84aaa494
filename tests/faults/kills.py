"""The whole service is killed at any instant of a scan: what it acknowledged is there, once and whole.

A simulated scanner on a pseudo-terminal feeds one session, a client pushes lines into another; each kill comes at a
random instant, also during the start. Then the record is read beside no service, and compared with what both had been
told: the client each line's answer, the viewer how far the scanner's lines are durable. The next service finds what
the last one left, and the client goes on, offering its last lines again.

This proves what the process promises, not what the disk does: the page cache survives a killed process.
"""

import contextlib
import http.client
import itertools
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivers.scanline import DeviceInfo, SensorGeometry
from scanner_service.analysis.intake import StoredLine
from scanner_service.storage.record import Record
from simulators.devices.native import NativeDevice
from simulators.pty_port import PtyPort

ROOT = Path(__file__).resolve().parents[2]
KILLS_A_RECORD = 24
KILLS_A_SESSION = 4
POINTS_OF_SCANNER = 24
QUANTA_PER_MM = 8192  # of the stored truth, stated here once more
_BREATH_S = 0.1
"""What a client waits after a refusal."""
_DEVICE = "KILL-1"
_SETTINGS = {"max_points": 300_000}


@dataclass
class Account:
    """What was seen: kills, lines acknowledged in all, lines looked for that were lost, doubled or torn.

    `pushed_again` are lines that a starved service refused by name, and that the client pushed once more.
    """

    kills: int = 0
    acknowledged: int = 0
    of_scanner: int = 0
    while_starting: int = 0
    pushed_again: int = 0
    lost: int = 0
    doubled: int = 0
    torn: int = 0
    first_fault: str = ""

    def fault(self, kind: str, text: str) -> None:
        setattr(self, kind, getattr(self, kind) + 1)
        self.first_fault = self.first_fault or f"kill {self.kills}: {text}"


@dataclass
class Pushed:
    """A session of pushed lines: the number that the record gave each acknowledged line; how often one was refused."""

    session: str = ""
    acknowledged: dict[int, int] = field(default_factory=dict)
    refused: int = 0

    def first_missing(self) -> int:
        """The lowest index that is not acknowledged: a refused line may lie before others that were not."""
        return next(index for index in itertools.count() if index not in self.acknowledged)


@dataclass
class _Scanned:
    """A session of the scanner: how many of its lines were told to be durable, and the last one's index."""

    session: str = ""
    boot_id: int = 0
    lines: int = 0
    line_index: int = -1


def scene(stage_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """What the scanner sees at a stage position; the same each time, so that a torn line is seen."""
    x_mm = np.linspace(-2.0, 2.0, POINTS_OF_SCANNER)
    return x_mm, 10.0 + np.sin(3.0 * stage_mm) + 0.1 * x_mm


class Refused(Exception):
    """The service answered that it could not do it now: the scanner or the disk was too slow on a busy machine."""


class Zygote:
    """Services in processes of their own, one after another."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "tests.faults.service_zygote"]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, bufsize=1
        )
        self._hear("ready")

    def start(self, data: Path) -> int:
        """Start a service on a data folder; its process number."""
        self._say(str(data))
        return int(self._hear("started")["started"])

    def wait_for_url(self) -> str:
        """Where the service listens."""
        return str(self._hear("url")["url"])

    def wait_for_end(self) -> bool:
        """Wait until the service is gone; True when it was killed."""
        return bool(self._hear("ended")["killed"])

    def close(self) -> None:
        """End the zygote."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(30)
        self._process.stdout.close()

    def _say(self, text: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(text + "\n")

    def _hear(self, what: str) -> dict[str, Any]:
        assert self._process.stdout is not None
        while line := self._process.stdout.readline():
            told: dict[str, Any] = json.loads(line)
            if what in told:
                return told
            if "ended" in told:
                raise RuntimeError("the service ended by itself; see its log")
        raise RuntimeError("the zygote ended")


class Client:
    """A plain HTTP client of a service that may vanish at any moment."""

    def __init__(self, url: str, key: str) -> None:
        self._host = url.removeprefix("http://")
        self._headers = {"Authorization": f"Bearer {key}", "Content-Type": "application/json"}
        self._connection = http.client.HTTPConnection(self._host, timeout=30)

    def ask(self, method: str, path: str, body: Any = None) -> Any:
        """The answer as JSON; raises OSError or HTTPException when the service is gone."""
        self._connection.request(method, path, None if body is None else json.dumps(body), self._headers)
        answer = self._connection.getresponse()
        text = answer.read()
        if answer.status in (502, 503):
            raise Refused(text)
        if answer.status == 409 and "lines" in (told := json.loads(text)):
            return told  # each line has its outcome
        if answer.status >= 300:
            raise RuntimeError(f"{method} {path}: {answer.status} {text[:300]!r}")
        return json.loads(text) if text else None

    def close(self) -> None:
        """Let go."""
        self._connection.close()


_GONE = (OSError, http.client.HTTPException)


def pushed_line(index: int) -> dict[str, Any]:
    """A line as a client pushes it; its content follows from its index."""
    y_mm = index * 0.25
    points = [[0.125 * place, y_mm, (index * 7 + place * 3) % 97 * 0.5] for place in range(3)]
    return {
        "line_index": index,
        "line_spacing_mm": 0.25,
        "laser_mm": [0.0, y_mm, 200.0],
        "plane_normal": [0.0, 1.0, 0.0],
        "travel": [0.0, 1.0, 0.0],
        "position_mm": y_mm,
        "points_mm": points,
    }


def kill_services(
    kills: int, lines: int, seed: int, on_progress: Callable[[Account], None] = lambda account: None
) -> Account:
    """Kill at least `kills` services, and as many more as it takes to have `lines` lines acknowledged."""
    account, rng = Account(), random.Random(seed)
    zygote = Zygote()
    try:
        while account.kills < kills or account.acknowledged < lines:
            with tempfile.TemporaryDirectory(prefix="kills-") as folder, _scanner(rng) as scanner:
                data, pushed = Path(folder) / "data", [Pushed()]
                scanned: list[_Scanned] = []
                wanted = max(1, (lines - account.acknowledged) // max(1, kills - account.kills))
                for number in range(min(KILLS_A_RECORD, max(1, kills - account.kills))):
                    if number % KILLS_A_SESSION == KILLS_A_SESSION - 1:
                        pushed.append(Pushed())
                    before, refused = len(pushed[-1].acknowledged), pushed[-1].refused
                    latest = _one_service(zygote, data, scanner, pushed[-1], rng, wanted, account)
                    account.kills += 1
                    account.acknowledged += len(pushed[-1].acknowledged) - before + latest.lines
                    account.of_scanner += latest.lines
                    account.pushed_again += pushed[-1].refused - refused
                    scanned.append(latest)
                    _look(data / "record.sqlite", pushed[-1:], scanned[-1:], account)
                    on_progress(account)
                _look(data / "record.sqlite", pushed, scanned, account)
    finally:
        zygote.close()
    return account


@contextlib.contextmanager
def _scanner(rng: random.Random) -> Iterator[PtyPort]:
    geometry = SensorGeometry(np.array([0.0, 0.0, 90.0]), np.zeros(3), (-20.0, 20.0), 0.01)
    info = DeviceInfo(_DEVICE, "M", "F", "C", rng.getrandbits(32), POINTS_OF_SCANNER, geometry)
    device = NativeDevice(info, scene, rng=np.random.default_rng(rng.getrandbits(32)), buffer_bytes=262_144)
    port = PtyPort(device, 3_000_000)
    port.start()
    try:
        yield port
    finally:
        port.stop()


def _one_service(
    zygote: Zygote,
    data: Path,
    scanner: PtyPort,
    pushed: Pushed,
    rng: random.Random,
    wanted: int,
    account: Account,
) -> _Scanned:
    """Start a service, scan and push, kill it at some instant; what it told of the scanner's lines."""
    process = zygote.start(data)
    scanned, done = _Scanned(), threading.Event()
    if rng.random() < 0.1:
        time.sleep(rng.uniform(0, 0.3))
        account.while_starting += 1
        _kill(zygote, process)
        return scanned
    url = zygote.wait_for_url()
    key = (data / "local-key").read_text().strip()
    failures: list[BaseException] = []
    target = len(pushed.acknowledged) + rng.randrange(1, 2 * wanted + 1)
    pusher = threading.Thread(
        target=_guarded, args=(failures, lambda: _push(Client(url, key), pushed, target, done, rng.getrandbits(64)))
    )
    watcher = threading.Thread(
        target=_guarded, args=(failures, lambda: _scan(url, key, scanner, scanned, done, rng.random()))
    )
    for thread in (pusher, watcher):
        thread.start()
    pusher.join()
    patience_s = time.monotonic() + (1.0 if rng.random() < 0.7 else 0.0)
    while scanned.lines == 0 and time.monotonic() < patience_s:
        time.sleep(0.01)
    time.sleep(rng.uniform(0, 0.03))
    _kill(zygote, process)
    done.set()
    watcher.join()
    if failures:
        raise failures[0]
    return scanned


def _kill(zygote: Zygote, process: int) -> None:
    os.kill(process, signal.SIGKILL)
    assert zygote.wait_for_end()


def _guarded(failures: list[BaseException], work: Callable[[], None]) -> None:
    try:
        work()
    except (*_GONE, Refused):
        pass
    except BaseException as error:  # noqa: BLE001 - told by the thread that waits
        failures.append(error)


def _push(client: Client, pushed: Pushed, target: int, done: threading.Event, seed: int) -> None:
    """Push until the first `target` lines are acknowledged, and on without waiting: the kill comes there."""
    try:
        index = push_until(client, pushed, target, done, seed)
    except BaseException:
        client.close()
        raise
    threading.Thread(target=_guarded, args=([], lambda: _one_more(client, pushed, index)), daemon=True).start()


def push_until(client: Client, pushed: Pushed, target: int, done: threading.Event, seed: int) -> int:
    rng = random.Random(seed)
    if not pushed.session:
        made = client.ask(
            "POST", "/api/v1/sessions", {"name": "pushed", "source": {"kind": "push"}, "settings": _SETTINGS}
        )
        pushed.session = made["id"]
    client.ask("POST", f"/api/v1/sessions/{pushed.session}/start")
    index = max(0, pushed.first_missing() - rng.randrange(4))
    while pushed.first_missing() < target and not done.is_set():
        count = min(rng.randrange(1, 257), max(1, target + 8 - index))
        lines = [pushed_line(line) for line in range(index, index + count)]
        told = client.ask("POST", f"/api/v1/sessions/{pushed.session}/scanlines", {"lines": lines})["lines"]
        refused = [line["line_index"] for line in told if line["outcome"] == "refused"]
        for line in told:
            if line["outcome"] == "refused":
                continue
            known = pushed.acknowledged.setdefault(line["line_index"], line["line_number"])
            assert line["outcome"] in ("stored", "duplicate") and known == line["line_number"], line
        index += count
        if refused:  # a starved service took none of them: they are pushed again, as any client must
            pushed.refused += len(refused)
            index = min(refused)
            done.wait(_BREATH_S)
    return index


def _one_more(client: Client, pushed: Pushed, index: int) -> None:
    lines = [pushed_line(line) for line in range(index, index + 64)]
    with contextlib.closing(client):
        client.ask("POST", f"/api/v1/sessions/{pushed.session}/scanlines", {"lines": lines})


def _scan(url: str, key: str, scanner: PtyPort, scanned: _Scanned, done: threading.Event, chance: float) -> None:
    """Scan over the pseudo-terminal, and note how far the service says that its lines are durable."""
    with contextlib.closing(Client(url, key)) as client:
        _watch_scan(client, scanner, scanned, done, chance)


def _watch_scan(client: Client, scanner: PtyPort, scanned: _Scanned, done: threading.Event, chance: float) -> None:
    source = {
        "kind": "device",
        "port": str(scanner.path),
        "baud_rate": 3_000_000,
        "line_spacing_mm": 0.05,
        "start_mm": 10.0 * chance,
        "end_mm": 5000.0,
        "line_rate_hz": 300.0,
    }
    made = client.ask("POST", "/api/v1/sessions", {"name": "scanned", "source": source, "settings": _SETTINGS})
    scanned.session = made["id"]
    client.ask("POST", f"/api/v1/sessions/{scanned.session}/start")
    while not done.wait(0.03):
        durable = client.ask("GET", f"/api/v1/sessions/{scanned.session}")["durable"].get(_DEVICE)
        if durable is not None:
            scanned.boot_id, scanned.line_index, scanned.lines = (
                durable["boot_id"],
                durable["line_index"],
                durable["lines"],
            )


def _look(path: Path, pushed: list[Pushed], scanned: list[_Scanned], account: Account) -> None:
    """Read the record that the killed service left, as the next one would find it."""
    if not path.exists():
        assert not any(session.acknowledged for session in pushed) and not any(item.lines for item in scanned)
        return
    with Record.open(path) as record:
        for session in pushed:
            if session.session:
                _compare_pushed(record, session, account)
        for item in scanned:
            if item.session:
                _compare_scanned(record, item, account)


def _read(record: Record, session: str, account: Account) -> list[tuple[int, StoredLine]]:
    """The lines of a session; damaged, doubled and missing ones are counted."""
    found = list(record.lines(session, on_damage=lambda bad: account.fault("torn", f"{bad}")))
    numbers = [number for number, _ in found]
    if numbers != list(range(len(numbers))):
        account.fault("lost", f"session {session} has numbers {numbers[:3]}… of {record.count(session).lines}")
    keys = {(line.device_id, line.boot_id, line.line_index) for _, line in found}
    if len(keys) != len(found):
        account.fault("doubled", f"session {session} has {len(found)} lines of {len(keys)} keys")
    return found


def _compare_pushed(record: Record, pushed: Pushed, account: Account) -> None:
    number_of = {}
    for number, line in _read(record, pushed.session, account):
        number_of[line.line_index] = number
        expected = np.rint(np.array(pushed_line(line.line_index)["points_mm"]) * QUANTA_PER_MM)
        if not np.array_equal(line.xyz_q, expected):
            account.fault("torn", f"pushed line {line.line_index} is not what was pushed")
    for index, number in pushed.acknowledged.items():
        if number_of.get(index) != number:
            account.fault("lost", f"pushed line {index} is lost")


def _compare_scanned(record: Record, scanned: _Scanned, account: Account) -> None:
    lines = [line for _, line in _read(record, scanned.session, account) if line.boot_id == scanned.boot_id]
    for line in lines:
        x_mm, z_mm = scene(line.position_mm)
        on_the_wire = [np.round(axis * 1e4) / 1e4 for axis in (x_mm, z_mm)]
        expected = np.stack([on_the_wire[0], np.full(len(x_mm), line.position_mm), on_the_wire[1]], axis=1)
        if not np.array_equal(line.xyz_q, np.rint(expected * QUANTA_PER_MM)[line.index]):
            account.fault("torn", f"line {line.line_index} of the scanner is not what it measured")
    durable = sum(line.line_index <= scanned.line_index for line in lines)
    if durable < scanned.lines or math.isnan(durable):
        account.fault("lost", f"{scanned.lines - durable} lines of the scanner are lost")
