"""How fast lines become durable, beside a bare loop of write and fdatasync on the same disk; and how fast a session
is open again. `python -m benchmarks.record append|reopen`, from a checkout.

The record and the bare loop take turns in one run, with the same lines in batches of the same size; the loop writes the
bytes that the record stores, and once more the lines as they come, unpacked. The record does all that a scan makes it
do: encode, check for duplicates, checksum, commit, copy its log, answer. MB/s are those of the coordinates.
"""

import argparse
import json
import os
import resource
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import describe_machine
from scanner_service.analysis.intake import StoredLine
from scanner_service.sessions import analyst as analyst_module
from scanner_service.sessions.book import SessionBook
from scanner_service.sessions.readiness import warm_up
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.source_specs import PushSpec
from scanner_service.storage.encoding import PLAIN, encode_line
from scanner_service.storage.record import Record
from scanner_service.storage.rows import Limits

POINTS_A_LINE = 1280
LINE_SPACING_MM = 0.2
POINT_SPACING_MM = 0.15
_MOST_DIFFERENT = 8_000
_TIMED_EVERY = 8  # lines whose acknowledgement is timed


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure one of the two, print it, and save it as JSON where asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.record")
    parser.add_argument("what", choices=("append", "reopen"))
    parser.add_argument("--lines", type=int, help="lines of a run")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--folder", type=Path, help="a folder on the disk to be measured")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="bench-record-", dir=given.folder) as folder:
        if given.what == "append":
            told = measure_append(Path(folder), given.lines or 16_000, given.repeats)
        else:
            told = measure_reopening(Path(folder), given.lines or 5_000_000 // POINTS_A_LINE + 1)
    told["machine"] = describe_machine()
    text = json.dumps(told, indent=2)
    if given.json is not None:
        given.json.write_text(text + "\n")
    sys.stdout.write(text + "\n")
    return 0


def scan_lines(count: int) -> list[StoredLine]:
    """Lines over a gently waved plate, full of points; they share what may be shared, after a while the points too."""
    made = _different_lines(min(count, _MOST_DIFFERENT))
    return [
        made[number] if number < len(made) else replace(made[number % len(made)], line_index=number)
        for number in range(count)
    ]


def _different_lines(count: int) -> list[StoredLine]:
    rng = np.random.default_rng(1)
    index = np.arange(POINTS_A_LINE, dtype=np.int32)
    x_q = np.rint(index * POINT_SPACING_MM * 8192).astype(np.int32)
    lines = []
    for number in range(count):
        y_mm = number * LINE_SPACING_MM
        z_mm = 2.0 * np.sin(index * 0.005 + number * 0.01) + rng.normal(0.0, 0.01, POINTS_A_LINE)
        xyz_q = np.empty((POINTS_A_LINE, 3), dtype=np.int32)
        xyz_q[:, 0], xyz_q[:, 1], xyz_q[:, 2] = x_q, round(y_mm * 8192), np.rint(z_mm * 8192)
        lines.append(
            StoredLine(
                device_id="BENCH",
                boot_id=1,
                pass_index=0,
                line_index=number,
                device_time_s=number * 1e-3,
                xyz_q=xyz_q,
                index=index,
                point_count=POINTS_A_LINE,
                laser_mm=np.array([96.0, y_mm, 200.0]),
                plane_normal=np.array([0.0, 1.0, 0.0]),
                travel=np.array([0.0, 1.0, 0.0]),
                position_mm=y_mm,
                line_spacing_mm=LINE_SPACING_MM,
                step_mm=LINE_SPACING_MM,
            )
        )
    return lines


def measure_append(folder: Path, count: int, repeats: int) -> dict[str, Any]:
    """The record at full speed and line by line, each beside the bare loop; medians of the rounds.

    A round before them is not counted, as a service has been running for a while when lines come.
    """
    warm_up()
    lines = scan_lines(count)
    encoded = [encode_line(line) for line in lines]
    plain = [encode_line(line, PLAIN) for line in lines]
    names = ("record", "bare", "bare_plain", "record_single", "bare_single", "bare_plain_single")
    rounds: dict[str, list[dict[str, float]]] = {name: [] for name in names}
    singles = min(count, 500)
    for number in range(-1, repeats):
        told, batch = _append(folder / f"record-{number}", lines)
        if number < 0:
            continue
        rounds["record"].append(told)
        rounds["bare"].append(_bare(folder / f"bare-{number}", encoded, batch))
        rounds["bare_plain"].append(_bare(folder / f"bare-plain-{number}", plain, batch))
        rounds["record_single"].append(_append_one_by_one(folder / f"single-{number}", lines[:singles]))
        rounds["bare_single"].append(_bare(folder / f"bare-single-{number}", encoded[:singles], 1))
        rounds["bare_plain_single"].append(_bare(folder / f"bare-plain-single-{number}", plain[:singles], 1))
        for path in folder.iterdir():
            path.unlink()
    medians = {
        name: {key: statistics.median(told[key] for told in runs) for key in runs[0]} for name, runs in rounds.items()
    }
    return {
        "points_a_line": POINTS_A_LINE,
        "bytes_a_line": len(encoded[0]),
        "plain_bytes_a_line": len(plain[0]),
        "lines": count,
        "repeats": repeats,
        **medians,
        **{
            f"ratio_to_{bare}{single}": medians[f"record{single}"]["lines_per_s"]
            / medians[bare + single]["lines_per_s"]
            for bare in ("bare", "bare_plain")
            for single in ("", "_single")
        },
        "load": os.getloadavg()[0],
    }


def _append(path: Path, lines: list[StoredLine]) -> tuple[dict[str, float], int]:
    """All lines, as fast as the record takes them; also how many went into one commit, as the bare loop is to do."""
    taken_s: dict[int, float] = {}
    waited_s: list[float] = []
    lock = threading.Lock()
    with Record.open(path, limits=Limits()) as record:
        session = record.create_session("bench").session_id

        def durable(number: int) -> None:
            now_s = time.perf_counter()
            with lock:
                waited_s.append(now_s - taken_s[number])

        batches = record.writer_state().batches
        begun_s, cpu_s = time.perf_counter(), time.process_time()
        for number, line in enumerate(lines):
            last = record.append(session, line, timeout_s=60.0)
            if number % _TIMED_EVERY == 0:
                taken_s[number] = time.perf_counter()
                last.add_done_callback(lambda _, number=number: durable(number))  # type: ignore[misc]
        last.result()
        took_s, cpu_s = time.perf_counter() - begun_s, time.process_time() - cpu_s
        batches = record.writer_state().batches - batches
    told = _rates(lines, took_s, waited_s)
    return told | {"cpu_s": cpu_s, "lines_a_commit": len(lines) / batches}, round(len(lines) / batches)


def _append_one_by_one(path: Path, lines: list[StoredLine]) -> dict[str, float]:
    """Each line when the one before is durable: a commit a line."""
    waited_s = []
    with Record.open(path) as record:
        session = record.create_session("bench").session_id
        begun_s = time.perf_counter()
        for line in lines:
            asked_s = time.perf_counter()
            record.append(session, line).result()
            waited_s.append(time.perf_counter() - asked_s)
        took_s = time.perf_counter() - begun_s
    return _rates(lines, took_s, waited_s)


def _bare(path: Path, encoded: list[bytes], lines_a_sync: int) -> dict[str, float]:
    """Write and fdatasync, nothing else: what the disk itself gives for these bytes in these pieces."""
    waited_s = []
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    begun_s = time.perf_counter()
    for first in range(0, len(encoded), max(1, lines_a_sync)):
        asked_s = time.perf_counter()
        os.write(descriptor, b"".join(encoded[first : first + max(1, lines_a_sync)]))
        os.fdatasync(descriptor)
        waited_s.append(time.perf_counter() - asked_s)
    took_s = time.perf_counter() - begun_s
    os.close(descriptor)
    return _rates(encoded, took_s, waited_s)


def _rates(lines: Sequence[object], took_s: float, waited_s: list[float]) -> dict[str, float]:
    payload_bytes = len(lines) * (POINTS_A_LINE * 12)
    return {
        "lines_per_s": len(lines) / took_s,
        "mb_per_s": payload_bytes / took_s / 1e6,
        "p50_ms": 1e3 * float(np.percentile(waited_s, 50)),
        "p99_ms": 1e3 * float(np.percentile(waited_s, 99)),
    }


def measure_reopening(folder: Path, count: int) -> dict[str, Any]:
    """A session of `count` lines opened from the record: map built, losses told, ready for questions; not judged."""
    warm_up()
    analyst_module.ANALYSIS_PERIOD_S = 1e6  # the verdict is measured elsewhere
    path = folder / "record"
    settings = SessionSettings(max_points=count * POINTS_A_LINE).to_dict()
    with Record.open(path) as record:
        source = PushSpec().to_dict()
        session_id = record.create_session("bench", state="stopped", settings=settings, source=source).session_id
        for line in scan_lines(count):
            last = record.append(session_id, line, timeout_s=60.0)
        last.result()
    with Record.open(path) as record:
        book = SessionBook(record)
        begun_s, cpu_s = time.perf_counter(), time.process_time()
        live = book.get(session_id)
        opened_s, cpu_s = time.perf_counter() - begun_s, time.process_time() - cpu_s
        points = live.status().points
        book.close()
    return {
        "lines": count,
        "points": points,
        "open_s": opened_s,
        "open_cpu_s": cpu_s,
        "file_mb": path.stat().st_size / 1e6,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }


if __name__ == "__main__":
    raise SystemExit(main())
