"""Which open passes a point still waits for; knows no normals and no densities."""

import numpy as np
from numba import njit

from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.kernel_rules import Lines, Rules, radius_limit_mm
from scanner_service.analysis.points import LISTED, MAX_OPEN_PASSES, PointArray
from scanner_service.analysis.snapshot import Int32Array


@njit(cache=True, nogil=True, error_model="numpy")
def not_gone_by(bits, points, row, heading, front_q, rules):
    """Of the passes in `bits`, those whose laser plane is not yet more than the point's r_max beyond it."""
    if bits == 0:
        return bits
    x, y, z = points[row].x, points[row].y, points[row].z
    clearance_q = radius_limit_mm(points[row].radius_mm, rules) / QUANTUM_MM
    for slot in range(MAX_OPEN_PASSES):
        if bits & np.uint8(1 << slot):
            along = heading[slot, 0] * x + heading[slot, 1] * y + heading[slot, 2] * z
            if front_q[slot] - along > clearance_q:
                bits &= ~np.uint8(1 << slot)
    return bits


@njit(cache=True, nogil=True, error_model="numpy")
def passes_in_reach(points, row, bits, local, n, reach, pass_bit):
    """`bits`, and those of all open passes that have a point within reach."""
    px, py, pz = np.int64(points[row].x), np.int64(points[row].y), np.int64(points[row].z)
    for k in range(n):
        bit = pass_bit[np.int64(local[3, k])]
        if bit & ~bits:
            x, y, z = np.int64(local[0, k]) - px, np.int64(local[1, k]) - py, np.int64(local[2, k]) - pz
            if x * x + y * y + z * z <= reach:
                bits |= bit
    return bits


@njit(cache=True, nogil=True, error_model="numpy")
def settle_listed(
    listed: Int32Array, points: PointArray, lines: Lines, rules: Rules, version: int, settled: Int32Array
) -> tuple[int, int]:
    """Test the listed unsettled rows against where the passes are now.

    Rows that still wait are moved to the front of `listed`. Of the others those that nothing else changed in this
    version go to `settled`. Returns how many wait, and how many went there.
    """
    heading, front_q = lines.heading, lines.front_q
    waiting = 0
    done = 0
    for i in range(len(listed)):
        row = listed[i]
        bits = not_gone_by(points[row].open_passes & ~np.uint8(LISTED), points, row, heading, front_q, rules)
        if bits:
            points[row].open_passes = bits | np.uint8(LISTED)
            listed[waiting] = row
            waiting += 1
        else:
            points[row].open_passes = 0
            if points[row].changed_at != version:
                points[row].changed_at = version
                settled[done] = row
                done += 1
    return waiting, done


@njit(cache=True, nogil=True, error_model="numpy")
def list_unsettled(rows: Int32Array, points: PointArray, listed: Int32Array, used: int) -> int:
    """Append to `listed` the rows that wait for a pass and are not listed yet; returns the new length."""
    for row in rows:
        bits = points[row].open_passes
        if bits and not bits & np.uint8(LISTED):
            points[row].open_passes = bits | np.uint8(LISTED)
            listed[used] = row
            used += 1
    return used


@njit(cache=True, nogil=True, error_model="numpy")
def drop_pass(listed: Int32Array, points: PointArray, bit: int) -> None:
    """Forget a closed pass at every listed row."""
    for row in listed:
        points[row].open_passes &= ~np.uint8(bit)
