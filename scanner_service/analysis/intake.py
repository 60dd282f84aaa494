"""The stored truth: a scanline's coordinates, quantised once; knows no map, no database and no clock.

Coordinates become int32 multiples of `QUANTUM_MM` = 2**-13 mm from the session's origin. What leaves here is what
is stored, analysed, exported and replayed, so every floor above computes from the same integers.
"""

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numba import njit

from drivers.scanline import Float64Array, Scanline, read_only

QUANTUM_MM = 2.0**-13
PER_MM = 2.0**13
"""Quanta in a millimetre."""

LINE_SPACING_RANGE_MM = (1e-4, 1e3)
"""Scanlines closer or farther apart than this are a mistake in the unit, not a scan."""

LASER_RANGE_MM = 1e7
_LIMIT_Q = 2**31 - 1


@dataclass(frozen=True, slots=True)
class StoredLine:
    """One scanline as it is stored: integer coordinates and everything needed to analyse it again.

    `xyz_q` (k, 3) int32 are multiples of QUANTUM_MM from the session's origin, in the order of the line;
    `index` (k,) int32 is each point's place in the line of `point_count` places. Places without a point are
    counted by reason in `dropped`: `dropout` (no return), `missing` (its chunk never arrived), `not_finite`
    (half a coordinate, or infinite), `out_of_bounds` (beyond +-262 m of the origin); so
    `point_count == len(index) + sum(dropped.values())`. The vectors are (3,) float64 in the part frame.
    """

    device_id: str
    boot_id: int
    pass_index: int
    line_index: int
    device_time_s: float
    xyz_q: npt.NDArray[np.int32]
    index: npt.NDArray[np.int32]
    point_count: int
    laser_mm: Float64Array
    plane_normal: Float64Array
    travel: Float64Array
    position_mm: float
    line_spacing_mm: float
    step_mm: float
    dropped: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for array in (self.xyz_q, self.index, self.laser_mm, self.plane_normal, self.travel):
            read_only(array)


def quantise(line: Scanline, origin_mm: Float64Array) -> StoredLine:
    """Quantise a scanline to the stored truth; nothing is clamped, what cannot be kept is counted by reason.

    Parameters
    ----------
    line : the scanline, part frame, millimetres.
    origin_mm : (3,) the session's origin in the part frame.

    Raises
    ------
    ValueError : when the line spacing or the laser position is no number that a scan can have.
    """
    if not (np.isfinite(line.line_spacing_mm) and line.line_spacing_mm > 0):
        raise ValueError(f"line spacing must be greater than 0 mm, not {line.line_spacing_mm}")
    low_mm, high_mm = LINE_SPACING_RANGE_MM
    if not low_mm <= line.line_spacing_mm <= high_mm:
        raise ValueError(f"line spacing must lie between {low_mm:g} and {high_mm:g} mm, not {line.line_spacing_mm:g}")
    if not (np.isfinite(line.laser_mm).all() and np.abs(line.laser_mm - origin_mm).max() <= LASER_RANGE_MM):
        raise ValueError(
            f"laser position must be three numbers within {LASER_RANGE_MM:g} mm of the origin, "
            f"not {line.laser_mm.tolist()}"
        )
    places = len(line.points_mm)
    xyz_q, index = np.empty((places, 3), dtype=np.int32), np.empty(places, dtype=np.int32)
    counts = np.zeros(len(_REASONS), dtype=np.int64)
    kept = _quantise(np.ascontiguousarray(line.points_mm), line.missing, origin_mm, xyz_q, index, counts)
    return StoredLine(
        device_id=line.device_id,
        boot_id=line.boot_id,
        pass_index=line.pass_index,
        line_index=line.line_index,
        device_time_s=line.device_time_s,
        xyz_q=xyz_q[:kept],
        index=index[:kept],
        point_count=places,
        laser_mm=np.array(line.laser_mm, dtype=np.float64),
        plane_normal=np.array(line.plane_normal, dtype=np.float64),
        travel=np.array(line.travel, dtype=np.float64),
        position_mm=float(line.position_mm),
        line_spacing_mm=float(line.line_spacing_mm),
        step_mm=float(line.step_mm),
        dropped={reason: count for reason, count in zip(_REASONS, counts.tolist(), strict=True) if count},
    )


_REASONS = ("dropout", "missing", "not_finite", "out_of_bounds")
_DROPOUT, _MISSING, _NOT_FINITE, _OUT_OF_BOUNDS = range(4)


@njit(cache=True)  # so short that letting go of Python's lock would cost more
def _quantise(
    points_mm: Float64Array,
    missing: npt.NDArray[np.bool_],
    origin_mm: Float64Array,
    xyz_q: npt.NDArray[np.int32],
    index: npt.NDArray[np.int32],
    counts: npt.NDArray[np.int64],
) -> int:
    """Write the points that can be kept, one behind the other, and count the others; returns how many are kept."""
    kept = 0
    for i in range(len(points_mm)):
        x, y, z = points_mm[i, 0], points_mm[i, 1], points_mm[i, 2]
        if missing[i]:
            counts[_MISSING] += 1
        elif math.isnan(x) and math.isnan(y) and math.isnan(z):
            counts[_DROPOUT] += 1
        elif not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            counts[_NOT_FINITE] += 1
        else:
            x, y, z = (
                np.rint((x - origin_mm[0]) * PER_MM),
                np.rint((y - origin_mm[1]) * PER_MM),
                np.rint((z - origin_mm[2]) * PER_MM),
            )
            if max(abs(x), abs(y), abs(z)) > _LIMIT_Q:
                counts[_OUT_OF_BOUNDS] += 1
                continue
            xyz_q[kept, 0], xyz_q[kept, 1], xyz_q[kept, 2] = np.int32(x), np.int32(y), np.int32(z)
            index[kept] = i
            kept += 1
    return kept
