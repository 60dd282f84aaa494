"""Planes through everything within one radius; the same radius for all points, so dense and sparse places differ."""

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.choosing_count import choose_count, radius_of_count
from scanner_service.analysis.normals.field import NormalField, NormalOptions, Tell, tell_nobody
from scanner_service.analysis.normals.within import fit_within

NAME = "fixed_radius"


def fixed_radius(points_mm: Float64Array, options: NormalOptions, tell: Tell = tell_nobody) -> NormalField:
    """Normals of (n, 3) by plane fits within a fixed radius (Hoppe et al. 1994).

    Without a stated radius it is the median distance to the k-th neighbour, k being chosen for the cloud.
    """
    notes: tuple[str, ...] = ()
    radius_mm = options.radius_mm
    if radius_mm is None:
        count = choose_count(points_mm)
        radius_mm = radius_of_count(cKDTree(points_mm), points_mm, count)
        notes = (f"radius {radius_mm:.4g} mm, chosen: half of the points have {count} neighbours within it",)
    return fit_within(NAME, points_mm, np.full(len(points_mm), radius_mm), options, tell, notes=notes)
