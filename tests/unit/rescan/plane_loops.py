"""Closed loops in a plane, for the tests: crossings, enclosed area, which points are inside."""

from collections.abc import Sequence

import numpy as np


def flattened(loops: Sequence[np.ndarray], points: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Loops (k, 3) and points (n, 3) in the plane that fits the loops best, two coordinates each."""
    corners = np.concatenate(loops)
    middle = corners.mean(axis=0)
    axes = np.linalg.svd(corners - middle, full_matrices=False)[2][:2]
    return [(loop - middle) @ axes.T for loop in loops], (points - middle) @ axes.T


def crossings(loop: np.ndarray) -> int:
    """How many pairs of edges, which share no vertex, properly cross; and how many vertices come twice."""
    start, end = loop, np.roll(loop, -1, axis=0)

    def side(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])

    a, b, c, d = start[:, None], end[:, None], start[None], end[None]
    proper = (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)
    return int(np.triu(proper).sum()) + len(loop) - len(np.unique(loop, axis=0))


def signed_area(loop: np.ndarray) -> float:
    x, y = loop.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def inside(loop: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Even-odd rule."""
    start, end = loop[None], np.roll(loop, -1, axis=0)[None]
    x, y = points[:, None, 0], points[:, None, 1]
    straddles = (start[..., 1] > y) != (end[..., 1] > y)
    rise = np.where(straddles, end[..., 1] - start[..., 1], 1.0)
    at = start[..., 0] + (y - start[..., 1]) / rise * (end[..., 0] - start[..., 0])
    return np.asarray((straddles & (at > x)).sum(axis=1) % 2 == 1)


def distance(loop: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n,) from points to the nearest edge."""
    start, edge = loop[None], (np.roll(loop, -1, axis=0) - loop)[None]
    away = points[:, None] - start
    length = np.maximum((edge**2).sum(axis=2), 1e-300)
    share = np.clip((away * edge).sum(axis=2) / length, 0.0, 1.0)
    return np.asarray(np.linalg.norm(away - share[..., None] * edge, axis=2).min(axis=1))
