"""Whether the points of a pass lie where the surface known before it says that they should; judges no density.

A pass that was carried out on a part that lies otherwise than was said puts good points in wrong places. Its rays tell:
they were to end on surface that is known, and did not.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.known_surface import KnownSurface
from scanner_service.rescan.passes.marching import first_known
from scanner_service.rescan.passes.reach import PartTurn

WITHIN_CELLS = 1.5
"""A point this near to known surface lies on it."""
LEAST_SHARE = 0.9
"""Below this share of points where they should be, a pass is doubted."""
LEAST_POINTS = 200
"""Fewer points that should lie on known surface say nothing."""
_MAX_POINTS = 20_000
_STRAIGHT = 0.5  # cells: a ray that passes what is known at this distance does not graze it


@dataclass(frozen=True, slots=True)
class Agreement:
    """Of the points of a pass that should lie on surface known before, within `within_mm`, how many do.

    `expected` counts the points whose rays known surface stops, and those that hang where earlier rays found nothing.
    """

    expected: int
    found: int
    within_mm: float

    @property
    def share(self) -> float:
        """Of the points that should be on known surface; NaN when there are none."""
        return self.found / self.expected if self.expected else math.nan

    @property
    def is_doubtful(self) -> bool:
        """True when the pass lies elsewhere than it says."""
        return self.expected >= LEAST_POINTS and self.share < LEAST_SHARE

    def doubt(self, turn: PartTurn | None) -> str | None:
        """What an operator is told of a pass that lies elsewhere than it says; None of one that does not."""
        if not self.is_doubtful:
            return None
        asked = (
            f"does the part lie otherwise than the pass asked ({turn})?"
            if turn is not None and not turn.is_none
            else "was the part moved, or the scanner held otherwise than the pass says?"
        )
        return (
            f"only {self.share:.0%} of the points that should lie on surface known before are within "
            f"{self.within_mm:.1f} mm of it: {asked}"
        )

    def to_dict(self) -> dict[str, object]:
        """For JSON; a share of nothing is null."""
        share = self.share if self.expected else None
        return {
            "expected_points": self.expected,
            "found_points": self.found,
            "share": share,
            "within_mm": self.within_mm,
            "is_doubtful": self.is_doubtful,
        }

    @classmethod
    def from_dict(cls, kept: Mapping[str, Any]) -> "Agreement":
        """As `to_dict` told it; raises KeyError, TypeError, ValueError when it was not told so."""
        return cls(int(kept["expected_points"]), int(kept["found_points"]), float(kept["within_mm"]))


def agreement_of(surface: KnownSurface, after: MapSnapshot, passes: npt.ArrayLike) -> Agreement:
    """How well the points of some passes of a later map lie on what was known.

    Parameters
    ----------
    surface : as it was known before the passes, its hidden space not looked into.
    after : the map with them.
    passes : their numbers in the map.
    """
    within_mm = WITHIN_CELLS * surface.cell_mm
    mine = np.flatnonzero(np.isin(after.lines.pass_number[after.line], passes) & (after.neighbours > 0))
    if not (len(mine) and len(surface.points_mm)):
        return Agreement(0, 0, within_mm)
    mine = mine[:: math.ceil(len(mine) / _MAX_POINTS)]
    points = after.points_mm[mine]
    stops, in_air = _stopped(surface, after.lines.laser_mm[after.line[mine]], points)
    away, _ = cKDTree(surface.points_mm).query(points, distance_upper_bound=within_mm)
    is_on = np.isfinite(away)
    return Agreement(int((stops | (in_air & ~is_on)).sum()), int((stops & is_on).sum()), within_mm)


def _stopped(
    surface: KnownSurface, lasers_mm: Float64Array, points_mm: Float64Array
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """(n,) whether known surface is the first thing on a point's ray, and whether the point hangs in free space."""
    way = points_mm - lasers_mm
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    high = surface.low_mm + surface.cell_mm * np.array(surface.state.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(surface.low_mm - lasers_mm) / way, (high - lasers_mm) / way])
    enters = np.maximum(np.nanmax(ends.min(axis=0), axis=1), 0.0) + 1e-6
    leaves = np.nanmin(ends.max(axis=0), axis=1) - 1e-6
    keys = surface.keys(surface.points_mm)
    order = np.argsort(keys)
    first = np.full(len(points_mm), -1, dtype=np.int64)
    in_air = np.zeros(len(points_mm), dtype=np.bool_)
    first_known(
        surface.state, surface.low_mm, surface.cell_mm, lasers_mm, way, enters, leaves, points_mm, first, in_air
    )
    at = np.minimum(np.searchsorted(keys[order], first), len(keys) - 1)
    known = surface.points_mm[order[at]]
    past = known - lasers_mm
    aside = np.linalg.norm(past - np.einsum("ij,ij->i", past, way)[:, None] * way, axis=1)
    return (first >= 0) & (aside <= _STRAIGHT * surface.cell_mm), in_air
