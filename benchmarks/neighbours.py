"""How the cost of spherical range queries grows with the radius, for every structure at hand; table, plot, JSON.

python -m benchmarks.neighbours --json neighbours.json --out out

On a surface the points within r grow with its square, and so does whatever must touch each of them.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from benchmarks.cloud import RADIUS_MM, coordinates_q, make_lines
from benchmarks.machine import Neighbours, describe_machine, is_installed
from scanner_service.analysis.cloud import analyse_cloud
from scanner_service.analysis.intake import QUANTUM_MM

Float64Array = npt.NDArray[np.float64]
Count = Callable[[float], int]
FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
_NAMES = {
    "live_map": "live map (density and normals too)",
    "ckdtree_counts": "scipy cKDTree, counts",
    "ckdtree_lists": "scipy cKDTree, lists of neighbours",
    "open3d": "Open3D KDTreeFlann, one query a call",
}
_STYLES = ("o-", "s--", "^-.", "D:")


def structures(points_mm: Float64Array, queries: npt.NDArray[np.int64]) -> Iterator[tuple[str, int, Count]]:
    """Name, number of queries and the work of each structure: all neighbours within a radius, added up."""
    n = len(points_mm)
    asked = points_mm[queries]
    tree = cKDTree(points_mm)

    def live_map(radius_mm: float) -> int:
        return int(analyse_cloud(points_mm, "fixed", radius_mm=radius_mm).snapshot.neighbours.sum())

    def lists(radius_mm: float) -> int:
        found: Any = tree.query_ball_point(asked, radius_mm)
        return sum(len(rows) for rows in found)

    yield "live_map", n, live_map
    yield "ckdtree_counts", len(asked), lambda r: int(tree.query_ball_point(asked, r, return_length=True).sum())
    yield "ckdtree_lists", len(asked), lists
    if is_installed("open3d"):
        import open3d

        flann = open3d.geometry.KDTreeFlann(np.ascontiguousarray(points_mm.T))
        few = asked[: max(1, len(asked) // 10)]
        yield (
            "open3d",
            len(few),
            lambda r: sum(flann.search_radius_vector_3d(place, r)[0] for place in few),
        )


def measure(points: int, repeats: int, seed: int = 1) -> dict[str, Any]:
    """Best of `repeats` for each structure and radius; exponents are slopes of log time over log radius from r on."""
    points_mm = coordinates_q(make_lines(points)).astype(np.float64) * QUANTUM_MM
    rng = np.random.default_rng(seed)
    queries = rng.choice(len(points_mm), max(1, len(points_mm) // 5), replace=False)
    queries.sort()
    analyse_cloud(points_mm[:3000], "fixed", radius_mm=RADIUS_MM)  # compiles
    found: dict[str, Any] = {}
    for name, count, work in structures(points_mm, queries):
        rows = []
        for factor in FACTORS:
            radius_mm = factor * RADIUS_MM
            best, others, total = np.inf, 0.0, 0
            for _ in range(repeats):
                watch, begun = Neighbours.watch(), time.process_time()
                total = work(radius_mm)
                spent = time.process_time() - begun
                if spent < best:
                    best, others = spent, watch.cores_taken()
            rows.append(
                {
                    "radius_mm": radius_mm,
                    "neighbours": total / count,
                    "us_per_query": 1e6 * best / count,
                    "cores_taken_by_others": others,
                }
            )
        found[name] = {"queries": count, "rows": rows, "exponent": exponent(rows)}
    return {"points": len(points_mm), "machine": describe_machine(), "structures": found}


def exponent(rows: Sequence[dict[str, float]], key: str = "us_per_query") -> float:
    """The power of the radius with which a figure grows, over the upper half of the radii."""
    upper = rows[len(rows) // 2 :]
    radius, cost = np.log([row["radius_mm"] for row in upper]), np.log([row[key] for row in upper])
    return float(np.polyfit(radius, cost, 1)[0])


def plot(figures: dict[str, Any], path: Path) -> None:
    """Cost over radius, both in powers of ten, with a line that grows as the square."""
    figure = Figure(figsize=(8.5, 6), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for style, (name, found) in zip(_STYLES, figures["structures"].items(), strict=False):
        radius = np.array([row["radius_mm"] for row in found["rows"]])
        cost = [row["us_per_query"] for row in found["rows"]]
        axes.loglog(radius, cost, style, label=f"{_NAMES[name]}: grows as r^{found['exponent']:.1f}")
    rows = figures["structures"]["live_map"]["rows"]
    axes.loglog(radius, 0.35 * (radius / radius[0]) ** 2, color="#888888", linewidth=1, label="r²")
    axes.set_xticks(radius, [f"{r:.2f}\n{row['neighbours']:.0f}" for r, row in zip(radius, rows, strict=True)])
    axes.set_xticks([], minor=True)
    axes.set_xlabel("radius in mm, and how many neighbours it covers")
    axes.set_ylabel("processor time a query in µs")
    axes.set_title(f"Range queries among {figures['points']:,} points of a scanned surface")
    axes.grid(visible=True, which="both", color="#e4e4e4")
    axes.legend(frameon=False)
    figure.savefig(path)


def print_table(figures: dict[str, Any]) -> None:
    """One row a radius, one column a structure."""
    names = list(figures["structures"])
    first = figures["structures"][names[0]]["rows"]
    print(f"µs of processor time a query, {figures['points']:,} points")
    print("radius mm  neighbours  " + "  ".join(f"{name:>14}" for name in names))
    for at, row in enumerate(first):
        costs = [figures["structures"][name]["rows"][at]["us_per_query"] for name in names]
        print(f"{row['radius_mm']:9.3f}  {row['neighbours']:10.1f}  " + "  ".join(f"{cost:14.3f}" for cost in costs))
    print("exponent of r          " + "  ".join(f"{figures['structures'][name]['exponent']:14.2f}" for name in names))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the table, save JSON and plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=200_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--out", type=Path, default=Path("out"))
    chosen = parser.parse_args(arguments)
    figures = measure(chosen.points, chosen.repeats)
    print_table(figures)
    chosen.out.mkdir(parents=True, exist_ok=True)
    plot(figures, chosen.out / "neighbours.png")
    if chosen.json is not None:
        chosen.json.parent.mkdir(parents=True, exist_ok=True)
        chosen.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
