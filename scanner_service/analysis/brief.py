"""What a live stream tells of points, in the precision in which it is drawn; `describing.py` tells everything."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from drivers.scanline import BoolArray
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.points import GROWTH, GROWTH_REACH, NOT_COUNTED, PointArray
from scanner_service.analysis.snapshot import Int32Array, UInt8Array, Unreliable

_RELIABLE = int(Unreliable.RELIABLE)


class Brief(NamedTuple):
    """Points as of one version of the map; all arrays (m,) or (m, 3), the fields those of a `MapSnapshot`.

    `xyz_mm` are from the map's origin; the normals are NaN where they are unreliable.
    """

    xyz_mm: npt.NDArray[np.float32]
    density_per_mm2: npt.NDArray[np.float32]
    normals: npt.NDArray[np.float32]
    unreliable: UInt8Array
    settled: BoolArray
    isolated: BoolArray

    @property
    def reliable(self) -> BoolArray:
        """True where the normal is given."""
        reliable: BoolArray = self.unreliable == _RELIABLE
        return reliable


def brief_of(points: PointArray, rows: Int32Array, max_radius_mm: float) -> Brief:
    """The given rows (m,) of the map's records."""
    m = len(rows)
    brief = Brief(
        np.empty((m, 3), dtype=np.float32),
        np.empty(m, dtype=np.float32),
        np.empty((m, 3), dtype=np.float32),
        np.empty(m, dtype=np.uint8),
        np.empty(m, dtype=np.bool_),
        np.empty(m, dtype=np.bool_),
    )
    _fill(points, rows, max_radius_mm, *brief)
    return brief


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(points, rows, max_radius_mm, xyz_mm, density_per_mm2, normals, unreliable, settled, isolated):
    for i in range(len(rows)):
        point = points[rows[i]]
        xyz_mm[i, 0], xyz_mm[i, 1], xyz_mm[i, 2] = point.x * QUANTUM_MM, point.y * QUANTUM_MM, point.z * QUANTUM_MM
        base = point.radius_mm
        limit = max(base, min(max_radius_mm, GROWTH_REACH * base))
        radius = min(base * GROWTH ** np.float64(point.growth), limit)
        density_per_mm2[i] = point.neighbours / (math.pi * radius * radius)
        nx, ny, nz = np.float64(point.nx), np.float64(point.ny), np.float64(point.nz)
        length = math.sqrt(nx * nx + ny * ny + nz * nz)
        normals[i, 0], normals[i, 1], normals[i, 2] = nx / length, ny / length, nz / length
        unreliable[i] = point.unreliable
        settled[i] = point.open_passes == 0
        isolated[i] = settled[i] and point.neighbours <= 3 and point.unreliable != NOT_COUNTED
