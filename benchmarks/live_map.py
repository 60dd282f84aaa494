"""The benchmark of the live map: runs it and its peers by turns, prints ratios, saves JSON.

python -m benchmarks.live_map --json live-map.json
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.cloud import LINE_SPACING_MM, NOISE_MM, POINT_SPACING_MM, POINTS_PER_LINE, RADIUS_MM
from benchmarks.machine import describe_machine, is_installed, wait_for_quiet
from benchmarks.summary import print_summary, summarise

ROOT = Path(__file__).resolve().parent.parent
PEER_LIMIT = 2_000_000
Figures = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Case:
    """One thing to measure: a module of this package, run in a process of its own with these arguments."""

    name: str
    threads: int
    module: str
    arguments: tuple[str, ...]


class BenchmarkFailed(Exception):
    """A measuring process ended with an error; the message is what it said."""


def cases(chosen: argparse.Namespace) -> Iterator[Case]:
    """What to measure in one round, ours and the peers by turns so that both see the same machine."""
    peers = [] if chosen.without_peers else ["scipy"] + (["open3d"] if is_installed("open3d") else [])
    far = max(1, chosen.points // 4)
    for threads in chosen.threads:
        points = ("--points", str(chosen.points))
        yield Case("reader", threads, "live_run", points)
        for peer in peers:
            asked = ("--peer", peer, "--points", str(min(chosen.points, PEER_LIMIT)))
            yield Case(peer, threads, "peers", asked)
        yield Case("each_line", threads, "live_run", (*points, "--each-line"))
        yield Case("flexible", threads, "live_run", ("--points", str(max(1, chosen.points // 2)), "--rule", "flexible"))
        for factor in () if chosen.one_radius else (2, 4):
            wide = ("--points", str(far), "--radius-factor", str(factor))
            yield Case(f"reader_{factor}r", threads, "live_run", wide)
            if "open3d" in peers:
                yield Case(f"open3d_{factor}r", threads, "peers", ("--peer", "open3d", *wide))


def run_case(case: Case, more: Sequence[str], environment: dict[str, str]) -> Figures:
    """Run one case in its own process, which gets `threads` cores and as many OpenMP threads.

    Raises
    ------
    BenchmarkFailed : the process ended with an error.
    """
    limits = {name: str(case.threads) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    command = [sys.executable, "-m", f"benchmarks.{case.module}", *case.arguments, *more]
    if case.module != "start_up":
        command += ["--threads", str(case.threads)]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=environment | limits,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise BenchmarkFailed(f"{case.name} with {case.threads} threads: {done.stderr.strip().splitlines()[-1:]}")
    figures: Figures = json.loads(done.stdout.splitlines()[-1])
    return figures


def start_up(environment: dict[str, str]) -> Figures:
    """A cold start with an empty cache, and warm ones with what it left there."""
    case = Case("start_up", 1, "start_up", ())
    cold = run_case(case, (), environment)
    warm = [run_case(case, (), environment) for _ in range(3)]
    warm.sort(key=lambda figures: figures["ready_s"])
    return {"cold": cold, "warm": warm[1]}


def run(chosen: argparse.Namespace) -> Figures:
    """Measure everything that was asked for."""
    begun = time.time()
    machine = describe_machine()
    rounds: dict[tuple[str, int], list[Figures]] = {}
    with tempfile.TemporaryDirectory(prefix="kernels-") as cache:
        environment = dict(os.environ)
        start = None
        if not chosen.warm_only:
            # A fresh cache also makes sure that the kernels measured are those of the sources as they are now.
            environment["NUMBA_CACHE_DIR"] = cache
            start = start_up(environment)
            _say(f"start-up: cold {start['cold']['ready_s']:.1f} s, warm {start['warm']['ready_s']:.2f} s")
        for number in range(chosen.repeats):
            for case in cases(chosen):
                wait_for_quiet(chosen.patience_s)
                more: list[str] = []
                if case.module == "live_run" and case.name != "flexible" and number == 0:
                    more = ["--checks", str(chosen.checks)]
                    if case.name == "reader" and chosen.points <= PEER_LIMIT:
                        more.append("--all-counts")
                figures = run_case(case, more, environment)
                rounds.setdefault((case.name, case.threads), []).append(figures)
                _say(
                    f"round {number + 1}: {case.name:<12} {case.threads} threads  "
                    f"{figures['points_per_s'] / 1e6:6.3f} million points/s  "
                    f"(others took {figures['cores_taken_by_others']:.2f} cores)"
                )
    return {
        "benchmark": "live-map",
        "begun_unix_s": begun,
        "took_s": time.time() - begun,
        "machine": machine | {"load_average_after": os.getloadavg()},
        "cloud": {
            "line_spacing_mm": LINE_SPACING_MM,
            "point_spacing_mm": POINT_SPACING_MM,
            "noise_mm": NOISE_MM,
            "points_per_line": POINTS_PER_LINE,
            "radius_mm": RADIUS_MM,
        },
        "points": chosen.points,
        "repeats": chosen.repeats,
        "start_up": start,
        "threads": summarise(rounds),
    }


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--points", type=int, default=2_000_000, help="points of a run; 20000000 for a release")
    parser.add_argument("--repeats", type=int, default=3, help="rounds; medians are reported")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="numbers of threads, a core each")
    parser.add_argument("--checks", type=int, default=20, help="random lines at which the oracle is asked, round one")
    parser.add_argument(
        "--patience-s", type=float, default=10.0, help="how long to wait for a quiet machine, each time"
    )
    parser.add_argument("--without-peers", action="store_true", help="leave Open3D and scipy out")
    parser.add_argument("--one-radius", action="store_true", help="leave 2r and 4r out")
    parser.add_argument(
        "--warm-only", action="store_true", help="leave the cold start out; kernels from the usual cache"
    )
    chosen = parser.parse_args(arguments)
    if min([chosen.points, chosen.repeats, *chosen.threads]) < 1 or chosen.checks < 0:
        parser.error("points, repeats and threads must be at least 1, checks at least 0")
    if max(chosen.threads) > len(os.sched_getaffinity(0)):
        parser.error(f"there are {len(os.sched_getaffinity(0))} cores: ask for no more threads than that")
    return chosen


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print, save; 0 when every check agreed with the oracle."""
    chosen = _arguments(arguments)
    try:
        result = run(chosen)
    except BenchmarkFailed as error:
        _say(str(error))
        return 1
    print_summary(result)
    if chosen.json is not None:
        chosen.json.parent.mkdir(parents=True, exist_ok=True)
        chosen.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
        _say(f"written to {chosen.json}")
    wrong = sum(figures["disagreements"] for figures in result["threads"].values())
    if wrong:
        _say(f"{wrong} answers differ from the oracle's: the figures mean nothing before that is mended")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
