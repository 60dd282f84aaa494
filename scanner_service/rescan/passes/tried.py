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
    """Places (n, 3) that passes were to serve and did not: each try makes the next promise smaller."""

    places_mm: Float64Array

    def __post_init__(self) -> None:
        read_only(self.places_mm)

    @classmethod
    def nothing(cls) -> "Tried":
        """Before the first pass."""
        return cls(np.zeros((0, 3)))

    def and_also(self, places_mm: Float64Array) -> "Tried":
        """With the places of one more pass."""
        return Tried(np.concatenate([self.places_mm, places_mm]))

    def times(self, places_mm: Float64Array, within_mm: float) -> Float64Array:
        """(n,) how often each place was tried."""
        if not len(self.places_mm) or not len(places_mm):
            return np.zeros(len(places_mm))
        found = cKDTree(self.places_mm).query_ball_point(places_mm, within_mm, return_length=True)
        return np.asarray(found, dtype=np.float64)

    def of(self, needs: Needs, cell_mm: float) -> tuple[Needs, Needs]:
        """The needs with smaller chances where passes were in vain, and those that are given up."""
        times = self.times(needs.places_mm, 0.8 * cell_mm)
        given_up = times >= TRIES
        lowered = needs.changed(chance=needs.chance * LOWERED**times)
        return lowered.only(~given_up), needs.only(given_up)
