"""Which listed shadow hides a place where hidden space begins; knows regions and places only."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.region import RescanRegion
from scanner_service.rescan.stations import IntArray

_ALONG = (0.1, 0.3, 0.5, 0.7, 0.9)  # of the way from the rim of a shadow to its foot
_BESIDE = 2.0  # cells: how far from its ribbon what a shadow hides begins at least
_BULGE = 0.3  # of the way from rim to foot: how far it may


def hidden_by(regions: Sequence[RescanRegion], places_mm: Float64Array, cell_mm: float) -> IntArray:
    """(n,) number of the shadow on whose ribbon each place (n, 3) lies, of some the nearest; 0 for none."""
    ribbons = [(one.number, _places_on(one)) for one in regions if one.reason is Reason.SHADOW]
    number = np.repeat([one for one, _ in ribbons], [len(places) for _, places in ribbons]).astype(np.int64)
    if not len(number) or not len(places_mm):
        return np.zeros(len(places_mm), dtype=np.int64)
    places = np.concatenate([places for _, places in ribbons])
    within = np.append(np.maximum(_BESIDE * cell_mm, _BULGE * places[:, 3]), 0.0)
    away, nearest = cKDTree(places[:, :3]).query(places_mm, distance_upper_bound=float(within.max()))
    return np.where(away <= within[nearest], np.append(number, 0)[nearest], 0)


def _places_on(region: RescanRegion) -> Float64Array:
    """Places on the straight surface of a shadow, and how far it is there from rim to foot, (k, 4), mm.

    A shadow's outline is its rim and, the other way round, its foot: one loop, or two when the rim is a ring.
    """
    if not region.outline_mm:
        return np.zeros((0, 4))
    if len(region.outline_mm) == 1:
        rim, foot = np.array_split(region.outline_mm[0], 2)
    else:
        rim, foot = region.outline_mm[:2]
    count = min(len(rim), len(foot))
    rim, foot = rim[:count], foot[::-1][:count]
    length = np.linalg.norm(foot - rim, axis=1)
    return np.concatenate([np.column_stack([rim + share * (foot - rim), length]) for share in _ALONG])
