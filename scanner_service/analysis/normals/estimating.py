"""Normals of a cloud by any of the methods, through one door that checks what comes in; knows no method's inside."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.errors import MethodRefused, MethodUnknown
from scanner_service.analysis.normals import (
    adaptive_radius,
    big_balls,
    fixed_radius,
    gaussian,
    orthogonal_distance,
    voronoi_poles,
)
from scanner_service.analysis.normals.field import (
    MIN_NEIGHBOURS,
    NormalField,
    NormalOptions,
    NormalReason,
    Tell,
    tell_nobody,
)

Estimate = Callable[[Float64Array, NormalOptions, Tell], NormalField]
MAX_EXTENT_MM = 1e9
"""Points farther from their middle than this (1,000 km) are refused: nobody scanned them."""


@dataclass(frozen=True, slots=True)
class NormalMethod:
    """A method: its name, what it does in a few words and by whom, the options it reads, and its function.

    The function takes finite points (n, 3) in mm, at least MIN_NEIGHBOURS of them, and gives a field of n normals.
    """

    name: str
    summary: str
    reads: frozenset[str]
    estimate: Estimate

    def check(self, options: NormalOptions) -> None:
        """Raise MethodRefused when an option is stated that the method does not read."""
        foreign = sorted(options.given() - self.reads)
        if foreign:
            takes = ", ".join(sorted(self.reads)) or "no options"
            raise MethodRefused(f"{self.name} does not read {', '.join(foreign)}; it takes {takes}")


def _method(name: str, summary: str, reads: tuple[str, ...], estimate: Estimate) -> tuple[str, NormalMethod]:
    return name, NormalMethod(name, summary, frozenset(reads), estimate)


METHODS: dict[str, NormalMethod] = dict(
    (
        _method(
            orthogonal_distance.NAME,
            "plane through the nearest points (Ahn)",
            ("radius_mm", "neighbours"),
            orthogonal_distance.orthogonal_distance,
        ),
        _method(fixed_radius.NAME, "plane within one radius (Hoppe)", ("radius_mm",), fixed_radius.fixed_radius),
        _method(
            adaptive_radius.NAME,
            "plane within the point's optimal radius (Mitra)",
            ("noise_mm", "floor_mm", "ceiling_mm"),
            adaptive_radius.adaptive_radius,
        ),
        _method(gaussian.NAME, "plane weighted by a Gaussian (Pauly)", ("radius_mm",), gaussian.gaussian),
        _method(voronoi_poles.NAME, "farthest Voronoi vertex (Amenta and Bern)", (), voronoi_poles.voronoi_poles),
        _method(big_balls.NAME, "big Delaunay balls (Dey and Goswami)", ("ball_factor",), big_balls.big_delaunay_balls),
    )
)
DEFAULT_METHOD = orthogonal_distance.NAME


def estimate_normals(
    points_mm: Float64Array,
    method: str = DEFAULT_METHOD,
    options: NormalOptions | None = None,
    tell: Tell = tell_nobody,
) -> NormalField:
    """Normals of the points (n, 3) by a method of METHODS; points that are not finite are left out of everything.

    Raises
    ------
    MethodUnknown : no such method.
    MethodRefused : an option that the method does not read, too few points for it, or points it cannot work on.
    """
    options = options or NormalOptions()
    if method not in METHODS:
        raise MethodUnknown(f"there is no method {method}; the methods are {', '.join(METHODS)}")
    chosen = METHODS[method]
    chosen.check(options)
    points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 3)
    finite: BoolArray = np.asarray(np.isfinite(points).all(axis=1))
    count = int(finite.sum())
    if count < MIN_NEIGHBOURS:
        raise MethodRefused(f"normals need {MIN_NEIGHBOURS} points or more with finite coordinates, there are {count}")
    kept = points[finite]
    middle = kept.mean(axis=0)
    with np.errstate(over="ignore", invalid="ignore"):
        kept -= middle
    if not np.isfinite(middle).all() or max(float(kept.max()), -float(kept.min())) > MAX_EXTENT_MM:
        raise MethodRefused(
            f"the points reach farther than {MAX_EXTENT_MM:g} mm from their middle: check the units, remove outliers"
        )
    field = chosen.estimate(kept, options, tell)
    return field if finite.all() else _spread(field, finite)


def _spread(field: NormalField, finite: BoolArray) -> NormalField:
    """The field of all points, those that are not finite with their reason."""
    n = len(finite)
    normals, error, radius = np.full((n, 3), np.nan), np.full(n, np.nan), np.full(n, np.nan)
    reason = np.full(n, NormalReason.NOT_FINITE, dtype=np.uint8)
    neighbours = np.zeros(n, dtype=np.int64)
    normals[finite], error[finite], radius[finite] = field.normals, field.error_rad, field.radius_mm
    reason[finite], neighbours[finite] = field.reason, field.neighbours
    extra = {name: np.full(n, np.nan) for name in field.extra}
    for name, values in field.extra.items():
        extra[name][finite] = values
    return NormalField(field.method, normals, reason, error, radius, neighbours, field.notes, extra)
