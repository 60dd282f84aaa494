"""One run of the live map over the cloud, in a process of its own: every line timed, samples checked, JSON printed."""

import argparse
import gc
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
import numpy.typing as npt

from benchmarks.agreement import Agreement
from benchmarks.cloud import NOISE_MM, RADIUS_MM, make_lines, uncertainty_mm
from benchmarks.machine import Neighbours, fetch_memory, resident_bytes, use_cores
from benchmarks.reader import Reader
from scanner_service.analysis.compiling import compile_kernels
from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.analysis.radius import LiveRule, RadiusSettings

READS_PER_S = 30.0
DEFAULT_CEILING = MapSettings().max_points
_MEMORY_BYTES = 256 << 20
_MEMORY_BYTES_PER_POINT = 200


@dataclass(frozen=True, slots=True)
class Plan:
    """What one run does.

    `each_line` has the map evaluated after every line; the reader comes 30 times a second in any case. At `checks`
    random lines a snapshot is compared with the oracle; `all_counts` compares every point at the end. With
    `cold_memory` the map touches memory that the machine may have to fetch from its host first. `rule` is the radius
    rule; only `line` can be checked.
    """

    points: int
    threads: int
    each_line: bool
    radius_factor: float = 1.0
    checks: int = 0
    all_counts: bool = False
    cold_memory: bool = False
    seed: int = 1
    rule: LiveRule = "line"


@dataclass(frozen=True, slots=True)
class Times:
    """What the clock said, without the time that checks took.

    `line_s` (L,) is what a line cost from being handed over to being taken in, and evaluated when each line is;
    `read_s` (R,) what each reading took, `read_after` (R,) how many lines were in by then.
    """

    wall_s: float
    cpu_s: float
    line_s: npt.NDArray[np.float64]
    read_s: npt.NDArray[np.float64]
    read_after: npt.NDArray[np.int64]


def settings_for(plan: Plan, points: int) -> MapSettings:
    """The map's settings: the ceiling is the one that ships, unless the run needs more."""
    return MapSettings(
        radius=RadiusSettings(uncertainty_mm(plan.radius_factor), rule=plan.rule),
        noise_mm=NOISE_MM,
        max_points=max(points, DEFAULT_CEILING),
        threads=plan.threads,
    )


def measure(plan: Plan) -> dict[str, object]:
    """Carry out a plan; the figures under their names, lengths of time in seconds."""
    lines = make_lines(plan.points)
    points = sum(len(line.index) for line in lines)
    settings = settings_for(plan, points)
    compile_kernels()
    _rehearse(lines[:8], settings)
    rng = np.random.default_rng(plan.seed)
    agreement = _agreement(lines, settings, plan, rng)
    check_at = set(rng.choice(len(lines), min(plan.checks, len(lines)), replace=False).tolist())

    live_map = LiveMap(settings)
    reader = Reader(live_map, points)
    gc.collect()
    if not plan.cold_memory:
        fetch_memory(_MEMORY_BYTES + points * _MEMORY_BYTES_PER_POINT)
    before_bytes = resident_bytes()
    others = Neighbours.watch()
    times = _run(live_map, reader, lines, plan.each_line, check_at, agreement)
    cores_taken = others.cores_taken()
    gc.collect()
    grown_bytes = resident_bytes() - before_bytes
    missed = None
    if agreement is not None:
        snapshot = live_map.snapshot()
        missed = reader.rows_missed(snapshot)
        if plan.all_counts:
            agreement.check_all_counts(snapshot, plan.threads)
    live_map.close()
    return (
        {
            "points": points,
            "lines": len(lines),
            "threads": plan.threads,
            "each_line": plan.each_line,
            "radius_mm": plan.radius_factor * RADIUS_MM,
            "points_per_s": points / times.wall_s,
            "points_per_cpu_s": points / times.cpu_s,
        }
        | _spread(times, plan.each_line)
        | {
            "reads": len(times.read_s),
            "reads_per_s": len(times.read_s) / times.wall_s,
            "rows_read_per_point": reader.rows_read / points,
            "bytes_per_point": grown_bytes / points,
            "cores_taken_by_others": cores_taken,
            "checked_points": agreement.checked if agreement else 0,
            "disagreements": dict(+agreement.failures) if agreement else {},
            "rows_the_reader_missed": missed,
        }
    )


def _agreement(
    lines: list[StoredLine], settings: MapSettings, plan: Plan, rng: np.random.Generator
) -> Agreement | None:
    if not (plan.checks or plan.all_counts):
        return None
    base_mm = plan.radius_factor * RADIUS_MM
    limit_mm = max(base_mm, min(20.0 * settings.radius.uncertainty_mm, 4.0 * base_mm))
    return Agreement(lines, base_mm, limit_mm, settings.max_normal_error_rad, rng)


