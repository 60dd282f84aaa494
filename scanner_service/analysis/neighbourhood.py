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

_EXACT = 2.0**52
"""Whole numbers up to here are exact in float64, and so are their sums in any order."""

_EXACT_SIDE_Q = 2**23
"""Up to this cell side the squared distance of any two points gathered is such a number."""

_EXACT_LINES = 2**19
"""Up to this many scanlines the sums that tell one line from several are, too."""

_VECTOR = 16
"""The candidates are padded to a multiple of this, so that vector registers run full."""

_FAR = 1e15


class Rules(NamedTuple):
    """What makes a normal believed, and how far a radius may grow; the same for the whole map."""

    needs_lines: bool
    noise_mm: float
    max_error_rad: float
    max_radius_mm: float


class Lines(NamedTuple):
    """What the kernel reads of scanlines and passes.

    `laser_q` (L, 3) laser positions in quanta from the origin; `pass_bit` (L,) the bit of the line's pass while that
    is open, else 0; `open_bits` (1,) all of these together. For each of the MAX_OPEN_PASSES: `heading` (., 3) the unit
    normal of its laser planes in the direction of travel, NaN when unknown or not steady, and `front_q` (.,) how far
    along it the latest plane lies.
    """

    laser_q: npt.NDArray[np.float64]
    pass_bit: UInt8Array
    open_bits: UInt8Array
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
    first_new: int,
    changed: Int32Array,
) -> int:
    """Evaluate the points of the given cells; put the rows whose answer changed into `changed`, return how many.

    Rows from `first_new` on are new since the last evaluation. An older point that none of them reaches is passed
    over, since nothing in its neighbourhood has changed; with 0 every point is evaluated.

    The sums are exact integers of offsets from the point itself, so the answer depends on the set of points alone.
    Where, and only where, the rule's radius leaves a point unreliable, its radius grows until it is reliable or
    r_max is reached; in the latter case the answer of the rule's own radius stands.
    """
    cell_at, cell_block, cell_count = grid.cell_at, grid.cell_block, grid.cell_count
    cell_first, cell_last = grid.cell_first, grid.cell_last
    block_key, block_near, block_cell, block_needy = grid.block_key, grid.block_near, grid.block_cell, grid.block_needy
    chunk_next, chunk_xyz, chunk_line = grid.chunk_next, grid.chunk_xyz, grid.chunk_line
    chunk_point, side_mm = grid.chunk_point, grid.side_q[0] * QUANTUM_MM
    laser_q, pass_bit, heading, front_q = lines.laser_q, lines.pass_bit, lines.heading, lines.front_q
    is_exact = grid.side_q[0] < _EXACT_SIDE_Q and len(pass_bit) < _EXACT_LINES
    max_radius_mm = rules.max_radius_mm
    n_changed = 0
    found = np.empty(27, dtype=np.int64)
    far = np.empty(729, dtype=np.int64)
    fresh = np.empty((3, 512))
    near = np.empty((4, 512))
    wide = np.empty((4, 512))
    open_bits = np.uint8(lines.open_bits[0])
    for i in range(len(cells)):
        cell = np.int64(cells[i])
        n_found, n = _cells_around(cell_at, cell_block, cell_count, block_key, block_near, block_cell, cell, 1, found)
        if n + _VECTOR > near.shape[1]:
            near = np.empty((4, 2 * n + _VECTOR))
            fresh = np.empty((3, 2 * n + _VECTOR))
        bit = np.uint64(1) << np.uint64(place_in_block(cell_at, cell))
        was_needy = block_needy[cell_block[cell]] & bit != 0
        n_fresh = np.int64(0)
        if not was_needy:
            n_fresh = _gather_fresh(
                chunk_next, chunk_xyz, chunk_point, cell_first, cell_last, cell_count, found, n_found, first_new, fresh
            )
        is_gathered = False
        n_wide = np.int64(-1)
        needy = False
        chunk = cell_first[cell]
        left = cell_count[cell]
        while left > 0:
            here = min(left, CHUNK)
            for j in range(here):
                row = chunk_point[chunk, j]
                if row < first_new and not was_needy and not _is_reached(points, row, fresh, n_fresh):
                    continue
                if not is_gathered:
                    _gather(chunk_next, chunk_xyz, chunk_line, cell_first, cell_count, found, n_found, near)
                    is_gathered = True
                base_mm = points[row].radius_mm
                answer = _answer(points, row, near, n, base_mm, is_exact, rules)
                step = 0
                if answer[1] != 0:
                    limit_mm = _radius_limit_mm(base_mm, max_radius_mm)
                    if limit_mm > base_mm:
                        needy = True
                        if n_wide < 0:
                            rings = min(4, math.ceil(limit_mm / side_mm))
                            n_far, n_wide = _cells_around(
                                cell_at, cell_block, cell_count, block_key, block_near, block_cell, cell, rings, far
                            )
                            if n_wide + _VECTOR > wide.shape[1]:
                                wide = np.empty((4, 2 * n_wide + _VECTOR))
                            _gather(chunk_next, chunk_xyz, chunk_line, cell_first, cell_count, far, n_far, wide)
                        step, grown = _grow(points, row, wide, n_wide, base_mm, limit_mm, is_exact, rules)
                        if step > 0:
                            answer = grown
                passes = pass_bit[points[row].line]
                if open_bits & ~passes:
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
        if needy:
            block_needy[cell_block[cell]] |= bit
        elif was_needy:
            block_needy[cell_block[cell]] &= ~bit
    return n_changed


