"""The tools that people use today, on the same points with the same radius, in a process of their own; JSON printed.

Both are batch computations: they begin when the last point is there. Open3D gives normals only; scipy and numpy
give everything that the live map gives, sign by the scanline's own laser position included.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from benchmarks.cloud import RADIUS_MM, coordinates_q, make_lines
from benchmarks.machine import Neighbours, fetch_memory, use_cores
from scanner_service.analysis.intake import QUANTUM_MM, StoredLine

Float64Array = npt.NDArray[np.float64]

_MEMORY_BYTES = 256 << 20
_MEMORY_BYTES_PER_POINT = 2000


def open3d_normals(points_mm: Float64Array, radius_mm: float) -> Callable[[], object]:
    """Open3D's `estimate_normals` with a radius, its cloud made beforehand."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points_mm))
    search = open3d.geometry.KDTreeSearchParamRadius(radius_mm)
    return lambda: cloud.estimate_normals(search)


def scipy_everything(
    points_mm: Float64Array, laser_mm: Float64Array, radius_mm: float
) -> tuple[npt.NDArray[np.int64], Float64Array]:
    """Counts (n,) and signed normals (n, 3) from scipy's cKDTree and numpy, without a loop over points."""
    from scipy.spatial import cKDTree

    n = len(points_mm)
    pairs = cKDTree(points_mm).query_pairs(radius_mm, output_type="ndarray")
    one, other = pairs[:, 0], pairs[:, 1]
    offset = points_mm[other] - points_mm[one]
    counts = np.bincount(one, minlength=n) + np.bincount(other, minlength=n) + 1
    mean = np.empty((n, 3))
    for i in range(3):
        mean[:, i] = np.bincount(one, offset[:, i], n) - np.bincount(other, offset[:, i], n)
    mean /= counts[:, None]
    moments = np.empty((n, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            product = offset[:, i] * offset[:, j]
            both = np.bincount(one, product, n) + np.bincount(other, product, n)
            moments[:, i, j] = moments[:, j, i] = both - counts * mean[:, i] * mean[:, j]
    normals = np.linalg.eigh(moments)[1][:, :, 0]
    away = ((laser_mm - points_mm) * normals).sum(axis=1) < 0
    normals[away] *= -1.0
    return counts, normals


def _lasers_mm(lines: list[StoredLine]) -> Float64Array:
    return np.repeat(np.array([line.laser_mm for line in lines]), [len(line.index) for line in lines], axis=0)


def measure(peer: str, points: int, radius_factor: float) -> dict[str, object]:
    """Time one peer on the cloud's first `points` points."""
    lines = make_lines(points)
    points_mm = coordinates_q(lines).astype(np.float64) * QUANTUM_MM
    radius_mm = radius_factor * RADIUS_MM
    if peer == "open3d":
        work = open3d_normals(points_mm, radius_mm)
        open3d_normals(points_mm[:5000].copy(), radius_mm)()
    else:
        laser_mm = _lasers_mm(lines)
        scipy_everything(points_mm[:5000], laser_mm[:5000], radius_mm)

        def work() -> object:
            return scipy_everything(points_mm, laser_mm, radius_mm)

    fetch_memory(_MEMORY_BYTES + len(points_mm) * _MEMORY_BYTES_PER_POINT)
    others = Neighbours.watch()
    begun_cpu, begun = time.process_time(), time.perf_counter()
    work()
    wall_s, cpu_s = time.perf_counter() - begun, time.process_time() - begun_cpu
    return {
        "peer": peer,
        "points": len(points_mm),
        "points_per_s": len(points_mm) / wall_s,
        "points_per_cpu_s": len(points_mm) / cpu_s,
        "cores_taken_by_others": others.cores_taken(),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Read what to measure from the command line, print the figures as one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peer", choices=("open3d", "scipy"), required=True)
    parser.add_argument("--points", type=int, required=True)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--radius-factor", type=float, default=1.0)
    chosen = parser.parse_args(arguments)
    use_cores(chosen.threads)
    print(json.dumps(measure(chosen.peer, chosen.points, chosen.radius_factor) | {"threads": chosen.threads}))


if __name__ == "__main__":
    main()
