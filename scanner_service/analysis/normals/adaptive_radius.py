"""Planes within each point's own radius: small where the surface bends, large where noise rules."""

import math

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.errors import MethodRefused
from scanner_service.analysis.normals.choosing_count import Judge, best_count, judge_of
from scanner_service.analysis.normals.field import Int64Array, NormalField, NormalOptions, Tell, tell_nobody
from scanner_service.analysis.normals.fitting import Weighting
from scanner_service.analysis.normals.within import fit_within
from scanner_service.analysis.optimal_radius import (
    C1,
    C2,
    FIRST_NEIGHBOURS,
    RadiusLaw,
    estimate_noise_mm,
    optimal_radius,
)

NAME = "adaptive_radius"
SCALES = (1.0, 8.0, 64.0, 512.0)
"""What the constants of the formula are multiplied by, so that it speaks of the radius that the cloud needs."""

EXPONENTS = (0.5, 1.0, 0.0)
"""How far the formula is followed from point to point, tried in this order; the first of equals is taken."""

SCALE_SAMPLE = 500
LEAST = 10
"""No neighbourhood has fewer points, the point itself counted."""

_REACHES = 1.0 + 1e-9


def adaptive_radius(points_mm: Float64Array, options: NormalOptions, tell: Tell = tell_nobody) -> NormalField:
    """Normals of (n, 3) by weighted plane fits, radius by radius after Mitra, Nguyen and Guibas (2004).

    The formula tells how radii should differ from point to point, its constants bound the worst case. So the radius is
    R (m / M)^a: m the formula's radius at the point, M its median, R the distance to the k-th nearest point. Whoever
    judges numbers of neighbours on this cloud tells k and a (`judge_of`).

    Raises
    ------
    MethodRefused : fewer points than the first round of the iteration needs.
    """
    n = len(points_mm)
    if n < FIRST_NEIGHBOURS:
        raise MethodRefused(
            f"an adaptive radius needs {FIRST_NEIGHBOURS} points or more, there are {n}: use fixed_radius"
        )
    noise_mm = estimate_noise_mm(points_mm) if options.noise_mm is None else options.noise_mm
    tree = cKDTree(points_mm)
    judge = judge_of(points_mm, Weighting.BIWEIGHT)
    scale, exponent, count = 1.0, 1.0, 0
    if judge is not None:
        count = best_count(judge)
        scale = _scale(points_mm, noise_mm, options, judge, float(np.median(_reach(tree, judge.at_mm, count))))
        exponent, count = _blend(points_mm, noise_mm, options, judge, tree, scale)
    found = optimal_radius(points_mm, noise_mm, _law(options, scale), lambda share: tell(0.9 * share))
    radius_mm = found.radius_mm * _REACHES
    if count:
        radius_mm = _reach(tree, points_mm, count) * _relative(found.radius_mm) ** exponent
        radius_mm = np.maximum(radius_mm, _reach(tree, points_mm, min(LEAST, n))) * _REACHES
        radius_mm = np.clip(radius_mm, options.floor_mm, math.inf if options.ceiling_mm is None else options.ceiling_mm)
    known = "given" if options.noise_mm is not None else "estimated"
    notes = (
        f"constants c1 and c2 are {scale:g} times the customary ones, radii follow the formula to the power "
        f"{exponent:g} around {count or FIRST_NEIGHBOURS} neighbours: so the cloud itself tells",
        f"noise {found.noise_mm:.3g} mm, {known}; radius from {radius_mm.min():.3g} to {radius_mm.max():.3g} mm, the "
        f"formula at its floor on {found.at_floor.mean():.0%}, at its ceiling on {found.at_ceiling.mean():.0%} of the "
        "points",
    )
    return fit_within(
        NAME,
        points_mm,
        radius_mm,
        options,
        lambda share: tell(0.9 + 0.1 * share),
        weighting=Weighting.BIWEIGHT,
        notes=notes,
        extra={"curvature_per_mm": found.curvature_per_mm, "density_per_mm2": found.density_per_mm2},
    )


def _scale(points_mm: Float64Array, noise_mm: float, options: NormalOptions, judge: Judge, reach_mm: float) -> float:
    """The scale, one of SCALES, for which the formula's median radius comes nearest to the one the cloud needs.

    The formula bounds the worst case, in which all the curvature of a neighbourhood lies on one side of the point. On
    smooth surfaces its radius is far too small, and a curvature that is measured within it is noise.
    """
    some = judge.rows[:SCALE_SAMPLE]
    apart = []
    for scale in SCALES:
        found = optimal_radius(points_mm, noise_mm, _law(options, scale), rows=some)
        apart.append(abs(math.log(float(np.median(found.radius_mm)) / reach_mm)) if reach_mm > 0.0 else 0.0)
    return SCALES[int(np.argmin(apart))]


def _blend(
    points_mm: Float64Array,
    noise_mm: float,
    options: NormalOptions,
    judge: Judge,
    tree: cKDTree,
    scale: float,
) -> tuple[float, int]:
    """The exponent, one of EXPONENTS, and the number of neighbours, a step of the ladder, with the least risk."""
    relative = _relative(optimal_radius(points_mm, noise_mm, _law(options, scale), rows=judge.rows).radius_mm)
    ladder = judge.ladder
    near_mm = np.asarray(tree.query(judge.at_mm, k=np.arange(1, ladder[-1] + 1))[0])
    best, chosen = math.inf, (0.0, ladder[0])
    for exponent in EXPONENTS:
        for count in ladder:
            radius = near_mm[:, count - 1] * relative**exponent
            counts: Int64Array = np.maximum((near_mm < radius[:, None] * _REACHES).sum(axis=1), LEAST)
            risk = judge.risk(counts)
            if risk < best:
                best, chosen = risk, (exponent, count)
    return chosen


def _relative(radius_mm: Float64Array) -> Float64Array:
    """Radii (n,) over their median; 1 where all are 0."""
    middle = float(np.median(radius_mm))
    return radius_mm / middle if middle > 0.0 else np.ones_like(radius_mm)


def _reach(tree: cKDTree, at_mm: Float64Array, count: int) -> Float64Array:
    """Distance in mm (m,) of places (m, 3) to the `count`-th nearest point, one that lies there counted."""
    return np.asarray(tree.query(at_mm, k=[count])[0])[:, 0]


def _law(options: NormalOptions, scale: float) -> RadiusLaw:
    return RadiusLaw(c1=scale * C1, c2=scale * C2, floor_mm=options.floor_mm, ceiling_mm=options.ceiling_mm)
