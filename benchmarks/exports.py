"""Exports measured: seconds, size and peak memory of each format, each in a process of its own.

    python -m benchmarks.exports [--points 5000000] [--formats ply,laz] [--memory-mb N] [--together] [--json FILE]

Each figure holds the start of the program and the rebuilding of the session, which every export takes first. With
`--together` one process writes all formats: what comes first is measured once, and each format by itself.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from scanner_service.analysis.intake import QUANTUM_MM, StoredLine
from scanner_service.sessions.exporting import (
    FORMATS,
    RECORD,
    RECORD_FILE,
    REPORT,
    REPORT_FILES,
    RESULT_FILES,
    RESULTS,
    export_session,
    missing_for,
)
from scanner_service.sessions.memory_bound import points_at_once
from scanner_service.sessions.settings import SessionSettings
from scanner_service.storage.exports.point_files import POINT_FORMATS
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.record import Record

POINTS_A_LINE = 1280
_SPACING_MM = 0.2
_ALONG_MM = 0.15


def lines_of_a_plate(points: int) -> Iterator[StoredLine]:
    """A wavy plate with noise, in lines of 1,280 points, 0.2 mm apart."""
    rng = np.random.default_rng(1)
    x_mm = (np.arange(POINTS_A_LINE) - POINTS_A_LINE / 2) * _ALONG_MM
    index = np.arange(POINTS_A_LINE, dtype=np.int32)
    forward = np.array([0.0, 1.0, 0.0])
    for number in range(points // POINTS_A_LINE):
        y_mm = number * _SPACING_MM
        z_mm = 2.0 * np.sin(x_mm / 9.0) * np.cos(y_mm / 11.0) + rng.normal(0.0, 0.005, POINTS_A_LINE)
        xyz_mm = np.column_stack([x_mm, np.full(POINTS_A_LINE, y_mm), z_mm])
        yield StoredLine(
            device_id="bench",
            boot_id=1,
            pass_index=0,
            line_index=number,
            device_time_s=number * 1e-3,
            xyz_q=np.rint(xyz_mm / QUANTUM_MM).astype(np.int32),
            index=index.copy(),
            point_count=POINTS_A_LINE,
            laser_mm=np.array([0.0, y_mm, 300.0]),
            plane_normal=forward.copy(),
            travel=forward.copy(),
            position_mm=y_mm,
            line_spacing_mm=_SPACING_MM,
            step_mm=_SPACING_MM,
        )


def make_record(path: Path, points: int) -> None:
    """A record with one session of about so many points."""
    with Record.open(path) as record:
        settings = SessionSettings(point_spacing_mm=_ALONG_MM, max_points=points)
        row = record.create_session("bench", state="stopped", settings=settings.to_dict())
        waiting = [record.append(row.session_id, line, timeout_s=60.0) for line in lines_of_a_plate(points)]
        for answer in waiting:
            answer.result(120.0)


def measure(record: Path, name: str, out: Path, more: list[str]) -> dict[str, Any]:
    """Run one export in a process of its own."""
    command = [sys.executable, "-m", "scanner_service", "export", "latest", "--record", str(record)]
    command += ["--format", name, "--out", str(out), "--json", *more]
    begun_s = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        told = process.stdout.read() if process.stdout is not None else b""
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    seconds = time.perf_counter() - begun_s
    if process.returncode != 0:
        raise SystemExit(f"the export as {name} failed")
    files = json.loads(told)["files"]
    return {
        "format": name,
        "seconds": seconds,
        "cpu_seconds": usage.ru_utime + usage.ru_stime,
        "mb": sum(file["bytes"] for file in files.values()) / 1e6,
        "peak_mb": usage.ru_maxrss / 1024,
    }


def show(row: dict[str, Any]) -> None:
    """One row of the table."""
    figures = (row[key] for key in ("seconds", "cpu_seconds", "mb", "peak_mb"))
    told = "  ".join(f"{value:{width},.1f}" for value, width in zip(figures, (7, 7, 8, 8), strict=True))
    print(f"{row['format']:8}  {told}", flush=True)


class Steps:
    """Seconds, processor seconds and peak memory of each step that an export tells of (Linux alone)."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self._doing = ""
        self._begin()

    def __call__(self, doing: str, share: float) -> None:
        """What `export_session` tells."""
        if doing != self._doing:
            self.end()
            self._doing = doing

    def end(self) -> None:
        """The step under way is over."""
        if self._doing:
            now_s, cpu_s = time.perf_counter() - self._begun_s, time.process_time() - self._cpu_s
            peak_mb = _memory_kb("VmHWM") / 1024
            self.rows.append({"format": self._doing, "seconds": now_s, "cpu_seconds": cpu_s, "peak_mb": peak_mb})
        self._begin()

    def _begin(self) -> None:
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        self._begun_s, self._cpu_s = time.perf_counter(), time.process_time()


def _memory_kb(name: str) -> int:
    said = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(said[name].split()[0])


def measure_together(record: Path, formats: list[str], out: Path, bound: int | None) -> list[dict[str, Any]]:
    """All formats written by this process, and what it took to come so far."""
    steps = Steps()
    with closing(RecordReader.open(record)) as reader:
        (row,) = reader.list_sessions(1)
        export_session(reader, row, formats, out, datetime.now(UTC), steps, bound)
    steps.end()
    for step in steps.rows:
        files = {RECORD: (RECORD_FILE,), REPORT: REPORT_FILES, RESULTS: RESULT_FILES}
        one = POINT_FORMATS.get(step["format"])
        names = files.get(step["format"], () if one is None else (one.file_name,))
        step["mb"] = sum((out / name).stat().st_size for name in names) / 1e6
    return steps.rows


def main() -> None:
    """Measure, print a table, save the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=5_000_000)
    parser.add_argument("--formats", default=",".join(FORMATS))
    parser.add_argument("--memory-mb", type=int, help="as `scanner export` takes it")
    parser.add_argument("--together", action="store_true", help="one process for all formats")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    more = [] if asked.memory_mb is None else ["--memory-mb", str(asked.memory_mb)]
    rows = []
    with tempfile.TemporaryDirectory(prefix="scanner-exports-") as folder:
        record = Path(folder) / "record.sqlite"
        make_record(record, asked.points)
        print(f"{asked.points:,} points, record {record.stat().st_size / 1e6:,.1f} MB, load {os.getloadavg()[0]:.1f}")
        print(f"{'format':8}  {'s':>7}  {'cpu s':>7}  {'MB':>8}  {'peak MB':>8}")
        formats = [name for name in asked.formats.split(",") if missing_for(name) is None]
        if asked.together:
            bound = None if asked.memory_mb is None else points_at_once(asked.memory_mb << 20)
            rows = measure_together(record, formats, Path(folder) / "out", bound)
            for row in rows:
                show(row)
        for name in formats if not asked.together else ():
            rows.append(measure(record, name, Path(folder) / name, more))
            show(rows[-1])
    if asked.json is not None:
        asked.json.write_text(
            json.dumps({"points": asked.points, "load": os.getloadavg()[0], "formats": rows}, indent=2)
        )


if __name__ == "__main__":
    main()