@njit(cache=True, nogil=True)
def _gather_fresh(
    chunk_next, chunk_xyz, chunk_point, cell_first, cell_last, cell_count, found, n_found, first_new, fresh
):
    """Copy the coordinates of those points in the cells found that are new, and pad; returns how many."""
    n = np.int64(0)
    for k in range(n_found):
        cell = found[k]
        if chunk_point[cell_last[cell], (cell_count[cell] - 1) % CHUNK] < first_new:
            continue  # rows of a cell ascend: its last is its newest
        chunk = cell_first[cell]
        left = cell_count[cell]
        while left > 0:
            here = min(left, CHUNK)
            for j in range(here):
                if chunk_point[chunk, j] >= first_new:
                    fresh[0, n] = chunk_xyz[chunk, 0, j]
                    fresh[1, n] = chunk_xyz[chunk, 1, j]
                    fresh[2, n] = chunk_xyz[chunk, 2, j]
                    n += 1
            left -= here
            chunk = chunk_next[chunk]
    return n


@njit(cache=True, nogil=True)
def _is_reached(points, row, fresh, n_fresh):
    """True when a new point lies within the radius of a point."""
    x, y, z = float(points[row].x), float(points[row].y), float(points[row].z)
    reach = math.floor((points[row].radius_mm / QUANTUM_MM) ** 2)
    reached = False
    for k in range(n_fresh):
        dx, dy, dz = fresh[0, k] - x, fresh[1, k] - y, fresh[2, k] - z
        reached |= dx * dx + dy * dy + dz * dz <= reach + 1.0
    return reached


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
    """Copy x, y, z and line of every point in the cells found, and pad."""
    n = 0
    for k in range(n_found):
        chunk = cell_first[found[k]]
        left = cell_count[found[k]]
        while left > 0:
            here = min(left, CHUNK)
            for j in range(CHUNK):  # a whole chunk at once: what is beyond its end is overwritten or padded
                buffer[0, n + j] = chunk_xyz[chunk, 0, j]
                buffer[1, n + j] = chunk_xyz[chunk, 1, j]
                buffer[2, n + j] = chunk_xyz[chunk, 2, j]
                buffer[3, n + j] = chunk_line[chunk, j]
            n += here
            left -= here
            chunk = chunk_next[chunk]
    for j in range(_VECTOR):
        buffer[0, n + j] = _FAR
        buffer[1, n + j], buffer[2, n + j], buffer[3, n + j] = 0.0, 0.0, 0.0


@njit(cache=True, nogil=True)
def _grow(points, row, wide, n_wide, base_mm, limit_mm, is_exact, rules):
    """The first step at which the grown radius makes the point reliable, with its answer; step 0 when none does."""
    step = 0
    radius_mm = base_mm
    answer = _answer(points, row, wide, 0, base_mm, is_exact, rules)
    while radius_mm < limit_mm:
        step += 1
        radius_mm = min(base_mm * GROWTH**step, limit_mm)
        answer = _answer(points, row, wide, n_wide, radius_mm, is_exact, rules)
        if answer[1] == 0:
            return step, answer
    return 0, answer


