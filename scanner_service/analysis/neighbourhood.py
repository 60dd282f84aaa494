"""What a point's neighbourhood says: count, plane, sign and reliability, from exact integer sums.

Knows the grid and the point records it fills; decides nothing about which radius a scanline gets, or who reads.
"""

import math

import numpy as np
from numba import njit

from scanner_service.analysis.flexible import choose_flexible_radius
from scanner_service.analysis.gathering import VECTOR, cells_around, gather, gather_fresh, gather_wide, is_reached
from scanner_service.analysis.grid import CHUNK, Grid
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.kernel_rules import Lines, Rules, radius_limit_mm
from scanner_service.analysis.plane import fit_planes, smallest_axis
from scanner_service.analysis.points import GROWTH, LISTED, PointArray
from scanner_service.analysis.settling import not_gone_by, passes_in_reach
from scanner_service.analysis.snapshot import Int32Array, Unreliable
from scanner_service.analysis.sums import EXACT_LINES, EXACT_SIDE_Q, put, sums_within

_TOO_FEW = int(Unreliable.TOO_FEW)
_SINGLE_LINE = int(Unreliable.SINGLE_LINE)
_ILL_DETERMINED = int(Unreliable.ILL_DETERMINED)

MIN_POINTS = 6
"""Fewest points, the point itself counted, from which a normal is believed."""

MIN_GAP = 1e-3
"""A plane is determined where lambda2 - lambda3 >= MIN_GAP * lambda1 (the reach of the 1e-6 rad promise)."""

_BATCH = 64
"""So many points are fitted at once."""


