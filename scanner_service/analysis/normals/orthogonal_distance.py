"""Planes of least orthogonal distance through a number of neighbours: the chapter's method, and the default."""

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.choosing_count import choose_count
from scanner_service.analysis.normals.field import NormalField, NormalOptions, Tell, tell_nobody
from scanner_service.analysis.normals.fitting import Weighting, fit_all
from scanner_service.analysis.normals.neighbourhoods import by_number
from scanner_service.analysis.normals.within import fit_within

NAME = "orthogonal_distance"


def orthogonal_distance(points_mm: Float64Array, options: NormalOptions, tell: Tell = tell_nobody) -> NormalField:
    """Normals of (n, 3) by orthogonal distance fits (Ahn 2004), the axis of the smallest central moment.

    In a stated radius or number of points all weigh alike. With neither the number is chosen for the cloud, and points
    weigh (1 - d²/r²)², which costs the least error for a number that is chosen (`Weighting.BIWEIGHT`).
    """
    if options.radius_mm is not None:
        return fit_within(NAME, points_mm, np.full(len(points_mm), options.radius_mm), options, tell)
    notes: tuple[str, ...] = ()
    count, weighting = options.neighbours, Weighting.EQUAL
    if count is None:
        weighting = Weighting.BIWEIGHT
        count = choose_count(points_mm, weighting)
        notes = (f"{count} neighbours, chosen: as the cloud itself tells, normals err least with so many",)
    pieces = by_number(cKDTree(points_mm), points_mm, np.arange(len(points_mm)), count)
    return fit_all(
        NAME, points_mm, pieces, max_error_rad=options.max_error_rad, weighting=weighting, tell=tell, notes=notes
    )
