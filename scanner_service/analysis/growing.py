"""Radii that grow where, and only where, the rule's radius leaves a point unreliable; decides nothing else."""

import math

import numpy as np
from numba import njit

from scanner_service.analysis.gathering import gather_from, rings_for
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.judging import reason_against
from scanner_service.analysis.kernel_rules import radius_limit_mm
from scanner_service.analysis.plane import fit_column
from scanner_service.analysis.points import GROWTH
from scanner_service.analysis.sums import put, sums_within

_STEPS = np.array([GROWTH**step for step in range(32)])


@njit(cache=True, nogil=True, error_model="numpy")
def reach_mm(points, row, rules):
    """How far away something must stay for the point's answer to stand: its radius, after all growing that was tried."""
    base_mm = points[row].radius_mm
    if rules.is_flexible or (points[row].growth == 0 and points[row].unreliable == 0):
        return base_mm
    limit_mm = radius_limit_mm(base_mm, rules)
    if points[row].growth > 0:
        return min(base_mm * _STEPS[points[row].growth], limit_mm)
    return limit_mm


@njit(cache=True, nogil=True, error_model="numpy")
def look_far(block_far, block, place, rings):
    """Note that a point of a cell looks `rings` cells far."""
    for k in range(rings - 1):
        block_far[block, k] |= np.uint64(1) << np.uint64(place)


@njit(cache=True, nogil=True, error_model="numpy")
def grow(grid, points, row, block, place, own, is_exact, rules, sums, fits, i, wide, n_wide, wide_rings):
    """Grow the radius to the first step that makes the point reliable, leaving its sums and fit in column i.

    Returns the step (0 when none does, and the column is as it was), the radius, and the buffer of the cells around
    with its count and rings, which is fetched again only when more rings are needed (`wide_rings` 0: nothing in it).
    """
    base_mm = points[row].radius_mm
    limit_mm = radius_limit_mm(base_mm, rules)
    kept_sums, kept_fits = sums[:, i].copy(), fits[:, i].copy()
    step = 0
    radius_mm = base_mm
    while radius_mm < limit_mm:
        step += 1
        radius_mm = min(base_mm * _STEPS[step], limit_mm)
        rings = rings_for(radius_mm, grid.side_q[0])
        if rings > wide_rings:
            wide, n_wide = gather_from(grid, block, place, rings, wide)
            wide_rings = rings
        reach = math.floor((radius_mm / QUANTUM_MM) ** 2)
        put(sums, i, sums_within(points, row, own, wide, n_wide, reach, is_exact))
        fit_column(sums, fits, i)
        if reason_against(sums, fits, i, rules) == 0:
            return step, radius_mm, wide, n_wide, wide_rings
    sums[:, i] = kept_sums
    fits[:, i] = kept_fits
    return 0, base_mm, wide, n_wide, wide_rings
