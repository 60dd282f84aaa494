"""The benchmark of latency: from a line's last byte on the serial port to the answer that a WebSocket client receives.

python -m benchmarks.latency --json latency.json

Scanner, service and client are processes of their own and share nothing but CLOCK_MONOTONIC, the port and the socket.
"""

import argparse
import contextlib
import json
import multiprocessing
import os
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import websockets.exceptions
import websockets.sync.client

from benchmarks.cloud import LINE_SPACING_MM, NOISE_MM, POINTS_PER_LINE
from benchmarks.machine import Neighbours, describe_machine
from benchmarks.prepared_scanner import PassPlan, Sent, serve_prepared
from drivers.rig import Rig
from drivers.scanline import Float64Array, Profile
from drivers.scanners.native import NativeScanner
from scanner_service.analysis.intake import quantise
from scanner_service.analysis.live_map import LiveMap
from scanner_service.sessions.readiness import warm_up
from scanner_service.sessions.settings import SessionSettings
from tests.end_to_end.running import RunningService

Figures = dict[str, Any]
RATES_HZ = (100.0, 250.0, 500.0, 1000.0)
BAUD_RATE = 12_000_000  # what is asked of the terminal, which heeds no rate; the highest that the service takes
CREDIT = 8
CARRIED_SHARE = 0.95
"""A rate is carried when lines leave, and are answered, at this share of it at least, and none is lost."""
_HEADER = struct.Struct("<4sHHQQIIII")
_LARGEST_MESSAGE_BYTES = 64 << 20
_SPAWN = multiprocessing.get_context("spawn")
_PATIENCE_S = 300.0
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class BenchmarkFailed(Exception):
    """A process of the benchmark ended, or the session did, before there was anything to report."""


@dataclass(frozen=True, slots=True)
class Answers:
    """When somebody had answers for so many points of the map: `at_s` (k,) CLOCK_MONOTONIC, `points` (k,) rising."""

    at_s: Float64Array
    points: Float64Array
    messages: int
    n_bytes: int
    cpu_s: float


def listen(parent: Connection, url: str, key: str) -> None:
    """The client's whole life: follow a session to its end as a viewer does, then hand over `Answers`.

    An update of several messages counts when its last part is there.
    """
    at_s: list[float] = []
    points: list[int] = []
    messages = n_bytes = 0
    headers = {"Authorization": f"Bearer {key}"}
    with websockets.sync.client.connect(
        url, additional_headers=headers, compression=None, max_size=_LARGEST_MESSAGE_BYTES
    ) as socket:
        socket.send(json.dumps({"credit": CREDIT}))
        parent.send("listening")
        with contextlib.suppress(websockets.exceptions.ConnectionClosedOK):
            while True:
                message = socket.recv()
                heard_s = time.monotonic()
                if isinstance(message, str):
                    continue
                _magic, _kind, _flags, version, based_on, _n, _skipped, total, _ = _HEADER.unpack_from(message)
                messages += 1
                n_bytes += len(message)
                socket.send('{"credit": 1}')
                if version != based_on:
                    at_s.append(heard_s)
                    points.append(total)
    parent.send(Answers(np.array(at_s), np.array(points, dtype=np.float64), messages, n_bytes, time.process_time()))


@contextlib.contextmanager
def process(target: Callable[..., None], *arguments: object) -> Iterator[Connection]:
    """Run a function in a process of its own; the connection to it."""
    ours, theirs = _SPAWN.Pipe()
    child = _SPAWN.Process(target=target, args=(theirs, *arguments), daemon=True)
    child.start()
    theirs.close()
    try:
        yield ours
    finally:
        child.join(1.0)
        if child.is_alive():
            child.terminate()
            child.join()
        ours.close()


def hear(connection: Connection, who: str) -> Any:
    """What the process says next; raises BenchmarkFailed when it says nothing."""
    try:
        if connection.poll(_PATIENCE_S):
            return connection.recv()
    except EOFError:
        pass
    raise BenchmarkFailed(f"the {who} ended without a word; its own message is above")