@njit(cache=True, nogil=True, error_model="numpy")
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
    block_key, block_near, block_cell, cell_needy = grid.block_key, grid.block_near, grid.block_cell, grid.cell_needy
    chunk_next, chunk_xyz, chunk_line, chunk_point = grid.chunk_next, grid.chunk_xyz, grid.chunk_line, grid.chunk_point
    pass_bit, open_bits = lines.pass_bit, np.uint8(lines.open_bits[0])
    is_exact = grid.side_q[0] < EXACT_SIDE_Q and len(pass_bit) < EXACT_LINES
    found = np.empty(27, dtype=np.int64)
    fresh = np.empty((3, 512))
    near = np.empty((4, 512))
    rows = np.empty(_BATCH, dtype=np.int64)
    row_cells = np.empty(_BATCH, dtype=np.int64)
    row_lines = np.empty(_BATCH, dtype=np.int64)
    row_passes = np.empty(_BATCH, dtype=np.uint8)
    wide = np.empty((4, 1))
    distances = np.empty(512)
    sums = np.empty((13, _BATCH))
    fits = np.empty((8, _BATCH))
    n_batch = 0
    n_changed = 0
    for i in range(len(cells)):
        cell = np.int64(cells[i])
        n_found, n = cells_around(cell_at, cell_block, cell_count, block_key, block_near, block_cell, cell, 1, found)
        if n + VECTOR > near.shape[1]:
            near = np.empty((4, 2 * n + VECTOR))
            fresh = np.empty((3, 2 * n + VECTOR))
        was_needy = cell_needy[cell] != 0
        n_fresh = np.int64(0)
        if was_needy:
            cell_needy[cell] = 0
        elif chunk_point[cell_first[cell], 0] < first_new:  # rows of a cell ascend: its first is its oldest
            n_fresh = gather_fresh(
                chunk_next, chunk_xyz, chunk_point, cell_first, cell_last, cell_count, found, n_found, first_new, fresh
            )
        is_gathered = False
        n_wide = np.int64(-1)
        chunk = cell_first[cell]
        left = cell_count[cell]
        while left > 0:
            here = min(left, CHUNK)
            for j in range(here):
                row = np.int64(chunk_point[chunk, j])
                if row < first_new and not was_needy and not is_reached(points, row, fresh, n_fresh):
                    continue
                if not is_gathered:
                    gather(chunk_next, chunk_xyz, chunk_line, cell_first, cell_count, found, n_found, near)
                    is_gathered = True
                own = np.int64(chunk_line[chunk, j])
                local, n_local = near, n
                if rules.is_flexible:
                    local, n_local, wide, n_wide = choose_flexible_radius(
                        grid, points, row, cell, near, n, wide, n_wide, distances, rules
                    )
                    if n_local + VECTOR > len(distances):
                        distances = np.empty(2 * n_local + VECTOR)
                reach = math.floor((points[row].radius_mm / QUANTUM_MM) ** 2)
                put(sums, n_batch, sums_within(points, row, own, local, n_local, reach, is_exact))
                passes = pass_bit[own]
                if open_bits & ~passes:
                    passes = passes_in_reach(points, row, passes, local, n_local, reach, pass_bit)
                rows[n_batch], row_cells[n_batch], row_passes[n_batch] = row, cell, passes
                row_lines[n_batch] = own
                n_batch += 1
                if n_batch == _BATCH:
                    n_changed = _conclude(
                        rows, row_cells, row_lines, row_passes, sums, fits, n_batch,
                        grid, points, lines, rules, version, is_exact, changed, n_changed,
                    )  # fmt: skip
                    n_batch = 0
            left -= here
            chunk = chunk_next[chunk]
    return _conclude(
        rows, row_cells, row_lines, row_passes, sums, fits, n_batch,
        grid, points, lines, rules, version, is_exact, changed, n_changed,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _conclude(
    rows,
    row_cells,
    row_lines,
    row_passes,
    sums,
    fits,
    n,
    grid,
    points,
    lines,
    rules,
    version,
    is_exact,
    changed,
    n_changed,
):
    """Fit a batch of points, let radii grow where that is needed, store the answers; the new number of changed rows."""
    laser_q, pass_bit, heading, front_q = lines.laser_q, lines.pass_bit, lines.heading, lines.front_q
    block_needy, cell_block, cell_needy = grid.block_needy, grid.cell_block, grid.cell_needy
    wide = np.empty((4, 1))
    wide_cell, wide_mm, n_wide = np.int64(-1), 0.0, np.int64(0)
    fit_planes(sums, n, fits)
    for i in range(n):
        row, cell, own = rows[i], row_cells[i], row_lines[i]
        base_mm = points[row].radius_mm
        passes = row_passes[i]
        if fits[6, i] == 0.0:
            _fit_one(sums, fits, i)
        reason = _reason_against(sums, fits, i, rules)
        step = 0
        radius_mm = base_mm
        limit_mm = radius_limit_mm(base_mm, rules)
        if reason != 0 and limit_mm > base_mm and not rules.is_flexible:
            cell_needy[cell] = 1
            block_needy[cell_block[cell]] = 1
            if wide_cell != cell or limit_mm > wide_mm:
                wide, n_wide = gather_wide(grid, cell, limit_mm, wide)
                wide_cell, wide_mm = cell, limit_mm
            step = _grow(points, row, own, wide, n_wide, base_mm, limit_mm, is_exact, rules, sums, fits, i)
            if step > 0:
                reason = 0
                radius_mm = min(base_mm * GROWTH**step, limit_mm)
                reach = math.floor((radius_mm / QUANTUM_MM) ** 2)
                passes = passes_in_reach(points, row, passes, wide, n_wide, reach, pass_bit)
        other_side = 0
        if reason == 0:
            _turn_to_laser(points, row, own, laser_q, fits, i)
            if _lasers_on_both_sides(points, row, fits, i, radius_mm, lines.laser_box_q):
                if wide_cell != cell or radius_mm > wide_mm:
                    wide, n_wide = gather_wide(grid, cell, radius_mm, wide)
                    wide_cell, wide_mm = cell, radius_mm
                other_side = _count_other_side(points, row, wide, n_wide, radius_mm, laser_q, fits, i)
        passes = not_gone_by(passes, points, row, heading, front_q, rules)
        if _store(points, row, sums, fits, i, reason, radius_mm, step, passes, other_side, version):
            changed[n_changed] = row
            n_changed += 1
    return n_changed


@njit(cache=True, nogil=True, error_model="numpy")
def _turn_to_laser(points, row, own, laser_q, fits, i):
    """Eq. 6.11: the axis is flipped when it points away from the laser of the point's own scanline."""
    x, y, z = laser_q[own, 0] - points[row].x, laser_q[own, 1] - points[row].y, laser_q[own, 2] - points[row].z
    if fits[0, i] * x + fits[1, i] * y + fits[2, i] * z < 0.0:
        fits[0, i], fits[1, i], fits[2, i] = -fits[0, i], -fits[1, i], -fits[2, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _lasers_on_both_sides(points, row, fits, i, radius_mm, laser_box_q):
    """False when every laser of the map stands so high above the point's plane that no neighbour is seen from below."""
    lowest = -radius_mm / QUANTUM_MM
    for axis in range(3):
        n = fits[axis, i]
        lowest += n * (laser_box_q[0, axis] if n > 0.0 else laser_box_q[1, axis])
    x, y, z = points[row].x, points[row].y, points[row].z
    return lowest <= fits[0, i] * x + fits[1, i] * y + fits[2, i] * z


@njit(cache=True, nogil=True, error_model="numpy")
def _count_other_side(points, row, local, n, radius_mm, laser_q, fits, i):
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


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_one(sums, fits, i):
    """Fit the plane of one column by the solver that always arrives."""
    per = 1.0 / max(sums[0, i], 1.0)
    x, y, z = sums[4, i], sums[5, i], sums[6, i]
    fits[0, i], fits[1, i], fits[2, i], fits[3, i], fits[4, i], fits[5, i] = smallest_axis(
        sums[7, i] - x * x * per,
        sums[8, i] - x * y * per,
        sums[9, i] - x * z * per,
        sums[10, i] - y * y * per,
        sums[11, i] - y * z * per,
        sums[12, i] - z * z * per,
    )
    fits[7, i] = (x * x + y * y + z * z) * per * per


@njit(cache=True, nogil=True, error_model="numpy")
def _reason_against(sums, fits, i, rules):
    """Why the normal of a column is not to be believed, 0 when it is."""
    total, others, first, second = sums[0, i], sums[1, i], sums[2, i], sums[3, i]
    if total < MIN_POINTS:
        return _TOO_FEW
    # `first` and `second` are the sums of (line - own line) and of its square over the points of other lines: these
    # are all of one line when the mean is a whole number and the spread is nothing.
    mean = first / max(others, 1.0)
    one_other = others > 0.0 and mean == math.floor(mean) and second == first * mean
    enough_lines = others > 0.0 and (not one_other or (others >= 2.0 and total - others >= 2.0))
    if rules.needs_lines and not enough_lines:
        return _SINGLE_LINE
    # sigma / sqrt(lambda2) <= limit, sigma the larger of the scanner's noise and the residual, all squared
    to_mm2 = QUANTUM_MM * QUANTUM_MM
    sigma_sq = max(rules.noise_mm * rules.noise_mm, fits[5, i] * to_mm2 / (total - 3.0))
    limit_sq = rules.max_error_rad * rules.max_error_rad
    if not sigma_sq <= limit_sq * fits[4, i] * to_mm2 or fits[4, i] - fits[5, i] < MIN_GAP * fits[3, i]:
        return _ILL_DETERMINED
    return 0


@njit(cache=True, nogil=True, error_model="numpy")
def _grow(points, row, own, wide, n_wide, base_mm, limit_mm, is_exact, rules, sums, fits, i):
    """Grow the radius to the first step that makes the point reliable, leaving its sums and fit in column i.

    Returns the step; 0 when none does, and the column is as it was.
    """
    kept_sums, kept_fits = sums[:, i].copy(), fits[:, i].copy()
    step = 0
    radius_mm = base_mm
    while radius_mm < limit_mm:
        step += 1
        radius_mm = min(base_mm * GROWTH**step, limit_mm)
        reach = math.floor((radius_mm / QUANTUM_MM) ** 2)
        put(sums, i, sums_within(points, row, own, wide, n_wide, reach, is_exact))
        _fit_one(sums, fits, i)
        if _reason_against(sums, fits, i, rules) == 0:
            return step
    sums[:, i] = kept_sums
    fits[:, i] = kept_fits
    return 0


@njit(cache=True, nogil=True, error_model="numpy")
def _store(points, row, sums, fits, i, reason, radius_mm, step, passes, other_side, version):
    """Write an answer into the point's record; True when it differs from the one before."""
    count = np.int32(sums[0, i])
    ax, ay, az = fits[0, i], fits[1, i], fits[2, i]
    if reason:
        ax, ay, az = math.nan, math.nan, math.nan
    nx, ny, nz = np.float32(ax), np.float32(ay), np.float32(az)
    listed = points[row].open_passes & np.uint8(LISTED)
    same = (
        points[row].changed_at > 0
        and points[row].neighbours == count
        and points[row].unreliable == reason
        and points[row].growth == step
        and points[row].other_side == other_side
        and points[row].open_passes == passes | listed
        and (reason != 0 or (points[row].nx == nx and points[row].ny == ny and points[row].nz == nz))
    )
    if same:
        return False
    to_mm2 = QUANTUM_MM * QUANTUM_MM
    points[row].neighbours = count
    points[row].unreliable = reason
    points[row].growth = step
    points[row].other_side = other_side
    points[row].open_passes = passes | listed
    points[row].nx, points[row].ny, points[row].nz = nx, ny, nz
    points[row].middle_mm2 = fits[4, i] * to_mm2
    points[row].smallest_mm2 = fits[5, i] * to_mm2
    points[row].offset_sq = fits[7, i] * to_mm2 / (radius_mm * radius_mm)
    points[row].changed_at = version
    return True
