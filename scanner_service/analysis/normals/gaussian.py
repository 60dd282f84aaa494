"""Planes that respect near points more than far ones: a Gaussian of the distance weighs them."""

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.choosing_count import choose_count, radius_of_count
from scanner_service.analysis.normals.field import NormalField, NormalOptions, Tell, tell_nobody
from scanner_service.analysis.normals.fitting import Weighting
from scanner_service.analysis.normals.within import fit_within

NAME = "gaussian"
REACH = 3.0 / 8.0**0.25
"""A Gaussian of width h averages as much noise as a disc of radius 8^(1/4) h; so its radius, 3 h, is larger by this."""


def gaussian(points_mm: Float64Array, options: NormalOptions, tell: Tell = tell_nobody) -> NormalField:
    """Normals of (n, 3) by plane fits weighted with exp(-d²/h²), h a third of the radius (Pauly et al. 2003).

    Without a stated radius it is REACH times the median distance to the k-th neighbour, k being chosen for the cloud.
    """
    notes: tuple[str, ...] = ()
    radius_mm = options.radius_mm
    if radius_mm is None:
        count = choose_count(points_mm)
        radius_mm = REACH * radius_of_count(cKDTree(points_mm), points_mm, count)
        notes = (f"radius {radius_mm:.4g} mm, chosen: it smooths as {count} neighbours of equal weight do",)
    radii_mm = np.full(len(points_mm), radius_mm)
    return fit_within(NAME, points_mm, radii_mm, options, tell, weighting=Weighting.GAUSSIAN, notes=notes)
