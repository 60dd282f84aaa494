"""Normals along the line to the farthest Voronoi vertex: for clouds without noise; one wrong point misleads it."""

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.delaunay_balls import LargestBalls, largest_balls
from scanner_service.analysis.normals.field import NormalField, NormalOptions, NormalReason, Tell, tell_nobody

NAME = "voronoi_poles"
SCALE_NEIGHBOURS = 5
"""The nearest-neighbour scale of a point is its mean distance to so many others."""


def voronoi_poles(points_mm: Float64Array, options: NormalOptions, tell: Tell = tell_nobody) -> NormalField:
    """Normals of (n, 3) along p⁺ - p, p⁺ being the farthest Voronoi vertex of p's cell (Amenta and Bern 1999).

    The predicted error is the nearest-neighbour scale over the distance of the pole, to which the proven bound is
    proportional.
    """
    balls = largest_balls(points_mm)
    return field_of_balls(NAME, balls, nearest_scale_mm(points_mm), options.max_error_rad)


def nearest_scale_mm(points_mm: Float64Array) -> Float64Array:
    """Mean distance in mm (n,) of each point (n, 3) to its five nearest others; fewer where the cloud has fewer."""
    count = min(SCALE_NEIGHBOURS + 1, len(points_mm))
    distance = np.asarray(cKDTree(points_mm).query(points_mm, k=np.arange(1, count + 1))[0])
    return np.asarray(distance[:, 1:].mean(axis=1))


def field_of_balls(
    name: str,
    balls: LargestBalls,
    scale_mm: Float64Array,
    max_error_rad: float,
    reason: NormalReason = NormalReason.NO_CELL,
    notes: tuple[str, ...] = (),
) -> NormalField:
    """The normals that balls give, refused where there is none for `reason` or the predicted error is too large."""
    unknown = ~np.isfinite(balls.direction).all(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(unknown, np.nan, scale_mm / balls.radius_mm)
    reasons = np.full(len(scale_mm), NormalReason.GIVEN, dtype=np.uint8)
    reasons[~(error <= max_error_rad)] = NormalReason.UNCERTAIN
    reasons[unknown] = reason
    normals = np.where((reasons == NormalReason.GIVEN)[:, None], balls.direction, np.nan)
    nobody = np.zeros(len(scale_mm), dtype=np.int64)
    return NormalField(name, normals, reasons, error, balls.radius_mm.copy(), nobody, notes)
