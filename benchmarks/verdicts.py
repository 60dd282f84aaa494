"""What a verdict costs while a map grows: core seconds, its age, the share it takes, how long another thread waits.

python -m benchmarks.verdicts [--points N ...] [--lines N]

One scan grows to the largest size. At each size lines are added, as many as a scanner brings in a second, and what has
changed is judged; then the whole map is judged from nothing, and both verdicts must be the same.
"""

import argparse
import threading
import time
from collections.abc import Callable
from itertools import islice
from typing import TypeVar

import numpy as np

from benchmarks.cloud import NOISE_MM, make_lines
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.rescan.coverage import CoverageBook
from scanner_service.rescan.regions import RegionFinder
from scanner_service.rescan.requirement import Requirement
from scanner_service.sessions.cadence import HURRIED_SHARE, VERDICT_PERIOD_S, VERDICT_SHARE
from scanner_service.sessions.mirror import Mirror
from scanner_service.sessions.results import Results, conclude, judge
from scanner_service.sessions.updates import VerdictBook
from simulators.optics import demo_scanner

T = TypeVar("T")


class Ticker:
    """A thread that wants the interpreter a thousand times a second; how long it had to wait, in core seconds.

    Seconds of the process's own processor time, so that what others take from the machine is not in it.
    """

    def __init__(self) -> None:
        self.waits_s: list[float] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._tick)

    def __enter__(self) -> "Ticker":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _tick(self) -> None:
        while not self._ended.is_set():
            before_s = time.process_time()
            time.sleep(0.001)
            self.waits_s.append(time.process_time() - before_s)


class _Engine:
    """Answers at once: there is no scan that it would have to go on with."""

    def __init__(self, live_map: LiveMap) -> None:
        self._live_map = live_map

    def __call__(self, question: Callable[[LiveMap], T], /) -> T:
        return question(self._live_map)


def main() -> None:
    """Grow one map, and judge it at every size on the way."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=[250_000, 500_000, 1_000_000, 2_000_000])
    parser.add_argument("--lines", type=int, default=100, help="scanlines between two verdicts")
    parser.add_argument("--no-whole", action="store_true", help="do not judge the whole map beside")
    chosen = parser.parse_args()
    sizes, geometry = sorted(chosen.points), demo_scanner().geometry()
    live = LiveMap(MapSettings(noise_mm=NOISE_MM, max_points=sizes[-1] + 400_000))
    analyst = Mirror(), _Engine(live), RegionFinder(Requirement(), geometry), CoverageBook()
    mirror, engine = analyst[:2]
    lines = iter(make_lines(sizes[-1] + 350_000))
    for size in sizes:
        while len(live) < size:
            live.add(next(lines))
            if live.line_count % 100 == 0:
                mirror.catch_up(engine, engine)
        _judged(*analyst)
        costs_s = []
        for _ in range(2):
            for line in islice(lines, chosen.lines):
                live.add(line)
            live.refresh()
            with Ticker() as ticker:
                begun_s = time.thread_time()
                results = _judged(*analyst)
                costs_s.append(time.thread_time() - begun_s)
        _tell(results, min(costs_s), ticker, live)
        if not chosen.no_whole:
            begun_s = time.thread_time()
            whole = judge(results.snapshot, Requirement(), geometry)
            told = f"    the whole map from nothing: {time.thread_time() - begun_s:.2f} core s"
            print(told, "(the same)" if _same(results, whole) else "(ANOTHER VERDICT)", flush=True)
    live.close()


def _judged(mirror: Mirror, engine: "_Engine", finder: RegionFinder, coverage: CoverageBook) -> Results:
    """What a session's analyst does for a verdict."""
    mirror.catch_up(engine, engine)
    snapshot, changed = mirror.changes()
    report = finder.find(snapshot, changed)
    return conclude(snapshot, Requirement(), report, coverage.renew(snapshot, report, finder.renewed))


def _same(one: Results, other: Results) -> bool:
    """Whether points, regions and coverage of two verdicts are equal."""
    return (
        bool((one.report.reason == other.report.reason).all())
        and one.report.to_dict() == other.report.to_dict()
        and one.coverage.share == other.coverage.share
    )


def _tell(results: Results, core_s: float, ticker: Ticker, live: LiveMap) -> None:
    book = VerdictBook()
    begun_s = time.thread_time()
    book.replace(results.verdict, results.snapshot.version, live)
    engine_s = time.thread_time() - begun_s
    period_s, hurried_s = (max(VERDICT_PERIOD_S, core_s / share) for share in (VERDICT_SHARE, HURRIED_SHARE))
    waits_ms = 1e3 * np.array(ticker.waits_s)
    print(
        f"{len(results.snapshot):,} points: a verdict {core_s:.2f} core s, one every {period_s:.1f} s "
        f"({core_s / period_s:.3f} core), so at most {period_s + core_s:.1f} s old; every {hurried_s:.1f} s "
        f"while lines wait; another thread waits {np.percentile(waits_ms, 50):.1f} ms, 99 in 100 within "
        f"{np.percentile(waits_ms, 99):.0f}, at most {waits_ms.max():.0f} core ms; put in force in "
        f"{1e3 * engine_s:.1f} ms of the engine",
        flush=True,
    )


if __name__ == "__main__":
    main()