def _rehearse(lines: list[StoredLine], settings: MapSettings) -> None:
    """Everything once, so that nothing of the run waits for a compiler or an import."""
    live_map = LiveMap(settings)
    reader = Reader(live_map, sum(len(line.index) for line in lines))
    for line in lines:
        live_map.add(line)
        reader.take_update()
    live_map.close()


def _run(
    live_map: LiveMap,
    reader: Reader,
    lines: list[StoredLine],
    each_line: bool,
    check_at: set[int],
    agreement: Agreement | None,
) -> Times:
    """Feed the lines as fast as the map takes them; an update leaves whenever a thirtieth of a second is over.

    A reading begins so early that it should end on the reader's clock, judged by what the one before cost a line; a
    reading that is late delays none of those after it, so there are 30 a second whatever happens.
    """
    clock = time.perf_counter
    line_s = np.zeros(len(lines))
    read_s: list[float] = []
    read_after: list[int] = []
    checks_s = checks_cpu_s = 0.0
    since, per_line_s = 0, 0.0
    begun_cpu, begun = time.process_time(), clock()
    due = begun + 1.0 / READS_PER_S
    for number, line in enumerate(lines):
        start = clock()
        live_map.add(line)
        if each_line:
            live_map.refresh()
        now = clock()
        line_s[number] = now - start
        since += 1
        is_checked = agreement is not None and number in check_at
        is_due = now + since * per_line_s >= due
        if is_due or is_checked or number == len(lines) - 1:
            reader.take_update()
            read_s.append(clock() - now)
            read_after.append(number + 1)
            per_line_s, since = read_s[-1] / since, 0
            if is_due:
                due += 1.0 / READS_PER_S
        if is_checked and agreement is not None:
            start, start_cpu = clock(), time.process_time()
            agreement.check(live_map.snapshot(), number + 1)
            checks_cpu_s += time.process_time() - start_cpu
            took_s = clock() - start
            checks_s += took_s
            due += took_s
    wall_s = clock() - begun - checks_s
    cpu_s = time.process_time() - begun_cpu - checks_cpu_s
    return Times(wall_s, cpu_s, line_s, np.array(read_s), np.array(read_after))


def _spread(times: Times, each_line: bool) -> dict[str, float]:
    """Percentiles of what a line and a reading cost, and whether the cost grew from the first tenth to the last.

    Without evaluation after each line the work is done in the readings: there the cost of a line is that of all lines
    from one reading to the next, the reading included, divided by their number, and the pause is the longest reading.
    """
    if each_line:
        cost_s = times.line_s
    else:
        lines = np.diff(times.read_after, prepend=0)
        upto_s = np.concatenate([[0.0], np.cumsum(times.line_s)])
        cost_s = (np.diff(upto_s[times.read_after], prepend=0.0) + times.read_s) / lines
    tenth = max(1, len(cost_s) // 10)
    middle, high = np.percentile(cost_s, [50, 99])
    return {
        "p50_s": float(middle),
        "p99_s": float(high),
        "max_s": float(cost_s.max()),
        "max_at_share": float(cost_s.argmax() / len(cost_s)),
        "last_to_first_tenth": float(np.median(cost_s[-tenth:]) / np.median(cost_s[:tenth])),
        "add_p50_s": float(np.median(times.line_s)),
        "add_p99_s": float(np.percentile(times.line_s, 99)),
        "add_max_s": float(times.line_s.max()),
        "read_p50_s": float(np.median(times.read_s)),
        "read_p99_s": float(np.percentile(times.read_s, 99)),
        "read_max_s": float(times.read_s.max()),
        "adding_share": float(times.line_s.sum() / times.wall_s),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the plan from the command line, print the figures as one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, required=True)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--each-line", action="store_true")
    parser.add_argument("--radius-factor", type=float, default=1.0)
    parser.add_argument("--checks", type=int, default=0)
    parser.add_argument("--all-counts", action="store_true")
    parser.add_argument("--rule", choices=get_args(LiveRule), default="line")
    parser.add_argument("--cold-memory", action="store_true")
    chosen = parser.parse_args(arguments)
    if chosen.rule != "line" and (chosen.checks or chosen.all_counts):
        parser.error("answers are checked under the rule `line` only")
    use_cores(chosen.threads)
    print(json.dumps(measure(Plan(**vars(chosen)))))


if __name__ == "__main__":
    main()
