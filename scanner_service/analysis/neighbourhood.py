"""What a point's neighbourhood says: count, plane, sign and reliability, from exact integer sums.

Knows the grid and the point records it fills; decides nothing about which radius a scanline gets, or who reads.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from scanner_service.analysis.grid import CHUNK, Grid, cell_near, place_in_block
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.plane import smallest_axis
from scanner_service.analysis.points import GROWTH, GROWTH_REACH, LISTED, MAX_OPEN_PASSES, PointArray
from scanner_service.analysis.snapshot import Int32Array, UInt8Array, Unreliable

_TOO_FEW = int(Unreliable.TOO_FEW)
_SINGLE_LINE = int(Unreliable.SINGLE_LINE)
_ILL_DETERMINED = int(Unreliable.ILL_DETERMINED)

MIN_POINTS = 6
"""Fewest points, the point itself counted, from which a normal is believed."""

MIN_GAP = 1e-3
"""A plane is determined where lambda2 - lambda3 >= MIN_GAP * lambda1 (the reach of the 1e-6 rad promise)."""

_NARROW_SIDE_Q = 13000
"""Up to this cell side the squared distance of any two points of neighbouring cells fits 32 bits."""

_INT32_SUM = 2.0**31
_NO_LINE = np.int32(2**31 - 1)


class Rules(NamedTuple):
    """What makes a normal believed, and how far a radius may grow; the same for the whole map."""

    needs_lines: bool
    noise_mm: float
    max_error_rad: float
    max_radius_mm: float


class Lines(NamedTuple):
    """What the kernel reads of scanlines and passes.

    `laser_q` (L, 3) laser positions in quanta from the origin; `pass_bit` (L,) the bit of the line's pass while that
    is open, else 0. For each of the MAX_OPEN_PASSES: `heading` (., 3) the unit normal of its laser planes in the
    direction of travel, NaN when unknown or not steady, and `front_q` (.,) how far along it the latest plane lies.
    """

    laser_q: npt.NDArray[np.float64]
    pass_bit: UInt8Array
    heading: npt.NDArray[np.float64]
    front_q: npt.NDArray[np.float64]


@njit(cache=True, nogil=True)
def _radius_limit_mm(base_mm, max_radius_mm):
    """r_max of a point whose rule gave `base_mm`."""
    return max(base_mm, min(max_radius_mm, GROWTH_REACH * base_mm))


@njit(cache=True, nogil=True)
def evaluate_cells(
    cells: Int32Array,
    grid: Grid,
    points: PointArray,
    lines: Lines,
    rules: Rules,
    version: int,
    changed: Int32Array,
) -> int:
    """Evaluate every point of the given cells; put the rows whose answer changed into `changed`, return how many.

    The sums are exact integers of offsets from the point itself, so the answer depends on the set of points alone.
    Where, and only where, the rule's radius leaves a point unreliable, its radius grows until it is reliable or
    r_max is reached; in the latter case the answer of the rule's own radius stands.
    """
    cell_at, cell_block, cell_first, cell_count = grid.cell_at, grid.cell_block, grid.cell_first, grid.cell_count
    block_key, block_near, block_cell, block_needy = grid.block_key, grid.block_near, grid.block_cell, grid.block_needy
    chunk_next, chunk_xyz, chunk_line = grid.chunk_next, grid.chunk_xyz, grid.chunk_line
    chunk_point, side_mm = grid.chunk_point, grid.side_q[0] * QUANTUM_MM
    laser_q, pass_bit, heading, front_q = lines.laser_q, lines.pass_bit, lines.heading, lines.front_q
    narrow = grid.side_q[0] < _NARROW_SIDE_Q
    has_passes = pass_bit.any()
    max_radius_mm = rules.max_radius_mm
    n_changed = 0
    found = np.empty(729, dtype=np.int64)
    near = np.empty((4, 512), dtype=np.int32)
    wide = np.empty((4, 512), dtype=np.int32)
    for i in range(len(cells)):
        cell = np.int64(cells[i])
        n_found, n = _cells_around(cell_at, cell_block, cell_count, block_key, block_near, block_cell, cell, 1, found)
        if n > near.shape[1]:
            near = np.empty((4, 2 * n), dtype=np.int32)
        _gather(chunk_next, chunk_xyz, chunk_line, cell_first, cell_count, found, n_found, near)
        n_wide = np.int64(-1)
        needy = False
        chunk = cell_first[cell]
        left = cell_count[cell]
        while left > 0:
            here = min(left, CHUNK)
            for j in range(here):
                row = chunk_point[chunk, j]
                base_mm = points[row].radius_mm
                answer = _answer(points, row, near, n, base_mm, narrow, rules)
                step = 0
                if answer[1] != 0:
                    limit_mm = _radius_limit_mm(base_mm, max_radius_mm)
                    if limit_mm > base_mm:
                        needy = True
                        if n_wide < 0:
                            rings = min(4, math.ceil(limit_mm / side_mm))
                            n_found, n_wide = _cells_around(
                                cell_at, cell_block, cell_count, block_key, block_near, block_cell, cell, rings, found
                            )
                            if n_wide > wide.shape[1]:
                                wide = np.empty((4, 2 * n_wide), dtype=np.int32)
                            _gather(chunk_next, chunk_xyz, chunk_line, cell_first, cell_count, found, n_found, wide)
                        step, grown = _grow(points, row, wide, n_wide, base_mm, limit_mm, rules)
                        if step > 0:
                            answer = grown
                passes = np.uint8(0)
                if has_passes:
                    if step > 0:
                        reach_mm = min(base_mm * GROWTH**step, limit_mm)
                        passes = _passes_in_reach(points, row, wide, n_wide, reach_mm, pass_bit)
                    else:
                        passes = _passes_in_reach(points, row, near, n, base_mm, pass_bit)
                    passes = _not_gone_by(passes, points, row, heading, front_q, max_radius_mm)
                if _store(points, row, answer, step, passes, laser_q, version):
                    changed[n_changed] = row
                    n_changed += 1
            left -= here
            chunk = chunk_next[chunk]
        bit = np.uint64(1) << np.uint64(place_in_block(cell_at, cell))
        if needy:
            block_needy[cell_block[cell]] |= bit
        else:
            block_needy[cell_block[cell]] &= ~bit
    return n_changed


@njit(cache=True, nogil=True)
def _cells_around(cell_at, cell_block, cell_count, block_key, block_near, block_cell, cell, rings, found):
    """Put the cells up to `rings` away into `found`; returns how many, and how many points they hold."""
    n_found = 0
    n_points = np.int64(0)
    for dx in range(-rings, rings + 1):
        for dy in range(-rings, rings + 1):
            for dz in range(-rings, rings + 1):
                other = cell_near(cell_at, cell_block, block_key, block_near, block_cell, cell, dx, dy, dz)
                if other >= 0:
                    found[n_found] = other
                    n_found += 1
                    n_points += cell_count[other]
    return n_found, n_points


@njit(cache=True, nogil=True)
def _gather(chunk_next, chunk_xyz, chunk_line, cell_first, cell_count, found, n_found, buffer):
    """Copy x, y, z and line of every point in the cells found."""
    n = 0
    for k in range(n_found):
        chunk = cell_first[found[k]]
        left = cell_count[found[k]]
        while left > 0:
            here = min(left, CHUNK)
            for j in range(here):
                buffer[0, n] = chunk_xyz[chunk, 0, j]
                buffer[1, n] = chunk_xyz[chunk, 1, j]
                buffer[2, n] = chunk_xyz[chunk, 2, j]
                buffer[3, n] = chunk_line[chunk, j]
                n += 1
            left -= here
            chunk = chunk_next[chunk]


@njit(cache=True, nogil=True)
def _grow(points, row, wide, n_wide, base_mm, limit_mm, rules):
    """The first step at which the grown radius makes the point reliable, with its answer; step 0 when none does."""
    step = 0
    radius_mm = base_mm
    answer = _answer(points, row, wide, 0, base_mm, False, rules)
    while radius_mm < limit_mm:
        step += 1
        radius_mm = min(base_mm * GROWTH**step, limit_mm)
        answer = _answer(points, row, wide, n_wide, radius_mm, False, rules)
        if answer[1] == 0:
            return step, answer
    return 0, answer


@njit(cache=True, nogil=True)
def _answer(points, row, local, n, radius_mm, narrow, rules):
    """(Np, reason, nx, ny, nz, lambda2 mm2, lambda3 mm2, offset^2) of a point with this radius."""
    reach = math.floor((radius_mm / QUANTUM_MM) ** 2)
    fits = narrow and reach < _INT32_SUM
    if fits:
        moments = _moments_narrow(points, row, local, n, np.int32(reach))
        fits = float(moments[0]) * reach < _INT32_SUM
    if not fits:
        moments = _moments_wide(points, row, local, n, np.int64(reach))
    count, own, low, high, sx, sy, sz, sxx, sxy, sxz, syy, syz, szz = moments
    total = float(count)
    fx, fy, fz = float(sx), float(sy), float(sz)
    per = 1.0 / max(total, 1.0)
    # Np times the central moments, from exact sums: no digits are lost far from the origin.
    ax, ay, az, l1, l2, l3 = smallest_axis(
        sxx - fx * fx * per,
        sxy - fx * fy * per,
        sxz - fx * fz * per,
        syy - fy * fy * per,
        syz - fy * fz * per,
        szz - fz * fz * per,
    )
    to_mm2 = QUANTUM_MM * QUANTUM_MM
    l2_mm2, l3_mm2 = l2 * to_mm2, l3 * to_mm2
    two_lines = low == high and own >= 2 and count - own >= 2
    three_lines = high >= 0 and low < high
    reason = 0
    if count < MIN_POINTS:
        reason = _TOO_FEW
    elif rules.needs_lines and not (two_lines or three_lines):
        reason = _SINGLE_LINE
    else:
        # sigma / sqrt(lambda2) <= limit, sigma the larger of the scanner's noise and the residual, all squared
        sigma_sq = max(rules.noise_mm * rules.noise_mm, l3_mm2 / (total - 3.0))
        limit_sq = rules.max_error_rad * rules.max_error_rad
        if not sigma_sq <= limit_sq * l2_mm2 or l2 - l3 < MIN_GAP * l1:
            reason = _ILL_DETERMINED
    radius_q = radius_mm / QUANTUM_MM
    offset = (fx * fx + fy * fy + fz * fz) * per * per / (radius_q * radius_q)
    return count, reason, ax, ay, az, l2_mm2, l3_mm2, offset


@njit(cache=True, nogil=True)
def _moments_narrow(points, row, local, n, reach):
    """Counts and moments of the candidates within reach, in 32 bits and without a branch, for vector registers."""
    px, py, pz, own = points[row].x, points[row].y, points[row].z, points[row].line
    count, own_count = np.int32(0), np.int32(0)
    low, high = _NO_LINE, np.int32(-1)
    sx, sy, sz = np.int32(0), np.int32(0), np.int32(0)
    sxx, sxy, sxz = np.int32(0), np.int32(0), np.int32(0)
    syy, syz, szz = np.int32(0), np.int32(0), np.int32(0)
    for k in range(n):
        x, y, z = np.int32(local[0, k] - px), np.int32(local[1, k] - py), np.int32(local[2, k] - pz)
        xx, yy, zz = np.int32(x * x), np.int32(y * y), np.int32(z * z)
        inside = np.int32(xx + yy + zz) <= reach
        line = local[3, k]
        x, y, z = (x, y, z) if inside else (np.int32(0), np.int32(0), np.int32(0))
        is_own = inside and line == own
        is_other = inside and line != own
        count = np.int32(count + np.int32(inside))
        own_count = np.int32(own_count + np.int32(is_own))
        low = min(low, line if is_other else _NO_LINE)
        high = max(high, line if is_other else np.int32(-1))
        sx, sy, sz = np.int32(sx + x), np.int32(sy + y), np.int32(sz + z)
        sxx, sxy, sxz = np.int32(sxx + x * x), np.int32(sxy + x * y), np.int32(sxz + x * z)
        syy, syz, szz = np.int32(syy + y * y), np.int32(syz + y * z), np.int32(szz + z * z)
    return (
        np.int64(count),
        np.int64(own_count),
        low,
        high,
        np.int64(sx),
        np.int64(sy),
        np.int64(sz),
        np.int64(sxx),
        np.int64(sxy),
        np.int64(sxz),
        np.int64(syy),
        np.int64(syz),
        np.int64(szz),
    )


@njit(cache=True, nogil=True)
def _moments_wide(points, row, local, n, reach):
    """The same as `_moments_narrow` for any radius, in 64 bits."""
    px, py, pz = np.int64(points[row].x), np.int64(points[row].y), np.int64(points[row].z)
    own = points[row].line
    count, own_count = np.int64(0), np.int64(0)
    low, high = _NO_LINE, np.int32(-1)
    sx, sy, sz = np.int64(0), np.int64(0), np.int64(0)
    sxx, sxy, sxz = np.int64(0), np.int64(0), np.int64(0)
    syy, syz, szz = np.int64(0), np.int64(0), np.int64(0)
    for k in range(n):
        x, y, z = local[0, k] - px, local[1, k] - py, local[2, k] - pz
        if x * x + y * y + z * z <= reach:
            line = local[3, k]
            count += 1
            if line == own:
                own_count += 1
            else:
                low = min(low, line)
                high = max(high, line)
            sx += x
            sy += y
            sz += z
            sxx += x * x
            sxy += x * y
            sxz += x * z
            syy += y * y
            syz += y * z
            szz += z * z
    return count, own_count, low, high, sx, sy, sz, sxx, sxy, sxz, syy, syz, szz


@njit(cache=True, nogil=True)
def _store(points, row, answer, step, passes, laser_q, version):
    """Write an answer into the point's record; True when it differs from the one before."""
    count, reason, ax, ay, az, l2_mm2, l3_mm2, offset = answer
    point = points[row]
    if reason:
        ax, ay, az = math.nan, math.nan, math.nan
    else:
        at = point.line
        to_x, to_y = laser_q[at, 0] - point.x, laser_q[at, 1] - point.y
        if ax * to_x + ay * to_y + az * (laser_q[at, 2] - point.z) < 0.0:  # Eq. 6.11
            ax, ay, az = -ax, -ay, -az
    nx, ny, nz = np.float32(ax), np.float32(ay), np.float32(az)
    waiting = point.open_passes & np.uint8(LISTED)
    same = (
        point.neighbours == count
        and point.unreliable == reason
        and point.growth == step
        and point.open_passes & ~np.uint8(LISTED) == passes
        and (reason != 0 or (point.nx == nx and point.ny == ny and point.nz == nz))
    )
    if same and point.changed_at > 0:
        return False
    point.neighbours = count
    point.unreliable = reason
    point.growth = step
    point.open_passes = passes | waiting
    point.nx, point.ny, point.nz = nx, ny, nz
    point.middle_mm2 = l2_mm2
    point.smallest_mm2 = l3_mm2
    point.offset_sq = offset
    point.changed_at = version
    return True


