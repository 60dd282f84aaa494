"""Planes within each point's own optimal radius: small where the surface bends, large where noise rules."""

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.analysis.errors import MethodRefused
from scanner_service.analysis.normals.choosing_count import Halves
from scanner_service.analysis.normals.field import NormalField, NormalOptions, Tell, tell_nobody
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
SCALES = (1.0, 0.1, 8.0, 64.0, 512.0, 4096.0)
"""What the constants of the formula are multiplied by, tried in this order; the first of equals is taken."""
SCALE_SAMPLE = 500

_REACHES = 1.0 + 1e-12


def adaptive_radius(points_mm: Float64Array, options: NormalOptions, tell: Tell = tell_nobody) -> NormalField:
    """Normals of (n, 3) by plane fits within the optimal radius of Mitra, Nguyen and Guibas (2004).

    Raises
    ------
    MethodRefused : fewer points than the first round of the iteration needs.
    """
    if len(points_mm) < FIRST_NEIGHBOURS:
        raise MethodRefused(
            f"an adaptive radius needs {FIRST_NEIGHBOURS} points or more, there are {len(points_mm)}: use fixed_radius"
        )
    scale = choose_scale(points_mm, options)
    law = _law(options, scale)
    found = optimal_radius(points_mm, options.noise_mm, law, lambda share: tell(0.9 * share))
    known = "given" if options.noise_mm is not None else "estimated"
    notes = (
        f"constants c1 and c2 are {scale:g} times the customary ones, chosen: two halves of the cloud agree best so",
        f"noise {found.noise_mm:.3g} mm, {known}; radius from {found.radius_mm.min():.3g} to "
        f"{found.radius_mm.max():.3g} mm, "
        f"at its floor on {found.at_floor.mean():.0%}, at its ceiling on {found.at_ceiling.mean():.0%} of the points",
    )
    extra = {"curvature_per_mm": found.curvature_per_mm, "density_per_mm2": found.density_per_mm2}
    return fit_within(
        NAME,
        points_mm,
        found.radius_mm * _REACHES,
        options,
        lambda share: tell(0.9 + 0.1 * share),
        notes=notes,
        extra=extra,
    )


def choose_scale(points_mm: Float64Array, options: NormalOptions) -> float:
    """How many times the customary c1 and c2 serve the points (n, 3) best, one of SCALES.

    The formula bounds the worst case, in which all the curvature of a neighbourhood lies on one side of the point. On
    smooth surfaces that costs a large part of what a larger radius would average away. The two halves of the cloud
    tell (`choose_count`).
    """
    halves = Halves.deal(points_mm, SCALE_SAMPLE)
    if len(halves.ladder) < 2:
        return 1.0
    reference = halves.reference()
    noise_mm = estimate_noise_mm(points_mm) if options.noise_mm is None else options.noise_mm
    risks = []
    for scale in SCALES:
        found = optimal_radius(points_mm, noise_mm, _law(options, scale), rows=halves.rows)
        risks.append(halves.risk(found.neighbours, reference))
    return SCALES[int(np.argmin(risks))]


def _law(options: NormalOptions, scale: float) -> RadiusLaw:
    return RadiusLaw(c1=scale * C1, c2=scale * C2, floor_mm=options.floor_mm, ceiling_mm=options.ceiling_mm)
