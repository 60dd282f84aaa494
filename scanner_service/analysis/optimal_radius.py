"""The radius at which noise and curvature harm a normal equally, for every point of a cloud; fits no final normal.

Mitra, Nguyen and Guibas 2004 (Eq. 6.2; the cube root is theirs). The iteration follows Lalonde et al. 2005.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.normals.choosing_count import choose_count
from scanner_service.analysis.normals.field import MAX_NEIGHBOURS, Int64Array, Tell, tell_nobody
from scanner_service.analysis.normals.neighbourhoods import by_number
from scanner_service.analysis.quadrics.bivariate import curvatures_at, fit_bivariate, frame_at
from scanner_service.analysis.radius import mixed

FIRST_NEIGHBOURS = 15
"""ρ and κ of the first round come from so many nearest points."""

FLOOR_NEIGHBOURS = 15
"""Without a stated floor a radius reaches at least the point with this number, itself counted."""

C1, C2, EPSILON = 1.0, 4.0, 0.1
"""Customary constants of the formula; EPSILON is the share of points whose error may exceed the bound."""

DAMPING = 0.3
LARGEST_STEP = 1.5
"""A round reaches for at most this multiple of its radius: a flat place must not leap over the edges around it."""

ROUNDS = 60
ENOUGH = 100
"""While a radius is sought, a curvature is fitted to about so many of its neighbours at most."""

NOISE_SAMPLE = 2000
_NOISE_NEIGHBOURS = (30, 100)


@dataclass(frozen=True, slots=True)
class RadiusLaw:
    """The constants of the formula, how the iteration is damped, and between which bounds a radius stays.

    A stated `floor_mm` or `ceiling_mm` holds for all points. Otherwise the floor reaches the FLOOR_NEIGHBOURS-th
    nearest point, and the ceiling the `max_neighbours`-th.
    """

    c1: float = C1
    c2: float = C2
    epsilon: float = EPSILON
    damping: float = DAMPING
    floor_mm: float | None = None
    ceiling_mm: float | None = None
    max_neighbours: int = MAX_NEIGHBOURS

    def __post_init__(self) -> None:
        if not (self.c1 >= 0 and self.c2 >= 0 and 0 < self.epsilon <= 1 and 0 < self.damping <= 1):
            raise ValueError("c1 and c2 must be 0 or more, epsilon and damping greater than 0 and at most 1")
        if self.max_neighbours < FIRST_NEIGHBOURS:
            raise ValueError(f"max_neighbours must be at least {FIRST_NEIGHBOURS}, not {self.max_neighbours}")


@dataclass(frozen=True, slots=True)
class OptimalRadius:
    """Radius, density and curvature (n,) of the points of a cloud.

    `radius_mm` is the radius where the iteration settled, `density_per_mm2` = k/(πr²) within it, `curvature_per_mm` the
    larger principal curvature, without its sign, of the bivariate quadratic fitted within it (NaN where fewer points
    than it needs lie there). `at_floor` and `at_ceiling` mark points whose radius a bound decided. `noise_mm` is the
    standard deviation that was given or estimated.
    """

    radius_mm: Float64Array
    density_per_mm2: Float64Array
    curvature_per_mm: Float64Array
    neighbours: Int64Array
    at_floor: BoolArray
    at_ceiling: BoolArray
    noise_mm: float

    def __post_init__(self) -> None:
        for name in ("radius_mm", "density_per_mm2", "curvature_per_mm", "neighbours", "at_floor", "at_ceiling"):
            read_only(getattr(self, name))


def mitra_radius_mm(
    curvature_per_mm: Float64Array,
    density_per_mm2: Float64Array,
    noise_mm: float,
    *,
    c1: float = C1,
    c2: float = C2,
    epsilon: float = EPSILON,
) -> Float64Array:
    """r = ((1/κ) (c1 σ/√(ε ρ) + c2 σ²))^(1/3) in mm (Eq. 6.2, with its cube root), of arrays of one shape.

    Infinite where the curvature is 0 and there is noise, 0 without noise.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        noise = c1 * noise_mm / np.sqrt(epsilon * density_per_mm2) + c2 * noise_mm * noise_mm
        return np.asarray(np.where(noise > 0.0, np.cbrt(noise / curvature_per_mm), 0.0))


