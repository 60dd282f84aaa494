"""Planes within each point's own optimal radius: small where the surface bends, large where noise rules."""

from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.errors import MethodRefused
from scanner_service.analysis.normals.field import NormalField, NormalOptions, Tell, tell_nobody
from scanner_service.analysis.normals.fitting import fit_all
from scanner_service.analysis.normals.neighbourhoods import by_radius
from scanner_service.analysis.optimal_radius import FIRST_NEIGHBOURS, RadiusLaw, optimal_radius

NAME = "adaptive_radius"
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
    law = RadiusLaw(floor_mm=options.floor_mm, ceiling_mm=options.ceiling_mm)
    found = optimal_radius(points_mm, options.noise_mm, law, lambda share: tell(0.9 * share))
    known = "given" if options.noise_mm is not None else "estimated"
    notes = (
        f"noise {found.noise_mm:.3g} mm, {known}; radius from {found.radius_mm.min():.3g} to "
        f"{found.radius_mm.max():.3g} mm, "
        f"at its floor on {found.at_floor.mean():.0%}, at its ceiling on {found.at_ceiling.mean():.0%} of the points",
    )
    pieces = by_radius(cKDTree(points_mm), points_mm, found.radius_mm * _REACHES)
    extra = {"curvature_per_mm": found.curvature_per_mm, "density_per_mm2": found.density_per_mm2}
    return fit_all(
        NAME,
        points_mm,
        pieces,
        max_error_rad=options.max_error_rad,
        notes=notes,
        extra=extra,
        tell=lambda share: tell(0.9 + 0.1 * share),
    )
