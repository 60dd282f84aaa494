"""What ours is compared with: a plain principal component analysis, and Open3D where it is installed; nothing of ours.

Both are tried at many settings, of which the best one counts: they are told what nobody knows in practice.
"""

import importlib
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.comparison.running import Contestant, Estimator

COUNTS = (8, 10, 15, 20, 25, 30, 40, 60, 80, 120, 200, 320, 500)
_AT_ONCE = 2_000_000


def plain_pca(points_mm: Float64Array, count: int) -> Float64Array:
    """Normals (n, 3) from the covariance of the `count` nearest points, by numpy alone."""
    tree = cKDTree(points_mm)
    normals = np.empty_like(points_mm)
    step = max(1, _AT_ONCE // count)
    for first in range(0, len(points_mm), step):
        at = points_mm[first : first + step]
        rows = np.asarray(tree.query(at, k=np.arange(1, count + 1))[1])
        near = points_mm[rows]
        near -= near.mean(axis=1, keepdims=True)
        normals[first : first + step] = np.linalg.eigh(np.swapaxes(near, 1, 2) @ near)[1][:, :, 0]
    return normals


def peers(points: int) -> tuple[list[Contestant], list[str]]:
    """The contestants from outside for clouds of at least so many points, and notes on who is absent."""
    counts = [count for count in COUNTS if count <= max(points // 4, COUNTS[0])]

    def plain(count: int) -> Estimator:
        return lambda cloud: plain_pca(cloud, min(count, len(cloud)))

    found = [Contestant("plain_pca_best", {f"k={count}": plain(count) for count in counts})]
    try:
        open3d = importlib.import_module("open3d")
    except ImportError:
        return found, ["Open3D is not installed, so it is left out: `.venv/bin/pip install -e '.[bench]'` brings it"]

    found.append(Contestant("open3d_best", _open3d_settings(open3d, counts)))
    return found, []


def _open3d_settings(open3d: Any, counts: list[int]) -> dict[str, Estimator]:
    """Each of its searches: by number, within a radius, and at most so many within a radius.

    Radii are median distances to a number of neighbours, so that they are tried as finely as the numbers.
    """
    search = open3d.geometry

    settings: dict[str, Estimator] = {}
    for count in counts:
        settings[f"k={count}"] = partial(_open3d_within, open3d, count, lambda k, _: search.KDTreeSearchParamKNN(k))
    for count in counts[::2]:
        settings[f"radius of {count}"] = partial(
            _open3d_within, open3d, count, lambda _, radius: search.KDTreeSearchParamRadius(radius)
        )
        settings[f"at most {count} within the radius of {count}"] = partial(
            _open3d_within, open3d, count, lambda k, radius: search.KDTreeSearchParamHybrid(radius, k)
        )
    return settings


def _open3d_within(
    open3d: Any, count: int, search: Callable[[int, float], Any], points_mm: Float64Array
) -> Float64Array:
    """Normals (n, 3) by the search that is made of a number and the radius that suits it."""
    return _open3d_normals(open3d, points_mm, search(count, reach_mm(points_mm, count)))


def reach_mm(points_mm: Float64Array, count: int) -> float:
    """Median distance in mm of up to 2,000 of the points (n, 3) to the `count`-th nearest, itself counted."""
    some = points_mm[:: max(1, len(points_mm) // 2000)]
    return float(np.median(np.asarray(cKDTree(points_mm).query(some, k=[min(count, len(points_mm))])[0])))


def _open3d_normals(open3d: Any, points_mm: Float64Array, search: Any) -> Float64Array:
    """Normals (n, 3); a point with fewer than three neighbours gets +z from Open3D, and keeps it."""
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points_mm.copy()))
    cloud.estimate_normals(search)
    return np.asarray(cloud.normals).copy()
