"""What a verdict over a map costs: core seconds, the share they take live, and how long another thread waits meanwhile.

python -m benchmarks.verdicts [--points N ...]
"""

import argparse
import threading
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from benchmarks.cloud import NOISE_MM, make_lines
from scanner_service.analysis.live_map import LiveMap, MapSettings
from scanner_service.rescan.requirement import Requirement
from scanner_service.sessions.cadence import HURRIED_SHARE, VERDICT_PERIOD_S, VERDICT_SHARE
from scanner_service.sessions.mirror import Mirror
from scanner_service.sessions.results import judge
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
    """One map after the other, each judged twice; the second is told, the first compiles and touches memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=[200_000, 1_000_000, 2_000_000])
    geometry = demo_scanner().geometry()
    for points in parser.parse_args().points:
        live = LiveMap(MapSettings(noise_mm=NOISE_MM, max_points=points + 5000))
        mirror, book, engine = Mirror(), VerdictBook(), _Engine(live)
        for number, line in enumerate(make_lines(points)):
            live.add(line)
            if number % 100 == 0:
                mirror.catch_up(engine, engine)
        for _ in range(2):
            with Ticker() as ticker:
                begun_s = time.thread_time()
                mirror.catch_up(engine, engine)
                snapshot = mirror.snapshot()
                results = judge(snapshot, Requirement(), geometry)
                core_s = time.thread_time() - begun_s
            begun_s = time.thread_time()
            book.replace(results.verdict, snapshot.version, live)
            engine_s = time.thread_time() - begun_s
        period_s, hurried_s = (max(VERDICT_PERIOD_S, core_s / share) for share in (VERDICT_SHARE, HURRIED_SHARE))
        waits_ms = 1e3 * np.array(ticker.waits_s)
        print(
            f"{len(snapshot):,} points: a verdict {core_s:.2f} core s, one every {period_s:.1f} s "
            f"({core_s / period_s:.3f} core), every {hurried_s:.1f} s while lines wait; another thread waits "
            f"{np.percentile(waits_ms, 50):.1f} ms, 99 in 100 within {np.percentile(waits_ms, 99):.0f}, at most "
            f"{waits_ms.max():.0f} core ms; put in force in {1e3 * engine_s:.1f} ms of the engine",
            flush=True,
        )
        live.close()


if __name__ == "__main__":
    main()
