"""From which side a surface was seen: the sign of a normal, and the neighbours that belong to a thin wall's back."""

import math

import numpy as np
from numba import njit

from scanner_service.analysis.grid import NEAR
from scanner_service.analysis.intake import QUANTUM_MM


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def turn_to_laser(points, row, own, laser_q, fits, i):
    """Eq. 6.11: the axis is flipped when it points away from the laser of the point's own scanline."""
    x, y, z = laser_q[own, 0] - points[row].x, laser_q[own, 1] - points[row].y, laser_q[own, 2] - points[row].z
    if fits[0, i] * x + fits[1, i] * y + fits[2, i] * z < 0.0:
        fits[0, i], fits[1, i], fits[2, i] = -fits[0, i], -fits[1, i], -fits[2, i]


@njit(cache=True, nogil=True, error_model="numpy")
def box_of_lasers(block, block_laser_q, b, box_q):
    """The box of the lasers that any point within RINGS cells of a block was seen from, put into `box_q` (2, 3)."""
    box_q[:] = block_laser_q[b]
    for near in range(27):
        other = np.int64(block[b, NEAR + near])
        if other >= 0:
            for axis in range(3):
                box_q[0, axis] = min(box_q[0, axis], block_laser_q[other, 0, axis])
                box_q[1, axis] = max(box_q[1, axis], block_laser_q[other, 1, axis])


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def may_be_seen_from_below(points, row, fits, i, radius_mm, laser_box_q):
    """False when every laser of the neighbourhood stands so high above the point's plane that all neighbours do too."""
    lowest = -radius_mm / QUANTUM_MM
    for axis in range(3):
        n = fits[axis, i]
        lowest += n * (laser_box_q[0, axis] if n > 0.0 else laser_box_q[1, axis])
    x, y, z = points[row].x, points[row].y, points[row].z
    return lowest <= fits[0, i] * x + fits[1, i] * y + fits[2, i] * z


@njit(cache=True, nogil=True, error_model="numpy")
def count_other_side(points, row, local, n, radius_mm, laser_q, fits, i):
    """Neighbours whose own ray comes from the other side of the point's plane."""
    px, py, pz = np.int64(points[row].x), np.int64(points[row].y), np.int64(points[row].z)
    reach = np.int64(math.floor((radius_mm / QUANTUM_MM) ** 2))
    count = 0
    for k in range(n):
        x, y, z = np.int64(local[0, k]) - px, np.int64(local[1, k]) - py, np.int64(local[2, k]) - pz
        if x * x + y * y + z * z <= reach:
            at = np.int64(local[3, k])
            height = fits[0, i] * (laser_q[at, 0] - local[0, k])
            height += fits[1, i] * (laser_q[at, 1] - local[1, k])
            height += fits[2, i] * (laser_q[at, 2] - local[2, k])
            if height < 0.0:
                count += 1
    return count
