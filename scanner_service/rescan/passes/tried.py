"""Places that passes were to serve and did not; knows no surface and no rig."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array, read_only
from scanner_service.rescan.passes.needs import HIDDEN_KINDS, Needs

TRIES = 3
"""So often a place is promised before it is given up."""
LOWERED = 0.25
"""What a pass in vain leaves of the chance that a place is what it seems."""
EMPTIED = 0.5
"""... and of the chance of hidden space around."""
_AROUND_MM = 2.0  # hidden space that goes on this near to where nothing was found


@dataclass(frozen=True, slots=True)
class Tried:
    """Places (n, 3) of each pass that were to be served and were not: each pass makes the next promise smaller.

    `missed_mm` are all of them; `empty_mm` those where hidden space was expected to begin with surface and nothing was
    found anywhere near: where it goes on behind them, less is expected too.
    """

    missed_mm: tuple[Float64Array, ...] = ()
    empty_mm: tuple[Float64Array, ...] = ()

    def __post_init__(self) -> None:
        for places_mm in (*self.missed_mm, *self.empty_mm):
            read_only(places_mm)

    @classmethod
    def nothing(cls) -> "Tried":
        """Before the first pass."""
        return cls()

    def and_also(self, missed_mm: Float64Array, empty_mm: Float64Array | None = None) -> "Tried":
        """With the places of one more pass."""
        empty = () if empty_mm is None or not len(empty_mm) else (empty_mm,)
        missed = (missed_mm,) if len(missed_mm) else ()
        return Tried((*self.missed_mm, *missed), (*self.empty_mm, *empty))

    def of(self, needs: Needs, cell_mm: float) -> tuple[Needs, Needs]:
        """The needs with smaller chances where passes were in vain, and those that are given up."""
        times = _times(self.missed_mm, needs.places_mm, 0.8 * cell_mm)
        given_up = times >= TRIES
        hidden = np.isin(needs.evidence, HIDDEN_KINDS)
        around = np.zeros(len(needs))
        around[hidden] = _times(self.empty_mm, needs.places_mm[hidden], _AROUND_MM)
        lowered = needs.changed(
            chance=needs.chance * np.minimum(LOWERED**times, EMPTIED ** np.minimum(around, TRIES - 1)),
            tried=(times > 0) | (around > 0),
        )
        return lowered.only(~given_up), needs.only(given_up)


def _times(passes_mm: tuple[Float64Array, ...], places_mm: Float64Array, within_mm: float) -> Float64Array:
    """(n,) how many passes missed each place, or one at most `within_mm` from it."""
    times = np.zeros(len(places_mm))
    if len(places_mm):
        for missed_mm in passes_mm:
            away_mm, _ = cKDTree(missed_mm).query(places_mm, distance_upper_bound=within_mm)
            times += np.isfinite(away_mm)
    return times
