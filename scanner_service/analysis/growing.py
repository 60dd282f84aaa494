"""Radii that grow where, and only where, the rule's radius leaves a point unreliable; decides nothing else."""

import math

import numpy as np
from numba import njit

from scanner_service.analysis.doubles import add_doubles
from scanner_service.analysis.gathering import gather, rings_for
from scanner_service.analysis.grid import FAR
from scanner_service.analysis.intake import PER_MM
from scanner_service.analysis.judging import reason_against
from scanner_service.analysis.kernel_rules import radius_limit_mm
from scanner_service.analysis.plane import fit_column
from scanner_service.analysis.points import GROWTH
from scanner_service.analysis.sums import put, sums_within

_STEPS = np.array([GROWTH**step for step in range(32)])


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def reach_mm(points, row, rules):
    """How far away something must stay for the answer to stand: the radius, after all growing that was tried."""
    base_mm = points[row].radius_mm
    if rules.is_flexible or (points[row].growth == 0 and points[row].unreliable == 0):
        return base_mm
    limit_mm = radius_limit_mm(base_mm, rules)
    if points[row].growth > 0:
        return min(base_mm * _STEPS[points[row].growth], limit_mm)
    return limit_mm


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def look_far(bits, b, place, rings):
    """Note that a point of a cell looks `rings` cells far."""
    for k in range(rings - 1):
        bits[b, FAR + k] |= np.uint64(1) << np.uint64(place)


@njit(cache=True, nogil=True, error_model="numpy")
def grow(
    block, bits, cell, chunk_next, chunk, more, has_doubles, side_q,
    points, row, b, place, own, is_exact, rules, sums, fits, i, kept, wide, n_wide, wide_rings,
):  # fmt: skip
    """Grow the radius to the first step that makes the point reliable, leaving its sums and fit in column i.

    Returns the step (0 when none does, and the column is as it was), the radius, and how many points, of how many
    rings, the buffer `wide` holds now; it is filled again only when more rings are needed.
    """
    base_mm = points[row].radius_mm
    limit_mm = radius_limit_mm(base_mm, rules)
    for k in range(13):
        kept[k] = sums[k, i]
    for k in range(8):
        kept[13 + k] = fits[k, i]
    step = 0
    radius_mm = base_mm
    while radius_mm < limit_mm:
        step += 1
        radius_mm = min(base_mm * _STEPS[step], limit_mm)
        rings = rings_for(radius_mm, side_q)
        if rings > wide_rings:
            n_wide = gather(block, bits, cell, chunk_next, chunk, b, place, rings, wide)
            wide_rings = rings
        reach = math.floor((radius_mm * PER_MM) ** 2)
        put(sums, i, sums_within(points, row, own, wide, n_wide, reach, is_exact))
        if has_doubles:
            add_doubles(
                block, bits, cell, chunk_next, chunk, more, b, place, rings, points, row, own, reach, is_exact, sums, i
            )
        fit_column(sums, fits, i)
        if reason_against(sums, fits, i, rules) == 0:
            return step, radius_mm, n_wide, wide_rings
    for k in range(13):
        sums[k, i] = kept[k]
    for k in range(8):
        fits[k, i] = kept[13 + k]
    return 0, base_mm, n_wide, wide_rings