@njit(cache=True, nogil=True)
def _not_gone_by(bits, points, row, heading, front_q, max_radius_mm):
    """Of the passes in `bits`, those whose laser plane is not yet more than the point's r_max beyond it."""
    if bits == 0:
        return bits
    x, y, z = points[row].x, points[row].y, points[row].z
    clearance_q = _radius_limit_mm(points[row].radius_mm, max_radius_mm) / QUANTUM_MM
    for slot in range(MAX_OPEN_PASSES):
        if bits & np.uint8(1 << slot):
            along = heading[slot, 0] * x + heading[slot, 1] * y + heading[slot, 2] * z
            if front_q[slot] - along > clearance_q:
                bits &= ~np.uint8(1 << slot)
    return bits


@njit(cache=True, nogil=True)
def _passes_in_reach(points, row, local, n, radius_mm, pass_bit):
    """The bits of all open passes that have a point within reach."""
    px, py, pz = np.int64(points[row].x), np.int64(points[row].y), np.int64(points[row].z)
    bits = pass_bit[points[row].line]
    reach = np.int64(math.floor((radius_mm / QUANTUM_MM) ** 2))
    for k in range(n):
        bit = pass_bit[local[3, k]]
        if bit & ~bits:
            x, y, z = local[0, k] - px, local[1, k] - py, local[2, k] - pz
            if x * x + y * y + z * z <= reach:
                bits |= bit
    return bits


