"""A client of the live map that keeps a copy of every answer, and takes over what has changed when it asks.

What it takes is the list of the task: density, normal with its sign, reliable and settled. Knows no scanlines.
"""

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.points import GROWTH, GROWTH_REACH, PointArray
from scanner_service.analysis.snapshot import Int32Array, MapSnapshot, UInt8Array


@njit(cache=True, nogil=True, error_model="numpy")
def _take_over(
    points: PointArray,
    rows: Int32Array,
    max_radius_mm: float,
    density_per_mm2: npt.NDArray[np.float64],
    normals: npt.NDArray[np.float32],
    reliable: UInt8Array,
    settled: UInt8Array,
) -> None:
    """Copy the answers of the given rows out of the map's records."""
    for row in rows:
        base_mm = points[row].radius_mm
        limit_mm = max(base_mm, min(max_radius_mm, GROWTH_REACH * base_mm))
        growth = points[row].growth
        radius_mm = base_mm if growth == 0 else min(base_mm * GROWTH**growth, limit_mm)
        density_per_mm2[row] = points[row].neighbours / (math.pi * radius_mm * radius_mm)
        normals[row, 0] = points[row].nx
        normals[row, 1] = points[row].ny
        normals[row, 2] = points[row].nz
        reliable[row] = points[row].unreliable == 0
        settled[row] = points[row].open_passes == 0


class Reader:
    """Everything that was read, one row a point of the map."""

    def __init__(self, live_map: LiveMap, capacity: int) -> None:
        self._map = live_map
        self._version = 0
        self.rows_read = 0
        # Filled, not only reserved: the reader's memory must not be mistaken for the map's.
        self.density_per_mm2 = np.full(capacity, np.nan)
        self.normals = np.full((capacity, 3), np.nan, dtype=np.float32)
        self.reliable = np.full(capacity, 255, dtype=np.uint8)
        self.settled = np.full(capacity, 255, dtype=np.uint8)

    def take_update(self) -> None:
        """Have the map evaluated, and read every point that changed since the last time."""
        self._map.refresh()
        rows = self._map.changed_since(self._version)
        if rows is None:
            rows = np.arange(len(self._map), dtype=np.int32)
        self._version = self._map.version
        self.rows_read += len(rows)
        _take_over(
            self._map._points,  # a client in the same process, as fast as one can be
            rows,
            self._map._rules.max_radius_mm,
            self.density_per_mm2,
            self.normals,
            self.reliable,
            self.settled,
        )

    def rows_missed(self, snapshot: MapSnapshot) -> int:
        """How many rows differ from a snapshot taken after the last update: 0, or an update was lost."""
        n = len(snapshot)
        same_normal = np.isclose(self.normals[:n], snapshot.normals, rtol=0, atol=1e-6, equal_nan=True).all(axis=1)
        same = (
            np.isclose(self.density_per_mm2[:n], snapshot.density_per_mm2, rtol=1e-12)
            & same_normal
            & (self.reliable[:n] == snapshot.reliable)
            & (self.settled[:n] == snapshot.settled)
        )
        return int(n - same.sum())
