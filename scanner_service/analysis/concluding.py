"""From the sums of a batch of points to what their records say; fetches no neighbours but where a radius grows."""

import math

import numpy as np
from numba import njit

from scanner_service.analysis.doubles import doubles_on_other_side, tell_doubles
from scanner_service.analysis.gathering import gather, rings_for
from scanner_service.analysis.growing import grow, look_far, reach_mm
from scanner_service.analysis.intake import PER_MM, QUANTUM_MM
from scanner_service.analysis.judging import judge, reason_against
from scanner_service.analysis.kernel_rules import radius_limit_mm
from scanner_service.analysis.plane import fit_column, fit_planes
from scanner_service.analysis.settling import not_gone_by, passes_in_reach
from scanner_service.analysis.sides import box_of_lasers, count_other_side, may_be_seen_from_below, turn_to_laser

BATCH = 64
"""So many points are fitted at once."""


@njit(cache=True, nogil=True, error_model="numpy")
def conclude(
    batch, sums, fits, n, block, bits, block_laser_q, cell, chunk_next, chunk, more, next_double,
    has_doubles, side_q, points, laser_q, pass_bit, open_bits, heading, front_q, waits, rules, version,
    is_exact, wide, kept, changed, n_changed,
):  # fmt: skip
    """Fit a batch of points, let radii grow where that is needed, store the answers; the new number of changed rows.

    `batch` (5, BATCH) holds row, block, place, scanline and the open passes in reach. Where, and only where, the rule's
    radius leaves a point unreliable, it grows; when no step helps, the answer of the rule's own radius stands.
    """
    n_wide, wide_rings, wide_at = np.int64(0), np.int64(0), np.int64(-1)
    laser_box_q = np.empty((2, 3))
    boxed = np.int64(-1)
    reasons = np.empty(BATCH, dtype=np.int64)
    fit_planes(sums, n, fits)
    judge(sums, fits, n, rules, reasons)
    for i in range(n):
        row, b, place, own = batch[0, i], batch[1, i], batch[2, i], batch[3, i]
        passes = np.uint8(batch[4, i])
        reason = reasons[i]
        if fits[6, i] == 0.0:
            fit_column(sums, fits, i)
            reason = reason_against(sums, fits, i, rules)
        if wide_at != 64 * b + place:
            wide_at, wide_rings = 64 * b + place, np.int64(0)
        step = 0
        radius_mm = points[row].radius_mm
        if reason != 0 and not rules.is_flexible and radius_limit_mm(radius_mm, rules) > radius_mm:
            step, radius_mm, n_wide, wide_rings = grow(
                block, bits, cell, chunk_next, chunk, more, has_doubles, side_q,
                points, row, b, place, own, is_exact, rules, sums, fits, i, kept, wide, n_wide, wide_rings,
            )  # fmt: skip
            if step > 0:
                reason = 0
                if open_bits & ~passes:
                    reach = math.floor((radius_mm * PER_MM) ** 2)
                    passes = passes_in_reach(points, row, passes, wide, n_wide, reach, pass_bit)
        other_side = 0
        if reason == 0:
            turn_to_laser(points, row, own, laser_q, fits, i)
            if boxed != b:
                box_of_lasers(block, block_laser_q, b, laser_box_q)
                boxed = b
            if may_be_seen_from_below(points, row, fits, i, radius_mm, laser_box_q):
                rings = rings_for(radius_mm, side_q)
                if rings > wide_rings:
                    n_wide = gather(block, bits, cell, chunk_next, chunk, b, place, rings, wide)
                    wide_rings = rings
                other_side = count_other_side(points, row, wide, n_wide, radius_mm, laser_q, fits, i)
                if has_doubles:
                    reach = math.floor((radius_mm * PER_MM) ** 2)
                    other_side += doubles_on_other_side(
                        block,
                        bits,
                        cell,
                        chunk_next,
                        chunk,
                        more,
                        b,
                        place,
                        rings,
                        points,
                        row,
                        reach,
                        laser_q,
                        fits,
                        i,
                    )
        passes = not_gone_by(passes, points, row, heading, front_q, rules)
        if passes & ~waits[own]:
            waits[own] = 255
        if _store(points, row, sums, fits, i, reason, radius_mm, step, passes, other_side, version):
            changed[n_changed] = row
            n_changed += 1
            if has_doubles:
                n_changed = tell_doubles(points, row, next_double, changed, n_changed)
        if reason != 0 or step > 0 or rules.is_flexible:
            look_far(bits, b, place, rings_for(reach_mm(points, row, rules), side_q))
    return n_changed


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _store(points, row, sums, fits, i, reason, radius_mm, step, passes, other_side, version):
    """Write an answer into the point's record; True when it differs from the one before."""
    count = np.int32(sums[0, i])
    ax, ay, az = fits[0, i], fits[1, i], fits[2, i]
    if reason:
        ax, ay, az = math.nan, math.nan, math.nan
    nx, ny, nz = np.float32(ax), np.float32(ay), np.float32(az)
    to_mm2 = QUANTUM_MM * QUANTUM_MM
    middle = np.float32(fits[4, i] * to_mm2)
    smallest = np.float32(fits[5, i] * to_mm2)
    offset = np.float32(fits[7, i] * to_mm2 / (radius_mm * radius_mm))
    same = (
        points[row].changed_at > 0
        and points[row].neighbours == count
        and points[row].unreliable == reason
        and points[row].growth == step
        and points[row].other_side == other_side
        and points[row].open_passes == passes
        and points[row].middle_mm2 == middle
        and points[row].offset_sq == offset
        and points[row].smallest_mm2 == smallest
        and (reason != 0 or (points[row].nx == nx and points[row].ny == ny and points[row].nz == nz))
    )
    if same:
        return False
    points[row].neighbours = count
    points[row].unreliable = reason
    points[row].growth = step
    points[row].other_side = other_side
    points[row].open_passes = passes
    points[row].nx, points[row].ny, points[row].nz = nx, ny, nz
    points[row].middle_mm2 = middle
    points[row].smallest_mm2 = smallest
    points[row].offset_sq = offset
    points[row].changed_at = version
    return True
