"""Normals of noisy clouds from big Delaunay balls, which lie clear of the surface on either side; knows no plane."""

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.normals.delaunay_balls import LargestBalls, largest_balls
from scanner_service.analysis.normals.field import NormalField, NormalOptions, NormalReason, Tell, tell_nobody
from scanner_service.analysis.normals.voronoi_poles import field_of_balls, nearest_scale_mm

NAME = "big_delaunay_balls"
BALL_FACTOR = 2.5
LENDERS = 200
"""A point deep in the noise borrows from the nearest point with a big ball, sought among so many neighbours."""


def big_delaunay_balls(points_mm: Float64Array, options: NormalOptions, tell: Tell = tell_nobody) -> NormalField:
    """Normals of (n, 3) towards the farthest Voronoi vertex whose dual Delaunay ball is big (Dey and Goswami 2004).

    A ball is big when its radius is larger than `ball_factor` (BALL_FACTOR) times the nearest-neighbour scale of the
    point, its mean distance to five others. Noise fills the space near the surface with small balls, so that points
    deep in it touch no big one: they take the direction of the nearest point that does, as the notes count.
    """
    factor = BALL_FACTOR if options.ball_factor is None else options.ball_factor
    balls = largest_balls(points_mm)
    scale_mm = nearest_scale_mm(points_mm)
    has_cell = np.isfinite(balls.direction).all(axis=1)
    with np.errstate(invalid="ignore"):
        is_big = has_cell & (balls.radius_mm > factor * scale_mm)
    direction, radius_mm = balls.direction.copy(), balls.radius_mm.copy()
    direction[~is_big], radius_mm[~is_big] = np.nan, np.nan
    poor = np.flatnonzero(~is_big)
    lent = 0
    if len(poor) and is_big.any():
        rich = np.flatnonzero(is_big)
        found = cKDTree(points_mm[rich]).query(points_mm[poor], k=[1])
        distance, which = np.asarray(found[0])[:, 0], np.asarray(found[1])[:, 0]
        reach = np.asarray(cKDTree(points_mm).query(points_mm[poor], k=[min(LENDERS, len(points_mm))])[0])[:, 0]
        near = distance <= reach
        direction[poor[near]] = balls.direction[rich[which[near]]]
        radius_mm[poor[near]] = balls.radius_mm[rich[which[near]]]
        lent = int(near.sum())
    notes = (f"{lent} of {len(points_mm)} points touch no big ball and take the direction of their nearest that does",)
    lending = LargestBalls(direction, radius_mm)
    return field_of_balls(
        NAME, lending, scale_mm, options.max_error_rad, NormalReason.NO_BIG_BALL, notes if lent else ()
    )
