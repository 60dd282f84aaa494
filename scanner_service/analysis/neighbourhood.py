"""Which points must be evaluated again, and the sums over their neighbours; judges nothing."""

import math

import numpy as np
from numba import njit

from scanner_service.analysis.around import lowest_bit
from scanner_service.analysis.concluding import BATCH, conclude
from scanner_service.analysis.doubles import add_doubles
from scanner_service.analysis.flexible import choose_flexible_radius
from scanner_service.analysis.gathering import Scratch, gather, gather_fresh, has_fresh, is_reached, rings_for
from scanner_service.analysis.grid import (
    CELL,
    CHUNK,
    COUNT,
    DOUBLES,
    FAR,
    FILLED,
    FIRST,
    LINE,
    NEXT_TO,
    ROW,
    Grid,
    X,
    Y,
    Z,
)
from scanner_service.analysis.growing import look_far, reach_mm
from scanner_service.analysis.intake import PER_MM
from scanner_service.analysis.kernel_rules import Lines, Rules
from scanner_service.analysis.points import PointArray
from scanner_service.analysis.settling import passes_in_reach
from scanner_service.analysis.snapshot import Int32Array
from scanner_service.analysis.sums import EXACT_LINES, EXACT_SIDE_Q, put, sums_within


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate_blocks(
    blocks: Int32Array,
    grid: Grid,
    points: PointArray,
    lines: Lines,
    rules: Rules,
    version: int,
    first_new: int,
    scratch: Scratch,
    changed: Int32Array,
) -> int:
    """Evaluate the points of the given blocks that something fresh may have reached.

    Puts the rows whose answer changed into `changed` and returns how many. Rows from `first_new` on are new since the
    last evaluation. An older point that none of them reaches is passed over, since nothing in its neighbourhood has
    changed; with 0 every point near a fresh cell is evaluated.

    The sums are exact integers of offsets from the point itself, so the answer depends on the set of points alone.
    """
    block, bits, block_laser_q, side_q = grid.block, grid.bits, grid.block_laser_q, grid.side_q[0]
    cell, chunk_next, chunk = grid.cell, grid.chunk_next, grid.chunk
    more, next_double, has_doubles = grid.more, grid.next_double, grid.used[DOUBLES] > 0
    laser_q, pass_bit, open_bits = lines.laser_q, lines.pass_bit, np.uint8(lines.open_bits[0])
    heading, front_q, waits = lines.heading, lines.front_q, lines.waits
    is_exact = side_q < EXACT_SIDE_Q and len(pass_bit) < EXACT_LINES
    near, wide, fresh = scratch.near, scratch.wide, scratch.fresh
    squares, kept = scratch.squares, scratch.kept
    far_rings = rings_for(rules.max_radius_mm, side_q)
    batch = np.empty((5, BATCH), dtype=np.int64)
    sums = np.empty((13, BATCH))
    fits = np.empty((8, BATCH))
    n_batch, n_changed = 0, 0
    for i in range(len(blocks)):
        b = np.int64(blocks[i])
        places = bits[b, FILLED] & (bits[b, NEXT_TO] | bits[b, FAR])
        next_to = bits[b, NEXT_TO]
        bits[b, NEXT_TO] = 0
        while places != np.uint64(0):
            place = lowest_bit(places)
            places &= places - np.uint64(1)
            rings = 1
            for k in range(3):
                rings += np.int64((bits[b, FAR + k] >> np.uint64(place)) & np.uint64(1))
            bit = np.uint64(1) << np.uint64(place)
            if next_to & bit == np.uint64(0) and not has_fresh(block, bits, b, place, rings):
                continue
            c = np.int64(block[b, CELL + place])
            here = np.int64(cell[c, FIRST])
            n_fresh = np.int64(0)
            if chunk[here, ROW, 0] < first_new:  # rows of a cell ascend: its first is its oldest
                n_fresh = gather_fresh(block, bits, cell, chunk_next, chunk, b, place, rings, fresh)
            if rings > 1:
                for k in range(3):
                    bits[b, FAR + k] &= ~bit
            n, n_wide = np.int64(-1), np.int64(-1)
            left = np.int64(cell[c, COUNT])
            while left > 0:
                for at in range(min(left, CHUNK)):
                    row = np.int64(chunk[here, ROW, at])
                    if row < first_new:
                        old_mm = reach_mm(points, row, rules)
                        reach = math.floor((old_mm * PER_MM) ** 2)
                        x, y, z = float(chunk[here, X, at]), float(chunk[here, Y, at]), float(chunk[here, Z, at])
                        if not is_reached(x, y, z, reach, fresh, n_fresh):
                            look_far(bits, b, place, rings_for(old_mm, side_q))
                            continue
                    if n < 0:
                        n = gather(block, bits, cell, chunk_next, chunk, b, place, 1, near)
                    own = np.int64(chunk[here, LINE, at])
                    if rules.is_flexible and not choose_flexible_radius(
                        points, row, near, n, wide, n_wide, squares, side_q, rules
                    ):
                        n_wide = gather(block, bits, cell, chunk_next, chunk, b, place, far_rings, wide)
                        choose_flexible_radius(points, row, near, n, wide, n_wide, squares, side_q, rules)
                    radius_q = points[row].radius_mm * PER_MM
                    reach = math.floor(radius_q**2)
                    is_near = radius_q < side_q - 0.5
                    if is_near:
                        put(sums, n_batch, sums_within(points, row, own, near, n, reach, is_exact))
                    else:
                        put(sums, n_batch, sums_within(points, row, own, wide, n_wide, reach, is_exact))
                    if has_doubles:
                        add_doubles(
                            block, bits, cell, chunk_next, chunk, more, b, place,
                            rings_for(points[row].radius_mm, side_q), points, row, own, reach, is_exact, sums, n_batch,
                        )  # fmt: skip
                    passes = pass_bit[own]
                    if open_bits & ~passes:
                        if is_near:
                            passes = passes_in_reach(points, row, passes, near, n, reach, pass_bit)
                        else:
                            passes = passes_in_reach(points, row, passes, wide, n_wide, reach, pass_bit)
                    batch[0, n_batch], batch[1, n_batch], batch[2, n_batch] = row, b, place
                    batch[3, n_batch], batch[4, n_batch] = own, passes
                    n_batch += 1
                    if n_batch == BATCH:
                        n_changed = conclude(
                            batch, sums, fits, n_batch, block, bits, block_laser_q, cell, chunk_next, chunk,
                            more, next_double, has_doubles, side_q, points, laser_q, pass_bit, open_bits, heading,
                            front_q, waits, rules, version, is_exact, wide, kept, changed, n_changed,
                        )  # fmt: skip
                        n_batch, n_wide = 0, np.int64(-1)  # the conclusion may have used the wide buffer
                left -= CHUNK
                here = np.int64(chunk_next[here])
    return conclude(
        batch, sums, fits, n_batch, block, bits, block_laser_q, cell, chunk_next, chunk,
        more, next_double, has_doubles, side_q, points, laser_q, pass_bit, open_bits, heading,
        front_q, waits, rules, version, is_exact, wide, kept, changed, n_changed,
    )  # fmt: skip
