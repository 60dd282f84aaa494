"""What a point's neighbourhood says: count, plane, sign and reliability, from exact integer sums.

Knows the grid and the per-point arrays it fills; decides nothing about radii, passes or who reads the result.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from scanner_service.analysis.grid import CHUNK, Grid, cell_near
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.plane import smallest_axis
from scanner_service.analysis.snapshot import Int32Array, UInt8Array, Unreliable

_TOO_FEW = int(Unreliable.TOO_FEW)
_SINGLE_LINE = int(Unreliable.SINGLE_LINE)
_ILL_DETERMINED = int(Unreliable.ILL_DETERMINED)

MIN_POINTS = 6
"""Fewest points, the point itself counted, from which a normal is believed."""

MAX_OPEN_PASSES = 7
LISTED = 128

MIN_GAP = 1e-3
"""A plane is determined where lambda2 - lambda3 >= MIN_GAP * lambda1 (the reach of the 1e-6 rad promise)."""


class Points(NamedTuple):
    """The map's arrays, one row a point: what came in, and what its neighbourhood said last.

    `line` is the row of the scanline. `open_passes` has a bit for every open pass that reaches the point and has not
    gone by; the point is settled when none is set. Its highest bit, LISTED, marks rows in the map's list of unsettled
    points and is not touched here.
    """

    xyz_q: Int32Array
    line: Int32Array
    place: Int32Array
    radius_mm: npt.NDArray[np.float64]
    radius_rule: UInt8Array
    neighbours: Int32Array
    normal: npt.NDArray[np.float32]
    unreliable: UInt8Array
    open_passes: UInt8Array
    offset: npt.NDArray[np.float32]
    residual_mm: npt.NDArray[np.float32]
    normal_error_rad: npt.NDArray[np.float32]


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


def reserve_points(max_points: int) -> Points:
    """Arrays with room for `max_points` points; pages come into being when they are first touched."""

    def column(dtype: npt.DTypeLike, *shape: int) -> Any:
        return np.empty((max_points, *shape), dtype=dtype)

    return Points(
        xyz_q=column(np.int32, 3),
        line=column(np.int32),
        place=column(np.int32),
        radius_mm=column(np.float64),
        radius_rule=column(np.uint8),
        neighbours=column(np.int32),
        normal=column(np.float32, 3),
        unreliable=column(np.uint8),
        open_passes=column(np.uint8),
        offset=column(np.float32),
        residual_mm=column(np.float32),
        normal_error_rad=column(np.float32),
    )


@njit(cache=True, nogil=True)
def evaluate_cells(
    cells: Int32Array,
    grid: Grid,
    points: Points,
    lines: Lines,
    needs_lines: bool,
    noise_mm: float,
    max_error_rad: float,
    clearance_q: float,
    changed: Int32Array,
) -> int:
    """Evaluate every point of the given cells; put the rows whose answer changed into `changed`, return how many.

    The sums are exact integers of offsets from the point itself, so the answer depends on the set of points alone.
    """
    side = grid.side_q[0]
    # Offsets of points in neighbouring cells are below 2 sides; their squares summed must fit the integer used.
    narrow = side < 13000
    near = np.empty(27, dtype=np.int64)
    capacity = 256
    local = np.empty((3, capacity), dtype=np.int32)
    local_line = np.empty(capacity, dtype=np.int32)
    n_changed = 0
    for cell in cells:
        total = 0
        n_near = 0
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    other = cell_near(grid, cell, dx, dy, dz)
                    if other >= 0:
                        near[n_near] = other
                        n_near += 1
                        total += grid.cell_count[other]
        if total > capacity:
            capacity = 2 * total
            local = np.empty((3, capacity), dtype=np.int32)
            local_line = np.empty(capacity, dtype=np.int32)
        n = 0
        for k in range(n_near):
            chunk = grid.cell_first[near[k]]
            left = grid.cell_count[near[k]]
            while left > 0:
                here = min(left, CHUNK)
                for j in range(here):
                    local[0, n] = grid.chunk_xyz[chunk, 0, j]
                    local[1, n] = grid.chunk_xyz[chunk, 1, j]
                    local[2, n] = grid.chunk_xyz[chunk, 2, j]
                    local_line[n] = points.line[grid.chunk_point[chunk, j]]
                    n += 1
                left -= here
                chunk = grid.chunk_next[chunk]
        chunk = grid.cell_first[cell]
        left = grid.cell_count[cell]
        while left > 0:
            here = min(left, CHUNK)
            for j in range(here):
                row = grid.chunk_point[chunk, j]
                if narrow:
                    moments = _moments_narrow(local, local_line, n, points, row)
                else:
                    moments = _moments_wide(local, local_line, n, points, row)
                is_new = _conclude(row, moments, points, lines, needs_lines, noise_mm, max_error_rad)
                reached = _passes_in_reach(row, points, lines, local, local_line, n, clearance_q)
                if reached != points.open_passes[row] & ~np.uint8(LISTED):
                    points.open_passes[row] = reached | (points.open_passes[row] & np.uint8(LISTED))
                    is_new = True
                if is_new:
                    changed[n_changed] = row
                    n_changed += 1
            left -= here
            chunk = grid.chunk_next[chunk]
    return n_changed


@njit(cache=True, nogil=True)
def _moments_narrow(local, local_line, n, points, row):
    """Counts and moments of the candidates within reach; offsets fit 16 bits, so that the loop runs in 32."""
    px, py, pz = points.xyz_q[row, 0], points.xyz_q[row, 1], points.xyz_q[row, 2]
    own = points.line[row]
    reach = np.int32(math.floor((points.radius_mm[row] / QUANTUM_MM) ** 2))
    count, own_count = np.int32(0), np.int32(0)
    low, high = np.int32(2147483647), np.int32(-1)
    sx, sy, sz = np.int32(0), np.int32(0), np.int32(0)
    sxx, sxy, sxz = np.int64(0), np.int64(0), np.int64(0)
    syy, syz, szz = np.int64(0), np.int64(0), np.int64(0)
    for k in range(n):
        x, y, z = np.int32(local[0, k] - px), np.int32(local[1, k] - py), np.int32(local[2, k] - pz)
        if np.int32(x * x + y * y + z * z) <= reach:
            line = local_line[k]
            count += np.int32(1)
            if line == own:
                own_count += np.int32(1)
            else:
                low = min(low, line)
                high = max(high, line)
            sx += x
            sy += y
            sz += z
            sxx += np.int32(x * x)
            sxy += np.int32(x * y)
            sxz += np.int32(x * z)
            syy += np.int32(y * y)
            syz += np.int32(y * z)
            szz += np.int32(z * z)
    return count, own_count, low, high, np.int64(sx), np.int64(sy), np.int64(sz), sxx, sxy, sxz, syy, syz, szz


@njit(cache=True, nogil=True)
def _moments_wide(local, local_line, n, points, row):
    """The same as `_moments_narrow` for any radius, in 64 bits."""
    px, py, pz = np.int64(points.xyz_q[row, 0]), np.int64(points.xyz_q[row, 1]), np.int64(points.xyz_q[row, 2])
    own = points.line[row]
    reach = np.int64(math.floor((points.radius_mm[row] / QUANTUM_MM) ** 2))
    count, own_count = np.int32(0), np.int32(0)
    low, high = np.int32(2147483647), np.int32(-1)
    sx, sy, sz = np.int64(0), np.int64(0), np.int64(0)
    sxx, sxy, sxz = np.int64(0), np.int64(0), np.int64(0)
    syy, syz, szz = np.int64(0), np.int64(0), np.int64(0)
    for k in range(n):
        x, y, z = local[0, k] - px, local[1, k] - py, local[2, k] - pz
        if x * x + y * y + z * z <= reach:
            line = local_line[k]
            count += np.int32(1)
            if line == own:
                own_count += np.int32(1)
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
def _conclude(row, moments, points, lines, needs_lines, noise_mm, max_error_rad):
    """Turn moments into the point's answer and store it; True when it differs from the one before."""
    count, own_count, low, high, sx, sy, sz, sxx, sxy, sxz, syy, syz, szz = moments
    total = float(count)
    # The central moments times Np are exact integers as long as they fit; beyond, float64 is still relative to 1e-16.
    nxx, nxy, nxz = total * sxx - float(sx) * sx, total * sxy - float(sx) * sy, total * sxz - float(sx) * sz
    nyy, nyz, nzz = total * syy - float(sy) * sy, total * syz - float(sy) * sz, total * szz - float(sz) * sz
    ax, ay, az, l1, l2, l3 = smallest_axis(nxx, nxy, nxz, nyy, nyz, nzz)
    to_mm2 = QUANTUM_MM * QUANTUM_MM / total
    l1, l2, l3 = l1 * to_mm2, l2 * to_mm2, l3 * to_mm2
    residual = math.sqrt(l3 / (total - 3.0)) if count > 3 else math.nan
    error = max(noise_mm, residual) / math.sqrt(l2) if count > 3 and l2 > 0.0 else math.nan
    offset = math.sqrt(float(sx) * sx + float(sy) * sy + float(sz) * sz) * QUANTUM_MM / (total * points.radius_mm[row])

    two_lines = low == high and own_count >= 2 and count - own_count >= 2
    three_lines = high > low
    reason = 0
    if count < MIN_POINTS:
        reason = _TOO_FEW
    elif needs_lines and not (two_lines or three_lines):
        reason = _SINGLE_LINE
    elif not error <= max_error_rad or l2 - l3 < MIN_GAP * l1:
        reason = _ILL_DETERMINED
    if reason:
        ax, ay, az = math.nan, math.nan, math.nan
    else:
        laser = lines.laser_q[points.line[row]]
        p = points.xyz_q[row]
        if ax * (laser[0] - p[0]) + ay * (laser[1] - p[1]) + az * (laser[2] - p[2]) < 0.0:  # Eq. 6.11
            ax, ay, az = -ax, -ay, -az

    fx, fy, fz = np.float32(ax), np.float32(ay), np.float32(az)
    same = (
        points.neighbours[row] == count
        and points.unreliable[row] == reason
        and (
            reason != 0 or (points.normal[row, 0] == fx and points.normal[row, 1] == fy and points.normal[row, 2] == fz)
        )
    )
    points.neighbours[row] = count
    points.unreliable[row] = reason
    points.normal[row, 0], points.normal[row, 1], points.normal[row, 2] = fx, fy, fz
    points.offset[row] = offset
    points.residual_mm[row] = residual
    points.normal_error_rad[row] = error
    return not same


