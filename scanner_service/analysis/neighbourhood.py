"""What a point's neighbourhood says: count, plane, sign and reliability, from exact integer sums.

Knows the grid and the point records it fills; decides nothing about which radius a scanline gets, or who reads.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from scanner_service.analysis.grid import CHUNK, Grid, cell_near, cell_of
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.plane import fit_planes, smallest_axis
from scanner_service.analysis.points import GROWTH, GROWTH_REACH, LISTED, MAX_OPEN_PASSES, PointArray
from scanner_service.analysis.radius import FLEXIBLE_POINTS
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

_BATCH = 64
"""So many points are fitted at once."""


class Rules(NamedTuple):
    """What makes a normal believed, and how far a radius may grow; the same for the whole map.

    With `is_flexible` each point's radius is the distance to its 20th point, between `uncertainty_mm` and
    `max_radius_mm`; otherwise the scanline's rule gave it, and it grows where that is needed.
    """

    needs_lines: bool
    noise_mm: float
    max_error_rad: float
    max_radius_mm: float
    is_flexible: bool
    uncertainty_mm: float


class Lines(NamedTuple):
    """What the kernel reads of scanlines and passes.

    `laser_q` (L, 3) laser positions in quanta from the origin; `pass_bit` (L,) the bit of the line's pass while that
    is open, else 0; `open_bits` (1,) all of these together. For each of the MAX_OPEN_PASSES: `heading` (., 3) the unit
    normal of its laser planes in the direction of travel, NaN when unknown or not steady, and `front_q` (.,) how far
    along it the latest plane lies. `laser_box_q` (2, 3) are the lowest and highest laser coordinates of all lines.
    """

    laser_q: npt.NDArray[np.float64]
    pass_bit: UInt8Array
    open_bits: UInt8Array
    heading: npt.NDArray[np.float64]
    front_q: npt.NDArray[np.float64]
    laser_box_q: npt.NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy")
def _radius_limit_mm(base_mm, rules):
    """r_max of a point whose rule gave `base_mm`."""
    if rules.is_flexible:
        return rules.max_radius_mm
    return max(base_mm, min(rules.max_radius_mm, GROWTH_REACH * base_mm))


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
    is_exact = grid.side_q[0] < _EXACT_SIDE_Q and len(pass_bit) < _EXACT_LINES
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
        n_found, n = _cells_around(cell_at, cell_block, cell_count, block_key, block_near, block_cell, cell, 1, found)
        if n + _VECTOR > near.shape[1]:
            near = np.empty((4, 2 * n + _VECTOR))
            fresh = np.empty((3, 2 * n + _VECTOR))
        was_needy = cell_needy[cell] != 0
        n_fresh = np.int64(0)
        if was_needy:
            cell_needy[cell] = 0
        elif chunk_point[cell_first[cell], 0] < first_new:  # rows of a cell ascend: its first is its oldest
            n_fresh = _gather_fresh(
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
                if row < first_new and not was_needy and not _is_reached(points, row, fresh, n_fresh):
                    continue
                if not is_gathered:
                    _gather(chunk_next, chunk_xyz, chunk_line, cell_first, cell_count, found, n_found, near)
                    is_gathered = True
                own = np.int64(chunk_line[chunk, j])
                local, n_local = near, n
                if rules.is_flexible:
                    local, n_local, wide, n_wide = _choose_flexible_radius(
                        grid, points, row, cell, near, n, wide, n_wide, distances, rules
                    )
                    if n_local + _VECTOR > len(distances):
                        distances = np.empty(2 * n_local + _VECTOR)
                reach = math.floor((points[row].radius_mm / QUANTUM_MM) ** 2)
                _put(sums, n_batch, _sums_within(points, row, own, local, n_local, reach, is_exact))
                passes = pass_bit[own]
                if open_bits & ~passes:
                    passes = _passes_in_reach(points, row, passes, local, n_local, reach, pass_bit)
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
def _put(sums, column, values):
    """Write the thirteen sums of a point into a column."""
    for i in range(13):
        sums[i, column] = values[i]


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
        limit_mm = _radius_limit_mm(base_mm, rules)
        if reason != 0 and limit_mm > base_mm and not rules.is_flexible:
            cell_needy[cell] = 1
            block_needy[cell_block[cell]] = 1
            if wide_cell != cell or limit_mm > wide_mm:
                wide, n_wide = _gather_wide(grid, cell, limit_mm, wide)
                wide_cell, wide_mm = cell, limit_mm
            step = _grow(points, row, own, wide, n_wide, base_mm, limit_mm, is_exact, rules, sums, fits, i)
            if step > 0:
                reason = 0
                radius_mm = min(base_mm * GROWTH**step, limit_mm)
                reach = math.floor((radius_mm / QUANTUM_MM) ** 2)
                passes = _passes_in_reach(points, row, passes, wide, n_wide, reach, pass_bit)
        other_side = 0
        if reason == 0:
            _turn_to_laser(points, row, own, laser_q, fits, i)
            if _lasers_on_both_sides(points, row, fits, i, radius_mm, lines.laser_box_q):
                if wide_cell != cell or radius_mm > wide_mm:
                    wide, n_wide = _gather_wide(grid, cell, radius_mm, wide)
                    wide_cell, wide_mm = cell, radius_mm
                other_side = _count_other_side(points, row, wide, n_wide, radius_mm, laser_q, fits, i)
        passes = _not_gone_by(passes, points, row, heading, front_q, rules)
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
def _choose_flexible_radius(grid, points, row, cell, near, n, wide, n_wide, distances, rules):
    """Set the point's radius to the distance of its 20th point, between c and r_max.

    Returns the buffer whose points cover that radius and how many they are, and the wide buffer with its count, which
    is gathered at most once a cell. A point that looks beyond the neighbouring cells makes its cell needy.
    """
    limit = math.floor((rules.max_radius_mm / QUANTUM_MM) ** 2)
    certain = float(grid.side_q[0]) ** 2  # the cells around hold everything as near as one side
    found = _twentieth(points, row, near, n, distances)
    local, n_local = near, n
    if found > certain and rules.max_radius_mm > grid.side_q[0] * QUANTUM_MM:
        if n_wide < 0:
            wide, n_wide = _gather_wide(grid, cell, rules.max_radius_mm, wide)
        found = _twentieth(points, row, wide, n_wide, distances)
        local, n_local = wide, n_wide
        grid.cell_needy[cell] = 1
        grid.block_needy[grid.cell_block[cell]] = 1
    if found > limit:
        radius_mm = rules.max_radius_mm
    else:
        radius_mm = QUANTUM_MM * math.sqrt(found)
        while math.floor((radius_mm / QUANTUM_MM) ** 2) < found:  # the root was rounded down
            radius_mm *= 1.0 + 2.3e-16
        radius_mm = min(max(radius_mm, rules.uncertainty_mm), rules.max_radius_mm)
    if points[row].radius_mm != radius_mm:
        points[row].radius_mm = radius_mm
        points[row].changed_at = 0  # so that the new answer counts as another one
    return local, n_local, wide, n_wide


@njit(cache=True, nogil=True, error_model="numpy")
def _twentieth(points, row, local, n, distances):
    """Squared distance of the FLEXIBLE_POINTS-th nearest candidate, the point itself counted; inf when fewer."""
    if n < FLEXIBLE_POINTS:
        return math.inf
    x, y, z = float(points[row].x), float(points[row].y), float(points[row].z)
    squares = distances if n <= len(distances) else np.empty(n)
    highest = 0.0
    for k in range(n):
        dx, dy, dz = local[0, k] - x, local[1, k] - y, local[2, k] - z
        squares[k] = dx * dx + dy * dy + dz * dz
        highest = max(highest, squares[k])
    # Narrow an interval until it holds the answer alone; counting runs in vector registers, sorting would not. On a
    # surface the count grows with the square of the distance, so interpolation nearly hits it; every other step halves.
    low, high = -1.0, highest  # count(<= low) < 20 <= count(<= high)
    count_low, count_high = 0.0, float(n)
    halve = False
    while high - low > 1.0:
        share = 0.5 if halve else (FLEXIBLE_POINTS - 0.5 - count_low) / (count_high - count_low)
        middle = min(max(math.floor(low + share * (high - low)), low + 1.0), high - 1.0)
        count, below = _count_up_to(squares, n, middle)
        if count == FLEXIBLE_POINTS:
            return below
        if count < FLEXIBLE_POINTS:
            low, count_low = middle, count
        else:
            high, count_high = middle, count
        halve = not halve
    return high  # several points are equally far


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "nsz", "nnan"})
def _count_up_to(squares, n, limit):
    """How many of the first n values are at most `limit`; when that is FLEXIBLE_POINTS, also the largest of these."""
    count = 0.0
    for k in range(n):
        count += 1.0 if squares[k] <= limit else 0.0
    largest = -1.0
    if count == FLEXIBLE_POINTS:
        for k in range(n):
            value = squares[k] if squares[k] <= limit else -1.0
            largest = max(largest, value)
    return count, largest


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
def _gather_wide(grid, cell, limit_mm, wide):
    """All points as far as a radius may grow: the buffer, a larger one if need be, and how many it holds."""
    rings = min(4, math.ceil(limit_mm / (grid.side_q[0] * QUANTUM_MM)))
    found = np.empty(729, dtype=np.int64)
    n_found, n = _cells_around(
        grid.cell_at, grid.cell_block, grid.cell_count, grid.block_key, grid.block_near, grid.block_cell,
        cell, rings, found,
    )  # fmt: skip
    if n + _VECTOR > wide.shape[1]:
        wide = np.empty((4, 2 * n + _VECTOR))
    _gather(grid.chunk_next, grid.chunk_xyz, grid.chunk_line, grid.cell_first, grid.cell_count, found, n_found, wide)
    return wide, n


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _is_reached(points, row, fresh, n_fresh):
    """True when a new point lies within the radius of a point."""
    x, y, z = float(points[row].x), float(points[row].y), float(points[row].z)
    reach = math.floor((points[row].radius_mm / QUANTUM_MM) ** 2)
    reached = False
    for k in range(n_fresh):
        dx, dy, dz = fresh[0, k] - x, fresh[1, k] - y, fresh[2, k] - z
        reached |= dx * dx + dy * dy + dz * dz <= reach + 1.0
    return reached


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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
        _put(sums, i, _sums_within(points, row, own, wide, n_wide, reach, is_exact))
        _fit_one(sums, fits, i)
        if _reason_against(sums, fits, i, rules) == 0:
            return step
    sums[:, i] = kept_sums
    fits[:, i] = kept_fits
    return 0


@njit(cache=True, nogil=True, error_model="numpy")
def _sums_within(points, row, own, local, n, reach, is_exact):
    """The sums of `_sums`, exact for any radius."""
    px, py, pz = points[row].x, points[row].y, points[row].z
    if is_exact:
        sums = _sums(local, n, float(px), float(py), float(pz), float(own), float(reach))
        if sums[0] * reach < _EXACT:
            return sums
    return _sums_of_integers(local, n, px, py, pz, own, reach)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "nsz", "nnan", "contract"})
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


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def _not_gone_by(bits, points, row, heading, front_q, rules):
    """Of the passes in `bits`, those whose laser plane is not yet more than the point's r_max beyond it."""
    if bits == 0:
        return bits
    x, y, z = points[row].x, points[row].y, points[row].z
    clearance_q = _radius_limit_mm(points[row].radius_mm, rules) / QUANTUM_MM
    for slot in range(MAX_OPEN_PASSES):
        if bits & np.uint8(1 << slot):
            along = heading[slot, 0] * x + heading[slot, 1] * y + heading[slot, 2] * z
            if front_q[slot] - along > clearance_q:
                bits &= ~np.uint8(1 << slot)
    return bits


@njit(cache=True, nogil=True, error_model="numpy")
def _passes_in_reach(points, row, bits, local, n, reach, pass_bit):
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
        bits = _not_gone_by(points[row].open_passes & ~np.uint8(LISTED), points, row, heading, front_q, rules)
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


@njit(cache=True, nogil=True, error_model="numpy")
def flexible_radii_mm(rows: Int32Array, grid: Grid, points: PointArray, rules: Rules, radii: npt.NDArray[np.float64]):
    """The flexible radius of each row, put into `radii` (m,); the points keep theirs."""
    wide = np.empty((4, 512))
    distances = np.empty(512)
    side = grid.side_q[0]
    limit = math.floor((rules.max_radius_mm / QUANTUM_MM) ** 2)
    for i in range(len(rows)):
        row = rows[i]
        cell = cell_of(grid, points[row].x // side, points[row].y // side, points[row].z // side)
        radii[i] = rules.max_radius_mm
        if cell < 0:
            continue
        wide, n = _gather_wide(grid, cell, rules.max_radius_mm, wide)
        found = _twentieth(points, row, wide, n, distances)
        if found <= limit:
            radii[i] = max(QUANTUM_MM * math.sqrt(found), rules.uncertainty_mm)
