"""Normals and their orientation beside Open3D and CloudCompare, each in a process of its own; ratios, memory, JSON.

python -m benchmarks.orientation --json orientation.json

The cloud is a bent ellipsoid, closed and evenly sampled, whose outside is known. Every tool estimates normals with
the same radius and orients them over nearest neighbours; the clock runs without reading and writing of files where the
tool lets it.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.machine import Neighbours, describe_machine, is_installed

ROOT = Path(__file__).resolve().parent.parent
Float64Array = npt.NDArray[np.float64]
_NEIGHBOURS = {"scanner": 8, "open3d": 8, "cloudcompare": 8}
_POINTS_IN_BALL = 15.0


def make_cloud(points: int, seed: int = 1) -> tuple[Float64Array, Float64Array, float]:
    """Points (n, 3) and outward normals (n, 3) of an ellipsoid with waves, and a radius that covers about 15 points."""
    rng = np.random.default_rng(seed)
    unit = rng.normal(size=(points, 3))
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    axes = np.array([100.0, 80.0, 60.0])
    normal = unit / axes
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    placed = unit * axes + rng.normal(0.0, 0.003, (points, 3))
    area = 4.0 * np.pi * ((8000.0**1.6 + 6000.0**1.6 + 4800.0**1.6) / 3.0) ** (1.0 / 1.6)
    return placed, normal, float(np.sqrt(_POINTS_IN_BALL * area / (np.pi * points)))


def ours(points_mm: Float64Array, radius_mm: float, threads: int) -> tuple[Float64Array, dict[str, float]]:
    """Normals of planes within one radius, oriented over the Riemannian graph, as `scanner analyse --method` does."""
    from scanner_service.analysis.normals.estimating import estimate_normals
    from scanner_service.analysis.normals.field import NormalOptions
    from scanner_service.analysis.orientation import orient_normals

    few = points_mm[:2000] * 0.02
    orient_normals(few, few)
    estimate_normals(few, "fixed_radius", NormalOptions(radius_mm=0.3))  # compiles
    begun = time.perf_counter()
    normals = estimate_normals(points_mm, "fixed_radius", NormalOptions(radius_mm=radius_mm, threads=threads)).normals
    estimated = time.perf_counter()
    found = orient_normals(points_mm, normals, neighbours=_NEIGHBOURS["scanner"], threads=threads)
    done = time.perf_counter()
    return found.normals, {
        "normals_s": estimated - begun,
        "orientation_s": done - estimated,
        "wall_s": done - begun,
        "confidence": float(found.components.confidence[0]),
    }


def open3d(points_mm: Float64Array, radius_mm: float) -> tuple[Float64Array, dict[str, float]]:
    """`estimate_normals` with a radius and `orient_normals_consistent_tangent_plane`."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points_mm))
    begun = time.perf_counter()
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamRadius(radius_mm))
    estimated = time.perf_counter()
    cloud.orient_normals_consistent_tangent_plane(_NEIGHBOURS["open3d"])
    done = time.perf_counter()
    return np.asarray(cloud.normals), {
        "normals_s": estimated - begun,
        "orientation_s": done - estimated,
        "wall_s": done - begun,
    }


def cloudcompare(points_mm: Float64Array, radius_mm: float) -> tuple[Float64Array, dict[str, float]]:
    """Its command line without a window: normals by octree and radius, orientation by spanning tree.

    What a run without normals takes, reading and writing, is taken off; the memory is that of the whole program.
    """
    with tempfile.TemporaryDirectory() as folder:
        cloud, out = Path(folder) / "cloud.xyz", Path(folder) / "out.xyz"
        np.savetxt(cloud, points_mm, fmt="%.5f")
        base = ["CloudCompare", "-SILENT", "-AUTO_SAVE", "OFF", "-C_EXPORT_FMT", "ASC", "-PREC", "6", "-O", str(cloud)]
        save = ["-SAVE_CLOUDS", "FILE", str(out)]
        work = ["-OCTREE_NORMALS", f"{radius_mm:.6f}", "-ORIENT_NORMS_MST", str(_NEIGHBOURS["cloudcompare"])]
        environment = os.environ | {"QT_QPA_PLATFORM": "offscreen", "XDG_RUNTIME_DIR": folder}
        took = []
        for steps in ([], work):
            out.unlink(missing_ok=True)
            begun = time.perf_counter()
            subprocess.run([*base, *steps, *save], env=environment, check=True, capture_output=True)
            took.append(time.perf_counter() - begun)
        table = np.loadtxt(out)
    return table[:, -3:], {"wall_s": took[1] - took[0], "reading_and_writing_s": took[0]}


def peak_bytes(children: bool) -> int:
    """Largest resident memory of this process, or of those it started."""
    import resource

    return 1024 * resource.getrusage(resource.RUSAGE_CHILDREN if children else resource.RUSAGE_SELF).ru_maxrss


def run_one(tool: str, points: int, threads: int) -> dict[str, Any]:
    """One tool in this process; figures and the share of normals that point outwards."""
    points_mm, _, radius_mm = make_cloud(points)
    others = Neighbours.watch()
    if tool == "scanner":
        normals, figures = ours(points_mm, radius_mm, threads)
    elif tool == "open3d":
        normals, figures = open3d(points_mm, radius_mm)
    else:
        normals, figures = cloudcompare(points_mm, radius_mm)
    taken = others.cores_taken()
    peak = peak_bytes(tool == "cloudcompare")
    outwards = (normals * make_cloud(points)[1]).sum(axis=1)  # the truth was not kept: its memory is not the tool's
    given = np.isfinite(outwards)
    return figures | {
        "right_share": float((outwards[given] > 0).mean()),
        "without_normal": int((~given).sum()),
        "peak_bytes": peak,
        "cores_taken_by_others": taken,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure every tool at hand in turn, print times, memory and ratios, save JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--without-peers", action="store_true")
    parser.add_argument("--tool", choices=tuple(_NEIGHBOURS), help=argparse.SUPPRESS)
    chosen = parser.parse_args(arguments)
    if chosen.tool is not None:
        print(json.dumps(run_one(chosen.tool, chosen.points, chosen.threads)))
        return 0
    tools = ["scanner"]
    if not chosen.without_peers:
        tools += ["open3d"] if is_installed("open3d") else []
        tools += ["cloudcompare"] if shutil.which("CloudCompare") else []
    found: dict[str, Any] = {}
    for tool in tools:
        command = [sys.executable, "-m", "benchmarks.orientation", "--tool", tool]
        command += ["--points", str(chosen.points), "--threads", str(chosen.threads)]
        limits = {"OMP_NUM_THREADS": str(chosen.threads)}
        done = subprocess.run(command, cwd=ROOT, env=os.environ | limits, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            print(f"{tool} failed: {done.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
            if tool == "scanner":
                return 1
            continue
        found[tool] = json.loads(done.stdout.splitlines()[-1])
        row = found[tool]
        ratio = found["scanner"]["wall_s"] / row["wall_s"]
        print(
            f"{tool:12}  {row['wall_s']:7.2f} s  ours/theirs {ratio:5.2f}  {row['peak_bytes'] / 1e6:6.0f} MB  "
            f"{row['right_share']:8.4%} outwards  {row['cores_taken_by_others']:.1f} cores taken by others",
            flush=True,
        )
    figures = {"points": chosen.points, "threads": chosen.threads, "machine": describe_machine(), "tools": found}
    if chosen.json is not None:
        chosen.json.parent.mkdir(parents=True, exist_ok=True)
        chosen.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
