"""The radius rules of the chapter, as pure functions of spacings and points; knows no map."""

import hashlib
import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.snapshot import RadiusRule

LiveRule = Literal["line", "flexible", "global"]

MIN_GAPS = 10
"""A line's median point spacing is trusted from this many gaps on; below, the line spacing governs alone."""


@dataclass(frozen=True, slots=True)
class RadiusSettings:
    """Which radius a scanline's points get.

    `rule`: `line` is Eq. 6.3 with the governing spacing, `flexible` grows each point's radius until 20 points are
    covered, `global` takes one radius for the whole cloud, the median of a 1 % sample. `uncertainty_mm` is the
    constant c of Eq. 6.3 (0.1 mm by default), and where a flexible radius starts. `point_spacing_mm` says how far
    apart the points of a line are: None measures it in each line, a number states it for all, and 0 ignores it (plain
    Eq. 6.3).
    """

    uncertainty_mm: float = 0.1
    point_spacing_mm: float | None = None
    rule: LiveRule = "line"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.uncertainty_mm) and self.uncertainty_mm >= 0):
            raise ValueError(f"the constant c must be 0 mm or more, not {self.uncertainty_mm}")
        if self.point_spacing_mm is not None and not 0 <= self.point_spacing_mm < math.inf:
            raise ValueError(f"the point spacing must be 0 mm or more, not {self.point_spacing_mm}")
        if self.rule not in get_args(LiveRule):
            raise ValueError(f"the radius rule must be line, flexible or global, not {self.rule}")
        if self.rule != "line" and not self.uncertainty_mm > 0:
            raise ValueError("a radius that grows from c needs c greater than 0 mm")


def point_spacing_mm(xyz_q: npt.NDArray[np.int32], index: npt.NDArray[np.int32]) -> float:
    """Median distance in mm of points that are next to each other in a line; NaN with fewer than MIN_GAPS gaps.

    `xyz_q` (k, 3) are stored coordinates, `index` (k,) their places; pairs with a dropout between them do not count.
    """
    squares = np.empty(max(len(index) - 1, 0))
    n = _squared_steps(xyz_q, index, squares)
    if n < MIN_GAPS:
        return math.nan
    half = np.partition(squares[:n], n // 2)
    upper = math.sqrt(half[n // 2])
    if n % 2 == 1:
        return upper * QUANTUM_MM
    return 0.5 * (math.sqrt(half[: n // 2].max()) + upper) * QUANTUM_MM


@njit(cache=True)
def _squared_steps(xyz_q: npt.NDArray[np.int32], place: npt.NDArray[np.int32], squares: npt.NDArray[np.float64]) -> int:
    """Squared distances of neighbours in quanta, exact in float64 up to 8 m; returns how many there are."""
    n = 0
    for i in range(len(place) - 1):
        if place[i + 1] - place[i] == 1:
            x, y, z = xyz_q[i + 1, 0] - xyz_q[i, 0], xyz_q[i + 1, 1] - xyz_q[i, 1], xyz_q[i + 1, 2] - xyz_q[i, 2]
            squares[n] = float(x) * x + float(y) * y + float(z) * z
            n += 1
    return n


def line_radius(line_spacing_mm: float, measured_mm: float, settings: RadiusSettings) -> tuple[float, RadiusRule]:
    """r_min = sqrt(2) * max(line spacing, point spacing) + c, in mm, and which of the two spacings governed.

    Eq. 6.3 of the chapter presumes points at least as close along the line as the lines are to each other; where they
    are not, the larger spacing governs. `measured_mm` is the line's own point spacing (NaN: unknown).

    Raises
    ------
    ValueError : when the line spacing is not a positive finite number.
    """
    if not (math.isfinite(line_spacing_mm) and line_spacing_mm > 0):
        raise ValueError(f"line spacing must be greater than 0 mm, not {line_spacing_mm}")
    spacing = measured_mm if settings.point_spacing_mm is None else settings.point_spacing_mm
    governs = spacing > line_spacing_mm
    governing = spacing if governs else line_spacing_mm
    rule = RadiusRule.POINT_SPACING if governs else RadiusRule.LINE_SPACING
    return math.sqrt(2.0) * governing + settings.uncertainty_mm, rule


def radius_squared_q(radius_mm: Float64Array) -> npt.NDArray[np.int64]:
    """floor((r / q)^2): two stored points are neighbours when their squared integer distance is at most this."""
    return np.floor((radius_mm / QUANTUM_MM) ** 2).astype(np.int64)


FLEXIBLE_POINTS = 20
"""A flexible scanner's radius grows until it covers this many points, the point itself counted."""

GLOBAL_SHARE = 100
"""One point in this many is in the sample for the global radius."""


def flexible_radius_mm(
    points_mm: Float64Array, rows: npt.NDArray[np.int64], uncertainty_mm: float, max_radius_mm: float
) -> Float64Array:
    """r = max(c, distance to the 20th point counting itself), capped at `max_radius_mm`; one radius a row asked for.

    The chapter's rule for hand-guided scanners, made definite. `points_mm` (n, 3), `rows` (m,) of them, result (m,).
    A capped radius covers fewer than 20 points, which the neighbourhood then says itself.
    """
    count = min(FLEXIBLE_POINTS, len(points_mm))
    if not len(rows):
        return np.zeros(0)
    if count < FLEXIBLE_POINTS:
        return np.full(len(rows), max_radius_mm)
    distance = np.asarray(cKDTree(points_mm).query(points_mm[rows], k=[count])[0])
    radius: Float64Array = np.clip(distance[:, 0], uncertainty_mm, max_radius_mm)
    return radius


def sample_rows(
    device_id: str, boot_id: int, line_index: npt.NDArray[np.int64], place: npt.NDArray[np.int64]
) -> npt.NDArray[np.int64]:
    """Rows of the points in the repeatable 1 % sample: those whose 64-bit hash is 0 modulo GLOBAL_SHARE.

    `line_index` and `place` (n,) name the points within a device's boot; nothing else enters, so a replay samples the
    same points in any order. The mixing steps are those of splitmix64 (Steele, Lea and Flood 2014).
    """
    digest = hashlib.blake2b(device_id.encode(), digest_size=8).digest()
    state = np.full(len(place), int.from_bytes(digest, "little"), dtype=np.uint64)
    boot = np.full(len(place), boot_id, dtype=np.uint64)
    for part in (boot, line_index.astype(np.uint64), place.astype(np.uint64)):
        state = mixed(state ^ part)
    return np.flatnonzero(state % np.uint64(GLOBAL_SHARE) == 0)


def mixed(state: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """One step of splitmix64: numbers that look random, and are the same every time."""
    state = state + np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))