def estimate_noise_mm(points_mm: Float64Array) -> float:
    """Standard deviation in mm of the points (n, 3) across their surface: the median residual of bivariate fits.

    Over a repeatable sample, each fit over as many neighbours as suit the cloud (`choose_count`), from 30 to 100. NaN
    for clouds too small for that.
    """
    n = len(points_mm)
    least, most = _NOISE_NEIGHBOURS
    if n < least:
        return math.nan
    count = min(max(choose_count(points_mm), least), most)
    sample = np.argsort(mixed(np.arange(n, dtype=np.uint64)), kind="stable")[:NOISE_SAMPLE]
    residual = []
    for some in by_number(cKDTree(points_mm), points_mm, sample, count):
        found = np.full(len(some.at), np.nan)
        _residuals(points_mm, some.at, some.starts, some.rows, some.radius_mm, found)
        residual.append(found)
    found = np.concatenate(residual)
    return float(np.nanmedian(found)) if np.isfinite(found).any() else math.nan


def optimal_radius(
    points_mm: Float64Array,
    noise_mm: float | None = None,
    law: RadiusLaw | None = None,
    tell: Tell = tell_nobody,
    rows: Int64Array | None = None,
) -> OptimalRadius:
    """Iterate Eq. 6.2 for every point (n, 3), finite, from its FIRST_NEIGHBOURS nearest on.

    The first round takes κ = 2d/μ², d being the distance of the point to the plane of its neighbours and μ their mean
    distance. Under noise that is far too large, so from then on κ is that of the bivariate quadratic within the
    radius of the round, lessened by what noise alone would feign. Each step goes only `damping` of the way. `rows` (m,)
    asks for some of the points only.

    Raises
    ------
    ValueError : fewer than FIRST_NEIGHBOURS points.
    """
    law = law or RadiusLaw()
    n = len(points_mm)
    if n < FIRST_NEIGHBOURS:
        raise ValueError(f"the optimal radius needs {FIRST_NEIGHBOURS} points or more, there are {n}")
    noise = estimate_noise_mm(points_mm) if noise_mm is None else noise_mm
    if not math.isfinite(noise):
        noise = 0.0
    asked = np.arange(n) if rows is None else rows
    m = len(asked)
    radius, density, curvature = np.empty(m), np.empty(m), np.empty(m)
    count = np.empty(m, dtype=np.int64)
    bound = np.empty(m, dtype=np.int64)
    done = 0
    for some in by_number(cKDTree(points_mm), points_mm, asked, law.max_neighbours):
        part = slice(done, done + len(some.at))
        done = part.stop
        _iterate(
            points_mm,
            some.at,
            some.starts,
            some.rows,
            noise,
            law.c1,
            law.c2,
            law.epsilon,
            law.damping,
            -1.0 if law.floor_mm is None else law.floor_mm,
            math.inf if law.ceiling_mm is None else law.ceiling_mm,
            radius[part],
            density[part],
            curvature[part],
            count[part],
            bound[part],
        )
        tell(done / m)
    return OptimalRadius(radius, density, curvature, count, bound < 0, bound > 0, noise)


@njit(cache=True, nogil=True, error_model="numpy")
def _residuals(
    points: Float64Array,
    at: Int64Array,
    starts: Int64Array,
    rows: Int64Array,
    radius: Float64Array,
    residual: Float64Array,
) -> None:
    frame, coefficients, variances = np.empty((3, 3)), np.empty(6), np.empty(6)
    for i in range(len(at)):
        some = rows[starts[i] : starts[i + 1]]
        if radius[i] > 0.0 and frame_at(points, at[i], some, frame):
            residual[i] = fit_bivariate(points, at[i], some, radius[i], frame, coefficients, variances)


