"""Quantising a scanline: every point is kept or counted under one reason, whatever its coordinates are."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drivers.scanline import Scanline
from scanner_service.analysis.intake import QUANTUM_MM, quantise

NUMBERS = st.sampled_from([0.0, 1.5, -2.25, math.nan, math.inf, -math.inf, 1e9, -1e9])
POINTS = st.lists(st.tuples(st.tuples(NUMBERS, NUMBERS, NUMBERS), st.booleans()), max_size=12)


def scanline(points, missing):
    along_y, laser_mm = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 100.0])
    points_mm, flags = np.array(points).reshape(-1, 3), np.array(missing, dtype=np.bool_)
    return Scanline("d", 1, 1, 0, 0.0, points_mm, flags, laser_mm, along_y, along_y, 0.0, 0.2, 0.2)


def reason_for(point, is_missing):
    """Said point by point, with the mathematics of a single number."""
    if is_missing:
        return "missing"
    if all(map(math.isnan, point)):
        return "dropout"
    if not all(map(math.isfinite, point)):
        return "not_finite"
    return "out_of_bounds" if max(map(abs, point)) / QUANTUM_MM > 2**31 else None


@given(POINTS)
def test_every_point_is_kept_or_counted_under_one_reason(drawn):
    points, missing = [point for point, _ in drawn], [is_missing for _, is_missing in drawn]
    stored = quantise(scanline(points, missing), np.zeros(3))
    reasons = [reason_for(*one) for one in drawn]
    assert stored.index.tolist() == [at for at, reason in enumerate(reasons) if reason is None]
    assert stored.dropped == {name: reasons.count(name) for name in set(reasons) - {None}}
    kept = np.array([point for point, reason in zip(points, reasons, strict=True) if reason is None]).reshape(-1, 3)
    np.testing.assert_array_equal(stored.xyz_q, np.rint(kept / QUANTUM_MM))
