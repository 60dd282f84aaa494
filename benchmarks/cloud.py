"""The cloud of the benchmark: an endless part with waves, steep flanks and holes, as stored lines; measures nothing.

Lines lie 0.2 mm apart and hold 1,280 places 0.15 mm apart; every coordinate carries 0.01 mm of noise. In each square
of PITCH_MM stands a truncated cone with flanks of 60 degrees (where they face the travel, neighbouring lines are out
of reach of r_min) with a hole in its middle. The columns of cones are shifted against each other, and all repeats
along the travel, so that every line holds its share of easy and hard places, the last one like the first.
"""

import math

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array
from scanner_service.analysis.intake import QUANTUM_MM, StoredLine

LINE_SPACING_MM = 0.2
POINT_SPACING_MM = 0.15
NOISE_MM = 0.01
POINTS_PER_LINE = 1280
RADIUS_MM = math.sqrt(2.0) * LINE_SPACING_MM + 0.1

PITCH_MM = 24.0
_SHIFT_MM = 9.0
_HOLE_MM = 2.5
_CONE_TOP_MM = 3.5
_CONE_HEIGHT_MM = 5.0
_FLANK = math.tan(math.radians(60.0))
_CONE_FOOT_MM = _CONE_TOP_MM + _CONE_HEIGHT_MM / _FLANK
_LASER_HEIGHT_MM = 150.0
_DROPOUT = 0.005


def _from_centre_mm(x_mm: Float64Array, y_mm: float) -> Float64Array:
    """(n,) distance to the axis of the nearest cone, seen from above."""
    half = PITCH_MM / 2.0
    column = np.floor(x_mm / PITCH_MM)
    across = x_mm - (column + 0.5) * PITCH_MM
    along = (y_mm + column * _SHIFT_MM + half) % PITCH_MM - half
    return np.asarray(np.hypot(across, along))


def height_mm(x_mm: Float64Array, y_mm: float) -> Float64Array:
    """(n,) height of the part over places (n,) across and one place along the travel."""
    wave = 1.5 * np.sin(x_mm / 9.0) * math.cos(2.0 * math.pi * y_mm / PITCH_MM)
    flank = (_CONE_FOOT_MM - _from_centre_mm(x_mm, y_mm)) * _FLANK
    return np.asarray(wave + np.clip(flank, 0.0, _CONE_HEIGHT_MM))


def make_line(number: int, rng: np.random.Generator) -> StoredLine:
    """One scanline of the cloud; places over a hole, and one in 200 elsewhere, have no return."""
    x_mm = np.linspace(-0.5, 0.5, POINTS_PER_LINE) * ((POINTS_PER_LINE - 1) * POINT_SPACING_MM)
    y_mm = number * LINE_SPACING_MM
    points_mm = np.column_stack([x_mm, np.full(POINTS_PER_LINE, y_mm), height_mm(x_mm, y_mm)])
    points_mm += rng.normal(0.0, NOISE_MM, points_mm.shape)
    kept = (_from_centre_mm(x_mm, y_mm) > _HOLE_MM) & (rng.random(POINTS_PER_LINE) >= _DROPOUT)
    along_y = np.array([0.0, 1.0, 0.0])
    return StoredLine(
        device_id="benchmark",
        boot_id=1,
        pass_index=0,
        line_index=number,
        device_time_s=number * 1e-3,
        xyz_q=np.rint(points_mm[kept] / QUANTUM_MM).astype(np.int32),
        index=np.flatnonzero(kept).astype(np.int32),
        point_count=POINTS_PER_LINE,
        laser_mm=np.array([0.0, y_mm, _LASER_HEIGHT_MM]),
        plane_normal=along_y,
        travel=along_y,
        position_mm=y_mm,
        line_spacing_mm=LINE_SPACING_MM,
        step_mm=LINE_SPACING_MM,
        dropped={"dropout": int(POINTS_PER_LINE - kept.sum())},
    )


def make_lines(points: int, seed: int = 1) -> list[StoredLine]:
    """The first lines of the cloud, as many as are needed for `points` returns."""
    rng = np.random.default_rng(seed)
    lines: list[StoredLine] = []
    made = 0
    while made < points:
        line = make_line(len(lines), rng)
        lines.append(line)
        made += len(line.index)
    return lines


def uncertainty_mm(radius_factor: float) -> float:
    """The constant c with which Eq. 6.3 gives `radius_factor` times the radius of the cloud."""
    return radius_factor * RADIUS_MM - math.sqrt(2.0) * LINE_SPACING_MM


def coordinates_q(lines: list[StoredLine]) -> npt.NDArray[np.int32]:
    """(n, 3) stored coordinates of all lines, in the order of the map's rows."""
    return np.concatenate([line.xyz_q for line in lines])
