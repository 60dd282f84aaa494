"""The batch answer that the live map must equal: scipy finds candidates, integers decide, numpy's SVD fits.

Knows nothing of how the live map works; shares with it only the definition of the stored truth.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

Q_MM = 2.0**-13


@dataclass(frozen=True)
class OraclePoint:
    """The batch answer for one point."""

    neighbours: int
    normal: np.ndarray | None
    is_comparable: bool
    rows: np.ndarray
    predicted_error_rad: float
    line_counts: list[int]


class Oracle:
    """Neighbourhoods of stored points (n, 3) int, each with its own radius (n,) in mm, lines (n,) and lasers (n, 3)."""

    def __init__(self, xyz_q, radius_mm, line, laser_mm, noise_mm=0.0, counted=None):
        self.q = np.asarray(xyz_q, dtype=np.int64)
        self.counted = np.ones(len(self.q), bool) if counted is None else np.asarray(counted)
        self.radius_mm = np.array(radius_mm, dtype=np.float64)
        self.line = np.asarray(line)
        self.laser_mm = np.asarray(laser_mm)
        self.noise_mm = noise_mm
        self.rows = np.flatnonzero(self.counted)
        self.tree = cKDTree(self.q[self.rows].astype(np.float64)) if len(self.rows) else None

    def neighbour_rows(self, row):
        near = self.tree.query_ball_point(self.q[row].astype(float), self.radius_mm[row] / Q_MM * (1 + 1e-9))
        near = self.rows[np.asarray(near, dtype=np.int64)]
        offset = self.q[near] - self.q[row]
        return near[(offset * offset).sum(axis=1) <= np.floor((self.radius_mm[row] / Q_MM) ** 2)]

    def at(self, row):
        near = self.neighbour_rows(row)
        offset = (self.q[near] - self.q[row]) * Q_MM
        centred = offset - offset.mean(axis=0)
        _, s, axes = np.linalg.svd(centred, full_matrices=True)
        s = np.concatenate([s, np.zeros(3 - len(s))])
        n = len(near)
        normal = axes[2]
        to_laser = self.laser_mm[row] - self.q[row] * Q_MM
        if normal @ to_laser < 0:
            normal = -normal
        residual = np.sqrt(s[2] ** 2 / (n - 3)) if n > 3 else np.nan
        with np.errstate(divide="ignore", invalid="ignore"):
            error = max(self.noise_mm, residual) / s[1] if n > 3 else np.nan
        counts = np.unique(self.line[near], return_counts=True)[1].tolist()
        comparable = s[0] > 0 and (s[1] ** 2 - s[2] ** 2) / s[0] ** 2 >= 1e-3
        return OraclePoint(n, normal, comparable, near, error, counts)