@njit(cache=True, nogil=True)
def settle_listed(
    listed: Int32Array, points: PointArray, lines: Lines, rules: Rules, version: int, settled: Int32Array
) -> tuple[int, int]:
    """Test the listed unsettled rows against where the passes are now.

    Rows that still wait are moved to the front of `listed`. Of the others those that nothing else changed in this
    version go to `settled`. Returns how many wait, and how many went there.
    """
    heading, front_q, max_radius_mm = lines.heading, lines.front_q, rules.max_radius_mm
    waiting = 0
    done = 0
    for i in range(len(listed)):
        row = listed[i]
        bits = _not_gone_by(points[row].open_passes & ~np.uint8(LISTED), points, row, heading, front_q, max_radius_mm)
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


@njit(cache=True, nogil=True)
def list_unsettled(rows: Int32Array, points: PointArray, listed: Int32Array, used: int) -> int:
    """Append to `listed` the rows that wait for a pass and are not listed yet; returns the new length."""
    for row in rows:
        bits = points[row].open_passes
        if bits and not bits & np.uint8(LISTED):
            points[row].open_passes = bits | np.uint8(LISTED)
            listed[used] = row
            used += 1
    return used


@njit(cache=True, nogil=True)
def drop_pass(listed: Int32Array, points: PointArray, bit: int) -> None:
    """Forget a closed pass at every listed row."""
    for row in listed:
        points[row].open_passes &= ~np.uint8(bit)
