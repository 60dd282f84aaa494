"""Which open passes a point still waits for; knows no normals and no densities."""

import numpy as np
import numpy.typing as npt
from numba import njit

from scanner_service.analysis.around import lowest_bit
from scanner_service.analysis.intake import PER_MM
from scanner_service.analysis.kernel_rules import Lines, Rules, radius_limit_mm
from scanner_service.analysis.points import MAX_OPEN_PASSES, PointArray
from scanner_service.analysis.snapshot import Int32Array, UInt8Array


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def not_gone_by(bits, points, row, heading, front_q, rules):
    """Of the passes in `bits`, those whose laser plane is not yet more than the point's r_max beyond it."""
    left = np.uint64(bits)
    if left == np.uint64(0):
        return bits
    x, y, z = float(points[row].x), float(points[row].y), float(points[row].z)
    clearance_q = radius_limit_mm(points[row].radius_mm, rules) * PER_MM
    while left != np.uint64(0):
        slot = lowest_bit(left)
        left &= left - np.uint64(1)
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
def settle_lines(
    first_row: Int32Array,
    box_q: Int32Array,
    clearance_q: npt.NDArray[np.float64],
    points: PointArray,
    lines: Lines,
    rules: Rules,
    version: int,
    settled: Int32Array,
) -> int:
    """Test the points of lines that wait against where the passes are now; returns how many settled.

    Rows that settle and that nothing else changed in this version go to `settled`. A line is looked at point by point
    only once a pass it waits for is far enough beyond the nearest corner of its box. `first_row` (L + 1,) says where
    the rows of each line begin, `box_q` (L, 2, 3) is the box of its points, `clearance_q` (L,) its least r_max.
    """
    heading, front_q, waits = lines.heading, lines.front_q, lines.waits
    words = waits.view(np.uint64)
    done = 0
    for word in range((len(first_row) + 6) // 8):
        if words[word] == 0:
            continue
        for line in range(8 * word, min(8 * word + 8, len(first_row) - 1)):
            if waits[line] == 0 or not _might_settle(line, box_q, clearance_q, waits[line], heading, front_q):
                continue
            still = np.uint8(0)
            for row in range(first_row[line], first_row[line + 1]):
                before = points[row].open_passes
                if before == 0:
                    continue
                bits = not_gone_by(before, points, row, heading, front_q, rules)
                points[row].open_passes = bits
                still |= bits
                if bits == 0 and points[row].changed_at != version:
                    points[row].changed_at = version
                    settled[done] = row
                    done += 1
            waits[line] = still
    return done


@njit(cache=True, nogil=True, error_model="numpy")
def _might_settle(line, box_q, clearance_q, waited_for, heading, front_q):
    """True when the plane of a pass that is waited for is beyond the nearest corner of the line's box by r_max."""
    for slot in range(MAX_OPEN_PASSES):
        if waited_for & np.uint8(1 << slot):
            lowest = 0.0
            for axis in range(3):
                h = heading[slot, axis]
                lowest += h * (box_q[line, 0, axis] if h > 0.0 else box_q[line, 1, axis])
            if front_q[slot] - lowest > 0.999999 * clearance_q[line] - 1.0:
                return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def drop_pass(first_row: Int32Array, points: PointArray, waits: UInt8Array, bit: int, settled: Int32Array) -> int:
    """Forget a closed pass at every point that waits for it; returns how many of them wait for nothing now.

    Their rows go to `settled`.
    """
    done = 0
    for line in range(len(first_row) - 1):
        if waits[line] & np.uint8(bit) == 0:
            continue
        still = np.uint8(0)
        for row in range(first_row[line], first_row[line + 1]):
            if points[row].open_passes & np.uint8(bit):
                points[row].open_passes &= ~np.uint8(bit)
                if points[row].open_passes == 0:
                    settled[done] = row
                    done += 1
            still |= points[row].open_passes
        waits[line] = still
    return done
