"""What an entry of the grid adds that stands for several rows with the same coordinates; knows no planes."""

import numpy as np
from numba import njit

from scanner_service.analysis.around import AROUND_COUNT, AROUND_MASK, AROUND_NEAR, lowest_bit
from scanner_service.analysis.grid import CELL, CHUNK, COUNT, DOUBLED, FIRST, LINE, NEAR, X, Y, Z
from scanner_service.analysis.sums import is_in_floats


@njit(cache=True, nogil=True, error_model="numpy")
def add_doubles(
    block, bits, cell, chunk_next, chunk, more, b, place, rings, points, row, own, reach, is_exact, sums, i
):  # fmt: skip
    """Add to the sums of column i, which hold each entry within reach once, the rows that entries stand for besides."""
    px, py, pz = np.int64(points[row].x), np.int64(points[row].y), np.int64(points[row].z)
    in_floats = is_in_floats(sums[0, i], reach, is_exact)
    for k in range(AROUND_COUNT[rings, place]):
        other = np.int64(block[b, NEAR + AROUND_NEAR[rings, place, k]])
        if other < 0:
            continue
        mask = bits[other, DOUBLED] & AROUND_MASK[rings, place, k]
        while mask != np.uint64(0):
            c = np.int64(block[other, CELL + lowest_bit(mask)])
            mask &= mask - np.uint64(1)
            here, left = np.int64(cell[c, FIRST]), np.int64(cell[c, COUNT])
            while left > 0:
                for at in range(min(left, CHUNK)):
                    times = np.int64(more[here, at])
                    if times == 0:
                        continue
                    x, y, z = chunk[here, X, at] - px, chunk[here, Y, at] - py, chunk[here, Z, at] - pz
                    if x * x + y * y + z * z > reach:
                        continue
                    line = np.int64(chunk[here, LINE, at]) - own if in_floats else np.int64(1)
                    sums[0, i] += times
                    if chunk[here, LINE, at] != own:
                        sums[1, i] += times
                        sums[2, i] += times * line
                        sums[3, i] += times * line * line
                    sums[4, i] += times * x
                    sums[5, i] += times * y
                    sums[6, i] += times * z
                    sums[7, i] += times * x * x
                    sums[8, i] += times * x * y
                    sums[9, i] += times * x * z
                    sums[10, i] += times * y * y
                    sums[11, i] += times * y * z
                    sums[12, i] += times * z * z
                left -= CHUNK
                here = np.int64(chunk_next[here])


@njit(cache=True, nogil=True, error_model="numpy")
def doubles_on_other_side(
    block, bits, cell, chunk_next, chunk, more, b, place, rings, points, row, reach, laser_q, fits, i
):  # fmt: skip
    """How many of the rows that entries stand for besides were seen from the other side of the point's plane."""
    px, py, pz = np.int64(points[row].x), np.int64(points[row].y), np.int64(points[row].z)
    count = np.int64(0)
    for k in range(AROUND_COUNT[rings, place]):
        other = np.int64(block[b, NEAR + AROUND_NEAR[rings, place, k]])
        if other < 0:
            continue
        mask = bits[other, DOUBLED] & AROUND_MASK[rings, place, k]
        while mask != np.uint64(0):
            c = np.int64(block[other, CELL + lowest_bit(mask)])
            mask &= mask - np.uint64(1)
            here, left = np.int64(cell[c, FIRST]), np.int64(cell[c, COUNT])
            while left > 0:
                for at in range(min(left, CHUNK)):
                    x, y, z = np.int64(chunk[here, X, at]), np.int64(chunk[here, Y, at]), np.int64(chunk[here, Z, at])
                    if (x - px) ** 2 + (y - py) ** 2 + (z - pz) ** 2 <= reach:
                        line = np.int64(chunk[here, LINE, at])
                        height = fits[0, i] * (laser_q[line, 0] - x)
                        height += fits[1, i] * (laser_q[line, 1] - y)
                        height += fits[2, i] * (laser_q[line, 2] - z)
                        if height < 0.0:
                            count += more[here, at]
                left -= CHUNK
                here = np.int64(chunk_next[here])
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def tell_doubles(points, row, next_double, changed, n_changed):
    """Give the rows that share a row's entry its answer; the new number of changed rows."""
    double = np.int64(next_double[row]) - 1
    while double >= 0:
        points[double].neighbours = points[row].neighbours
        points[double].unreliable = points[row].unreliable
        points[double].growth = points[row].growth
        points[double].other_side = points[row].other_side
        points[double].open_passes = points[row].open_passes
        points[double].nx, points[double].ny, points[double].nz = points[row].nx, points[row].ny, points[row].nz
        points[double].middle_mm2 = points[row].middle_mm2
        points[double].smallest_mm2 = points[row].smallest_mm2
        points[double].offset_sq = points[row].offset_sq
        points[double].changed_at = points[row].changed_at
        changed[n_changed] = double
        n_changed += 1
        double = np.int64(next_double[double]) - 1
    return n_changed