@njit(cache=True, nogil=True)
def _not_gone_by(bits, p, lines, clearance_q):
    """Of the passes in `bits`, those whose laser plane is not yet more than the clearance beyond the point."""
    for slot in range(MAX_OPEN_PASSES):
        if bits & np.uint8(1 << slot):
            m = lines.heading[slot]
            if lines.front_q[slot] - (m[0] * p[0] + m[1] * p[1] + m[2] * p[2]) > clearance_q:
                bits &= ~np.uint8(1 << slot)
    return bits


@njit(cache=True, nogil=True)
def _passes_in_reach(row, points, lines, local, local_line, n, clearance_q):
    """The bits of all open passes that have a point within reach and have not gone by."""
    bits = lines.pass_bit[points.line[row]]
    p = points.xyz_q[row]
    reach = np.int64(math.floor((points.radius_mm[row] / QUANTUM_MM) ** 2))
    for k in range(n):
        bit = lines.pass_bit[local_line[k]]
        if bit & ~bits:
            x, y, z = np.int64(local[0, k]) - p[0], np.int64(local[1, k]) - p[1], np.int64(local[2, k]) - p[2]
            if x * x + y * y + z * z <= reach:
                bits |= bit
    return _not_gone_by(bits, p, lines, clearance_q)


@njit(cache=True, nogil=True)
def settle_listed(listed: Int32Array, points: Points, lines: Lines, clearance_q: float, settled: Int32Array) -> int:
    """Test the listed unsettled rows against where the passes are now.

    Rows that still wait are moved to the front of `listed`, the others go to `settled`; returns how many wait.
    """
    waiting = 0
    done = 0
    for row in listed:
        bits = _not_gone_by(points.open_passes[row] & ~np.uint8(LISTED), points.xyz_q[row], lines, clearance_q)
        if bits:
            points.open_passes[row] = bits | np.uint8(LISTED)
            listed[waiting] = row
            waiting += 1
        else:
            points.open_passes[row] = 0
            settled[done] = row
            done += 1
    return waiting


@njit(cache=True, nogil=True)
def list_unsettled(rows: Int32Array, points: Points, listed: Int32Array, used: int) -> int:
    """Append to `listed` the rows that wait for a pass and are not listed yet; returns the new length."""
    for row in rows:
        bits = points.open_passes[row]
        if bits and not bits & np.uint8(LISTED):
            points.open_passes[row] = bits | np.uint8(LISTED)
            listed[used] = row
            used += 1
    return used


@njit(cache=True, nogil=True)
def drop_pass(listed: Int32Array, points: Points, bit: int) -> None:
    """Forget a closed pass at every listed row."""
    for row in listed:
        points.open_passes[row] &= ~np.uint8(bit)