@njit(cache=True, nogil=True, error_model="numpy")
def _iterate(
    points: Float64Array,
    at: Int64Array,
    starts: Int64Array,
    rows: Int64Array,
    noise: float,
    c1: float,
    c2: float,
    epsilon: float,
    damping: float,
    floor_mm: float,
    ceiling_mm: float,
    radius: Float64Array,
    density: Float64Array,
    curvature: Float64Array,
    count: Int64Array,
    bound: Int64Array,
) -> None:
    """One iteration a point over its neighbours, which are sorted by distance."""
    frame, coefficients, variances = np.empty((3, 3)), np.empty(6), np.empty(6)
    for i in range(len(at)):
        some = rows[starts[i] : starts[i + 1]]
        n = len(some)
        distance = np.empty(n)
        for k in range(n):
            dx, dy = points[some[k], 0] - points[at[i], 0], points[some[k], 1] - points[at[i], 1]
            dz = points[some[k], 2] - points[at[i], 2]
            distance[k] = math.sqrt(dx * dx + dy * dy + dz * dz)
        floor = floor_mm if floor_mm >= 0.0 else distance[min(FLOOR_NEIGHBOURS, n) - 1]
        ceiling = min(ceiling_mm, distance[n - 1])
        floor = min(floor, ceiling)
        within: int = min(FIRST_NEIGHBOURS, n)
        r = distance[within - 1]
        kappa = _first_curvature(points, at[i], some[:within], distance[:within], frame)
        hits = 0
        for _ in range(ROUNDS):
            if not r > 0.0:
                break
            rho = within / (math.pi * r * r)
            push = c1 * noise / math.sqrt(epsilon * rho) + c2 * noise * noise
            if push <= 0.0:
                wanted = 0.0
            elif kappa <= 0.0:
                wanted = math.inf
            else:
                wanted = (push / kappa) ** (1.0 / 3.0)
            hits = 0
            if not wanted < ceiling:
                wanted, hits = ceiling, 1
            elif not wanted > floor:
                wanted, hits = floor, -1
            before = r
            r = damping * min(wanted, LARGEST_STEP * r) + (1.0 - damping) * r
            if abs(r - before) <= 2e-3 * before:
                r = wanted if hits != 0 else r
                within = max(int(np.searchsorted(distance, r, side="right")), 1)
                break
            within = max(int(np.searchsorted(distance, r, side="right")), 1)
            kappa = _curvature(points, at[i], some[:within], r, kappa, frame, coefficients, variances)
        r = min(max(r, floor), ceiling)
        within = max(int(np.searchsorted(distance, r, side="right")), 1)
        radius[i], count[i], bound[i] = r, within, hits
        density[i] = within / (math.pi * r * r) if r > 0.0 else np.nan
        curvature[i] = np.nan
        if within > 6 and r > 0.0 and frame_at(points, at[i], some[:within], frame):
            rms = fit_bivariate(points, at[i], some[:within], r, frame, coefficients, variances)
            if rms >= 0.0:
                k1, k2, _, _, _, _ = curvatures_at(coefficients, 0.0, 0.0)
                curvature[i] = max(abs(k1), abs(k2))


@njit(cache=True, nogil=True, error_model="numpy")
def _first_curvature(
    points: Float64Array, row: int, some: Int64Array, distance: Float64Array, frame: Float64Array
) -> float:
    """κ = 2d/μ² (Lalonde et al. 2005); 0 where there is no plane."""
    if not frame_at(points, row, some, frame):
        return 0.0
    offset = 0.0
    for k in range(len(some)):
        for axis in range(3):
            offset += (points[some[k], axis] - points[row, axis]) * frame[2, axis]
    mean = distance.sum() / max(len(distance) - 1, 1)
    return float(2.0 * abs(offset / len(some)) / (mean * mean)) if mean > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _curvature(
    points: Float64Array,
    row: int,
    some: Int64Array,
    radius: float,
    before: float,
    frame: Float64Array,
    coefficients: Float64Array,
    variances: Float64Array,
) -> float:
    """The larger principal curvature within the radius, less what noise feigns; the one before if there is no fit."""
    some = some[:: max(len(some) // ENOUGH, 1)]  # sorted by distance: every so manieth is spread over the whole radius
    if len(some) < 9 or not frame_at(points, row, some, frame):
        return before
    rms = fit_bivariate(points, row, some, radius, frame, coefficients, variances)
    if not rms >= 0.0:
        return before
    d, e, f = coefficients[3], coefficients[4], coefficients[5]
    k1, k2, _, _, _, _ = curvatures_at(coefficients, 0.0, 0.0)
    bend = 4.0 * d * d + 2.0 * e * e + 4.0 * f * f
    feigned = rms * rms * (4.0 * variances[3] + 2.0 * variances[4] + 4.0 * variances[5])
    if not bend > 0.0:
        return 0.0
    return max(abs(k1), abs(k2)) * math.sqrt(max(1.0 - feigned / bend, 0.0))
