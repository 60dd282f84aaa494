"""What graphs of a large cloud cost, each in a process of its own: seconds of its threads, memory, edges, JSON.

python -m benchmarks.graphs --json graphs.json

The cloud is the closed, noisy body of `benchmarks.orientation`. Kernels are compiled before the clock runs.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.machine import Neighbours, describe_machine, resident_bytes
from benchmarks.orientation import ROOT, make_cloud, peak_bytes

GRAPHS = (
    "nearest_neighbour_graph",
    "euclidean_spanning_tree",
    "riemannian_graph",
    "relative_neighbourhood_graph",
    "gabriel_graph",
)


def run_one(name: str, points: int) -> dict[str, float]:
    """One graph in this process; memory before the graph is that of points, libraries and kernels."""
    from scanner_service.analysis import graphs

    points_mm = make_cloud(points)[0]
    make = getattr(graphs, name)
    make(points_mm[:2000])  # compiles, or fetches what is compiled
    before = resident_bytes()
    others = Neighbours.watch()
    wall, processor = time.perf_counter(), time.process_time()
    matrix = make(points_mm)
    return {
        "processor_s": time.process_time() - processor,
        "wall_s": time.perf_counter() - wall,
        "edges": matrix.nnz // 2,
        "before_bytes": before,
        "peak_bytes": peak_bytes(False),
        "cores_taken_by_others": others.cores_taken(),
        "load": os.getloadavg()[0],
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure every graph in turn, print a line each, save JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--graph", choices=GRAPHS, action="append", help="only this one; repeat it for more")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args(arguments)
    names = chosen.graph or GRAPHS
    if chosen.here:
        print(json.dumps(run_one(names[0], chosen.points)))
        return 0
    found: dict[str, dict[str, float]] = {}
    for name in names:
        command = [sys.executable, "-m", "benchmarks.graphs", "--here", "--graph", name, "--points", str(chosen.points)]
        subprocess.run(
            [*command[:-1], "2000"], cwd=ROOT, capture_output=True, check=True
        )  # compiles in a process apart
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
        row = found[name] = json.loads(done.stdout.splitlines()[-1])
        print(
            f"{name:29} {row['processor_s']:6.2f} s of processor time, {row['wall_s']:6.2f} s of the clock, "
            f"{row['before_bytes'] / 1e6:4.0f} MB before, {row['peak_bytes'] / 1e6:4.0f} MB at most, "
            f"{row['edges']:,} edges, load {row['load']:.0f}",
            flush=True,
        )
    if chosen.json is not None:
        figures = {"points": chosen.points, "machine": describe_machine(), "graphs": found}
        chosen.json.parent.mkdir(parents=True, exist_ok=True)
        chosen.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
