"""The flexible scanner's radius: the distance to a point's 20th neighbour; knows no planes."""

import math

from numba import njit

from drivers.scanline import Float64Array
from scanner_service.analysis.gathering import Scratch, gather, rings_for
from scanner_service.analysis.grid import Grid, place_of
from scanner_service.analysis.intake import PER_MM, QUANTUM_MM
from scanner_service.analysis.kernel_rules import Rules
from scanner_service.analysis.points import PointArray
from scanner_service.analysis.radius import FLEXIBLE_POINTS
from scanner_service.analysis.snapshot import Int32Array

_REACHES = 1.0 + 1e-15
"""A distance that serves as a radius is this much longer, so that (r / q)^2 is never rounded to below it."""


@njit(cache=True, nogil=True, error_model="numpy")
def choose_flexible_radius(points, row, near, n, wide, n_wide, squares, side_q, rules):
    """Set the point's radius to the distance of its 20th point, between c and r_max; False while that cannot be told.

    It cannot when the cells next to the point's own, `near`, may not hold all points so near, and those as far as
    r_max were not fetched into `wide` (`n_wide` negative).
    """
    limit = math.floor((rules.max_radius_mm * PER_MM) ** 2)
    certain = float(side_q - 1) ** 2  # the cells around hold everything as near as one side
    found = _twentieth(points, row, near, n, squares)
    may_be_far = found > certain or rules.uncertainty_mm * PER_MM > side_q - 1
    if may_be_far and rings_for(rules.max_radius_mm, side_q) > 1:
        if n_wide < 0:
            return False
        found = _twentieth(points, row, wide, n_wide, squares)
    if found > limit:
        radius_mm = rules.max_radius_mm
    else:
        radius_mm = QUANTUM_MM * math.sqrt(found) * _REACHES
        radius_mm = min(max(radius_mm, rules.uncertainty_mm), rules.max_radius_mm)
    if points[row].radius_mm != radius_mm:
        points[row].radius_mm = radius_mm
        points[row].changed_at = 0  # so that the new answer counts as another one
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _twentieth(points, row, local, n, squares):
    """Squared distance of the FLEXIBLE_POINTS-th nearest candidate, the point itself counted; inf when fewer."""
    if n < FLEXIBLE_POINTS:
        return math.inf
    x, y, z = float(points[row].x), float(points[row].y), float(points[row].z)
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
def flexible_radii_mm(
    rows: Int32Array, grid: Grid, points: PointArray, rules: Rules, scratch: Scratch, radii: Float64Array
) -> None:
    """The flexible radius of each row, put into `radii` (m,); the points keep theirs."""
    wide, squares = scratch.wide, scratch.squares
    block, bits, cell, chunk_next, chunk = grid.block, grid.bits, grid.cell, grid.chunk_next, grid.chunk
    rings = rings_for(rules.max_radius_mm, grid.side_q[0])
    limit = math.floor((rules.max_radius_mm * PER_MM) ** 2)
    for i in range(len(rows)):
        row = rows[i]
        b, place = place_of(grid, points[row].x, points[row].y, points[row].z)
        radii[i] = rules.max_radius_mm
        if b < 0:
            continue
        n = gather(block, bits, cell, chunk_next, chunk, b, place, rings, wide)
        found = _twentieth(points, row, wide, n, squares)
        if found <= limit:
            radii[i] = max(QUANTUM_MM * math.sqrt(found) * _REACHES, rules.uncertainty_mm)