def through_the_service(service: Any, plan: PassPlan) -> Figures:
    """One pass at one rate through the whole service, a `RunningService`, while a client listens."""
    with process(serve_prepared, plan) as scanner:
        port = hear(scanner, "prepared scanner")
        source = {"kind": "device", "port": port, "baud_rate": BAUD_RATE, "line_rate_hz": plan.rate_hz}
        source |= {"line_spacing_mm": LINE_SPACING_MM, "start_mm": 0.0, "end_mm": plan.end_mm}
        session_id = service.create(**source)
        address = f"{service.url.replace('http', 'ws')}/api/v1/sessions/{session_id}/live"
        with process(listen, address, service.key) as client:
            hear(client, "client")
            others, service_cpu_s = Neighbours.watch(), _cpu_s(service.process.pid)
            begun_s = time.monotonic()
            service.start(session_id)
            answers: Answers = hear(client, "client")
            elapsed_s = time.monotonic() - begun_s
            cores_taken = others.cores_taken()
            service_cpu_s = _cpu_s(service.process.pid) - service_cpu_s
        scanner.send("enough")
        sent: Sent = hear(scanner, "prepared scanner")
    status = service.status(session_id)
    if status["state"] != "stopped":
        raise BenchmarkFailed(f"the session is {status['state']}: {status['message']}")
    own_s = service_cpu_s + sent.cpu_s + answers.cpu_s
    figures = compare(plan, sent, answers, lost_lines(status["losses"], plan.lines))
    return figures | {
        "updates_per_s": len(answers.at_s) / elapsed_s,
        "client_bytes_per_s": answers.n_bytes / elapsed_s,
        "cores_of_service": service_cpu_s / elapsed_s,
        "cores_of_scanner": sent.cpu_s / elapsed_s,
        "cores_of_client": answers.cpu_s / elapsed_s,
        "cores_taken_by_others": max(0.0, cores_taken - own_s / elapsed_s),
        "losses": status["losses"],
    }


def to_the_map(plan: PassPlan) -> Figures:
    """The same pass in one process without record and clients: driver, rig and live map, read whenever it has time."""
    with process(serve_prepared, plan) as scanner:
        driver = NativeScanner(hear(scanner, "prepared scanner"), BAUD_RATE)
        live_map = LiveMap(SessionSettings(noise_mm=NOISE_MM).map_settings())
        rig = Rig()
        at_s: list[float] = []
        points: list[int] = []
        others = Neighbours.watch()
        with driver:
            begun_s = time.monotonic()
            driver.start_pass(LINE_SPACING_MM, 0.0, plan.end_mm, plan.rate_hz, resume=False)
            is_over = False
            while not is_over:
                events = driver.events(1.0)
                for event in events:
                    if isinstance(event, Profile):
                        live_map.add(quantise(rig.place(event), live_map.origin_mm))
                    else:
                        is_over = True
                live_map.refresh()
                at_s.append(time.monotonic())
                points.append(len(live_map))
                if not events and time.monotonic() - begun_s > _PATIENCE_S:
                    raise BenchmarkFailed("the pass did not end")
            tally = driver.tally().to_dict()
        elapsed_s = time.monotonic() - begun_s
        cores_taken = others.cores_taken()
        live_map.close()
        scanner.send("enough")
        sent: Sent = hear(scanner, "prepared scanner")
    lines = tally["lines"]
    answers = Answers(np.array(at_s), np.array(points, dtype=np.float64), 0, 0, 0.0)
    figures = compare(plan, sent, answers, {"on_the_wire": plan.lines - lines["whole"]})
    return figures | {
        "readings_per_s": len(at_s) / elapsed_s,
        "cores_taken_by_others": max(0.0, cores_taken - sent.cpu_s / elapsed_s),
        "losses": {"device": tally},
    }


def lost_lines(losses: dict[str, Any], lines: int) -> dict[str, int]:
    """How many of `lines` lines did not get whole into map and record, by where they were lost."""
    whole = int(losses["device"]["lines"]["whole"])
    ledger = losses["lines"]
    late = int(ledger["refused"].get("too_late", 0))
    return {
        "on_the_wire": lines - whole,
        "late": late,
        "refused": sum(ledger["refused"].values()) - late,
        "not_stored": whole - ledger["stored"] - sum(ledger["refused"].values()),
    }


def compare(plan: PassPlan, sent: Sent, answers: Answers, lost: dict[str, int]) -> Figures:
    """From what left and what was heard to latencies.

    A line is answered by the first answer that covers its last point; rows are appended in the order of the lines, so
    that the number of points tells which lines are covered. With a line lost it would not: then there is no latency.
    """
    covers = np.cumsum(sent.returns)
    first = np.searchsorted(answers.points, covers)
    is_whole = sum(lost.values()) == 0 and bool((first < len(answers.points)).all())
    figures: Figures = {
        "asked_lines_per_s": plan.rate_hz,
        "sent_lines_per_s": _rate_per_s(sent.left_s),
        "answered_lines_per_s": None,
        "lines": plan.lines,
        "points": int(covers[-1]),
        "lost_lines": lost,
        "is_carried": False,
        "late_leaving": _spread(sent.left_s - sent.due_s) if is_whole else None,
        "latency": None,
        "latency_from_due": None,
    }
    if not is_whole:
        return figures
    answered_s = answers.at_s[first]
    figures["answered_lines_per_s"] = _rate_per_s(answered_s)
    figures["latency"] = _spread(answered_s - sent.left_s)
    figures["latency_from_due"] = _spread(answered_s - sent.due_s)
    slowest = min(figures["sent_lines_per_s"], figures["answered_lines_per_s"])
    figures["is_carried"] = bool(slowest >= CARRIED_SHARE * plan.rate_hz)
    return figures


