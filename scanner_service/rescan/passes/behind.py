"""What lies behind the border of hidden space, seen from where it is faced best; knows no passes.

Hidden space that a look would leave again after a short way is the rest of a shadow, and rarely begins with surface;
where known surface stops the way, or where it goes on for long, the part is in it.
"""

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array
from scanner_service.rescan.passes.known_surface import KnownSurface
from scanner_service.rescan.passes.marching import HIDDEN
from scanner_service.rescan.passes.needs import HIDDEN_KINDS, Evidence, Needs
from scanner_service.rescan.passes.sights import follow_hidden
from scanner_service.rescan.passes.visibility import OpenSky

WEIGHED_KINDS = (Evidence.BEYOND, Evidence.FAR, Evidence.REST)
"""Hidden space that is explored; beside known surface it begins with surface whatever lies behind."""

_ASKEW, _FACED = 0.5, 0.9  # cosine at which the rig faces hidden space best: little of it is seen, or all
_LEAST_FACED = 0.25
_ONE_WAY = 0.1  # length of the mean of directions that go somewhere
_AWAY, _ACROSS = -0.275, -0.05  # cosine to where the rig lights from: a border faces away from it, and not any more
_LEAST_AWAY, _LEAST_BESIDE = 0.1, 0.3  # ... then this little is left of it, and beside known surface

THIN_MM = 4.5
"""A way through the margin below the outermost points is up to this long, and no surface is in it."""
THICK_MM = 8.0
"""From this way on hidden space is as likely to begin with surface as it ever is without known surface behind."""
_RESTS = 0.1
_DEEP = 0.7


def weighed(surface: KnownSurface, needs: Needs, sky: OpenSky, may_light: BoolArray) -> Needs:
    """The needs, hidden space with less chance where there is little behind.

    Parameters
    ----------
    sky : the open sky of each need.
    may_light : (d,) from which of the sky's directions the rig can light the part.
    """
    hidden = np.isin(needs.evidence, HIDDEN_KINDS)
    hidden &= surface.state.reshape(-1)[surface.keys(needs.places_mm)] == HIDDEN
    rows = np.flatnonzero(hidden)
    if not len(rows) or not may_light.any():
        return needs
    facing = needs.normals[rows] @ sky.directions.T
    facing[~(sky.open[rows] & may_light)] = -1.0
    best = facing.argmax(axis=1)
    lit = facing[np.arange(len(rows)), best] > 0
    rows, best = rows[lit], best[lit]
    length, stopped = ways_behind(surface, needs.places_mm[rows], -sky.directions[best])
    share = np.clip((length - THIN_MM) / (THICK_MM - THIN_MM), 0.0, 1.0)
    chance = needs.chance.copy()
    explored = np.isin(needs.evidence[rows], WEIGHED_KINDS)
    chance[rows] *= np.where(explored & ~stopped, _RESTS + (_DEEP - _RESTS) * share, 1.0)
    chance[rows] *= _between(facing[lit, best], _ASKEW, _FACED, _LEAST_FACED)
    away = needs.normals[rows] @ _middle(sky.directions[may_light])
    least = np.where(explored, _LEAST_AWAY, _LEAST_BESIDE)
    chance[rows] *= np.where(stopped, 1.0, np.maximum(_between(away, _AWAY, _ACROSS, 0.0), least))
    return needs.changed(chance=chance)


def weighed_like(every: Needs, drawn: Needs, now: Needs) -> Needs:
    """All needs, hidden space with as much less chance as the nearest of its kind that was `drawn` has `now`."""
    chance = every.chance.copy()
    for kind in HIDDEN_KINDS:
        rows, some = np.flatnonzero(every.evidence == kind), np.flatnonzero(drawn.evidence == kind)
        if len(rows) and len(some):
            _, nearest = cKDTree(drawn.places_mm[some]).query(every.places_mm[rows])
            before = drawn.chance[some]
            less = np.divide(now.chance[some], before, out=np.ones(len(some)), where=before > 0)  # none has no less
            chance[rows] *= less[nearest]
    return every.changed(chance=chance)


def _middle(directions: Float64Array) -> Float64Array:
    """The middle (3,) of unit directions (d, 3); of length 0 when they point everywhere."""
    mean = directions.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return np.asarray(mean / length if length > _ONE_WAY else np.zeros(3), dtype=np.float64)


def _between(value: Float64Array, low: float, high: float, least: float) -> Float64Array:
    """(n,) rising from `least` at `low` to 1 at `high`."""
    return np.asarray(least + (1.0 - least) * np.clip((value - low) / (high - low), 0.0, 1.0), dtype=np.float64)


def ways_behind(surface: KnownSurface, places_mm: Float64Array, ways: Float64Array) -> tuple[Float64Array, BoolArray]:
    """How far hidden space goes on behind places (n, 3) along unit `ways` (n, 3): mm (n,), and what ends it (n,).

    True: the back of known surface, so that the part lies between. False: its front, empty space, the end of the grid.
    """
    length, stopped = np.zeros(len(places_mm)), np.zeros(len(places_mm), dtype=np.bool_)
    grid = (surface.state, surface.row, surface.normals, surface.two_sided, surface.low_mm, surface.cell_mm)
    follow_hidden(*grid, places_mm, ways, length, stopped)
    return length, stopped
