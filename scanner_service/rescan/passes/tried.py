"""Places that passes were to serve and did not; knows no surface and no rig."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array, read_only
from scanner_service.rescan.passes.needs import Needs

TRIES = 3
"""So often a place is promised before it is given up."""
LOWERED = 0.25
"""What a pass in vain leaves of the chance that a place is what it seems."""


@dataclass(frozen=True, slots=True)
class Tried:
    """Places (n, 3) of each pass that were to be served and were not: each pass makes the next promise smaller."""

    missed_mm: tuple[Float64Array, ...] = ()

    def __post_init__(self) -> None:
        for places_mm in self.missed_mm:
            read_only(places_mm)

    @classmethod
    def nothing(cls) -> "Tried":
        """Before the first pass."""
        return cls()

    def and_also(self, places_mm: Float64Array) -> "Tried":
        """With the places of one more pass."""
        return Tried((*self.missed_mm, places_mm)) if len(places_mm) else self

    def times(self, places_mm: Float64Array, within_mm: float) -> Float64Array:
        """(n,) how many passes missed each place, or one at most `within_mm` from it."""
        times = np.zeros(len(places_mm))
        if len(places_mm):
            for missed_mm in self.missed_mm:
                away_mm, _ = cKDTree(missed_mm).query(places_mm, distance_upper_bound=within_mm)
                times += np.isfinite(away_mm)
        return times

    def of(self, needs: Needs, cell_mm: float) -> tuple[Needs, Needs]:
        """The needs with smaller chances where passes were in vain, and those that are given up."""
        times = self.times(needs.places_mm, 0.8 * cell_mm)
        given_up = times >= TRIES
        lowered = needs.changed(chance=needs.chance * LOWERED**times)
        return lowered.only(~given_up), needs.only(given_up)