def _rate_per_s(at_s: Float64Array) -> float:
    """How steep a line through the instants is: one late line at either end does not change the rate."""
    if len(at_s) < 2 or not np.isfinite(at_s).all():
        return 0.0
    seconds_per_line = float(np.polyfit(np.arange(len(at_s)), at_s - at_s[0], 1)[0])
    return 1.0 / seconds_per_line if seconds_per_line > 0 else 0.0


def _spread(seconds: Float64Array) -> Figures:
    middle, late = np.quantile(seconds, [0.5, 0.99])
    return {"p50_s": float(middle), "p99_s": float(late), "max_s": float(seconds.max())}


def _cpu_s(pid: int) -> float:
    """Processor time that a process has used."""
    after_name = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(after_name[11]) + int(after_name[12])) / _TICKS_PER_S


def run(rates_hz: Sequence[float], seconds: float) -> Figures:
    """Measure every rate, whole way and map alone."""
    begun = time.time()
    machine = describe_machine()
    warm_up()
    whole_way: list[Figures] = []
    map_only: list[Figures] = []
    with tempfile.TemporaryDirectory(prefix="latency-") as folder:
        service: Any = RunningService(Path(folder) / "data")  # of the tests, which carry no types
        try:
            for rate_hz in rates_hz:
                plan = PassPlan(max(2, round(rate_hz * seconds)), rate_hz)
                whole_way.append(through_the_service(service, plan))
                _tell("to the client", whole_way[-1])
                map_only.append(to_the_map(plan))
                _tell("to the map", map_only[-1])
        finally:
            service.end()
    return {
        "benchmark": "latency",
        "begun_unix_s": begun,
        "took_s": time.time() - begun,
        "machine": machine | {"load_average_after": os.getloadavg()},
        "points_per_line": POINTS_PER_LINE,
        "line_spacing_mm": LINE_SPACING_MM,
        "seconds": seconds,
        "to_client": headline(whole_way),
        "to_map": headline(map_only),
        "runs_to_client": whole_way,
        "runs_to_map": map_only,
    }


def headline(runs: Sequence[Figures]) -> Figures | None:
    """The run at the highest rate that was carried; None when none was."""
    return max((figures for figures in runs if figures["is_carried"]), key=_asked, default=None)


def _asked(figures: Figures) -> float:
    return float(figures["asked_lines_per_s"])


def _tell(where: str, figures: Figures) -> None:
    asked, lost = figures["asked_lines_per_s"], sum(figures["lost_lines"].values())
    line = f"{where:<14}{asked:6.0f} lines/s asked, {figures['sent_lines_per_s']:6.0f} sent"
    if figures["latency"] is None:
        print(f"{line}; {lost} lines lost {figures['lost_lines']}: no latency", flush=True)
        return
    p50, p99, longest = (1000.0 * figures["latency"][name] for name in ("p50_s", "p99_s", "max_s"))
    print(
        f"{line}, {figures['answered_lines_per_s']:6.0f} answered; "
        f"latency ms p50 {p50:.1f}, p99 {p99:.1f}, max {longest:.1f}; "
        f"{'carried' if figures['is_carried'] else 'NOT carried'} "
        f"(others took {figures['cores_taken_by_others']:.2f} cores)",
        flush=True,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, save; 1 when no rate was carried."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--rates", type=float, nargs="+", default=list(RATES_HZ), help="lines a second, one run each")
    parser.add_argument("--seconds", type=float, default=4.0, help="length of each run")
    chosen = parser.parse_args(arguments)
    if min(chosen.rates) <= 0 or chosen.seconds <= 0:
        parser.error("rates and seconds must be greater than 0")
    try:
        result = run(chosen.rates, chosen.seconds)
    except BenchmarkFailed as error:
        print(str(error), file=sys.stderr)
        return 1
    if chosen.json is not None:
        chosen.json.parent.mkdir(parents=True, exist_ok=True)
        chosen.json.write_text(json.dumps(result, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    if result["to_client"] is None:
        print("No rate was carried: the machine is too busy or too slow.", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