@njit(cache=True, nogil=True)
def _answer(points, row, local, n, radius_mm, is_exact, rules):
    """(Np, reason, nx, ny, nz, lambda2 mm2, lambda3 mm2, offset^2) of a point with this radius."""
    reach = math.floor((radius_mm / QUANTUM_MM) ** 2)
    px, py, pz, own = points[row].x, points[row].y, points[row].z, points[row].line
    if is_exact:
        sums = _sums(local, n, float(px), float(py), float(pz), float(own), float(reach))
        is_exact = sums[0] * reach < _EXACT
    if not is_exact:
        sums = _sums_of_integers(local, n, px, py, pz, own, reach)
    total, others, first, second, fx, fy, fz, sxx, sxy, sxz, syy, syz, szz = sums
    count = int(total)
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
    # `first` and `second` are the sums of (line - own line) and of its square over the points of other lines: these
    # are all of one line when the mean is a whole number and the spread is nothing.
    mean = first / max(others, 1.0)
    one_other = others > 0.0 and mean == math.floor(mean) and second == first * mean
    enough_lines = others > 0.0 and (not one_other or (others >= 2.0 and total - others >= 2.0))
    reason = 0
    if count < MIN_POINTS:
        reason = _TOO_FEW
    elif rules.needs_lines and not enough_lines:
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


@njit(cache=True, nogil=True, fastmath={"reassoc", "nsz", "nnan", "contract"})
def _sums(local, n, px, py, pz, own, reach):
    """Counts and moments of the candidates within reach, without a branch, for vector registers.

    Everything is a whole number below 2^53, so that float64 is exact in any order (and nothing is ever NaN).
    """
    count, others, first, second = 0.0, 0.0, 0.0, 0.0
    sx, sy, sz = 0.0, 0.0, 0.0
    sxx, sxy, sxz, syy, syz, szz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    padded = ((n + _VECTOR - 1) // _VECTOR) * _VECTOR
    for k in range(padded):
        x, y, z = local[0, k] - px, local[1, k] - py, local[2, k] - pz
        inside = 1.0 if x * x + y * y + z * z <= reach else 0.0
        x, y, z = x * inside, y * inside, z * inside
        line = (local[3, k] - own) * inside
        count += inside
        others += 1.0 if line != 0.0 else 0.0
        first += line
        second += line * line
        sx += x
        sy += y
        sz += z
        sxx += x * x
        sxy += x * y
        sxz += x * z
        syy += y * y
        syz += y * z
        szz += z * z
    return count, others, first, second, sx, sy, sz, sxx, sxy, sxz, syy, syz, szz


@njit(cache=True, nogil=True)
def _sums_of_integers(local, n, px, py, pz, own, reach):
    """The same as `_sums` for any radius and any number of lines, in 64-bit integers; the lines' sums are 0, 1 or 2."""
    count, others = np.int64(0), np.int64(0)
    other_line, several = np.int64(-1), False
    sx, sy, sz = np.int64(0), np.int64(0), np.int64(0)
    sxx, sxy, sxz = np.int64(0), np.int64(0), np.int64(0)
    syy, syz, szz = np.int64(0), np.int64(0), np.int64(0)
    for k in range(n):
        x, y, z = np.int64(local[0, k]) - px, np.int64(local[1, k]) - py, np.int64(local[2, k]) - pz
        if x * x + y * y + z * z <= reach:
            line = np.int64(local[3, k])
            count += 1
            if line != own:
                others += 1
                several = several or (other_line >= 0 and line != other_line)
                other_line = line
            sx += x
            sy += y
            sz += z
            sxx += x * x
            sxy += x * y
            sxz += x * z
            syy += y * y
            syz += y * z
            szz += z * z
    spread = 1.0 if several else 0.0
    return (
        float(count),
        float(others),
        float(others),
        float(others) + spread,
        float(sx),
        float(sy),
        float(sz),
        float(sxx),
        float(sxy),
        float(sxz),
        float(syy),
        float(syz),
        float(szz),
    )


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
        bit = pass_bit[np.int64(local[3, k])]
        if bit & ~bits:
            x, y, z = np.int64(local[0, k]) - px, np.int64(local[1, k]) - py, np.int64(local[2, k]) - pz
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
