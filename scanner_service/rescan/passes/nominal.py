"""Surface of the nominal part that no point has touched, as a plan serves it; knows no mesh and no rig."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.scanline import Float64Array, read_only
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.known_surface import IntArray
from scanner_service.rescan.reference import ReferenceCoverage
from scanner_service.rescan.region import RescanRegion


@dataclass(frozen=True, slots=True)
class Missing:
    """Surface of the nominal part that no point has touched: places and outward normals (n, 3), mm² of each (n,), and
    the number of the region (n,) each belongs to, 0 for none.
    """

    places_mm: Float64Array
    normals: Float64Array
    area_mm2: Float64Array
    region: IntArray

    def __post_init__(self) -> None:
        for name in self.__slots__:
            read_only(getattr(self, name))


def missing_of(coverage: ReferenceCoverage, regions: Sequence[RescanRegion]) -> Missing:
    """The untouched pieces of a nominal part; `regions` as they are followed, in whatever order."""
    numbers = {region.centroid_mm.tobytes(): region.number for region in regions if region.reason is Reason.UNTOUCHED}
    region = np.zeros(len(coverage.pieces.area_mm2), dtype=np.int64)
    for found, rows in zip(coverage.untouched, coverage.untouched_rows, strict=True):
        region[rows] = numbers.get(found.centroid_mm.tobytes(), 0)
    bare = ~coverage.touched
    pieces = coverage.pieces
    return Missing(
        pieces.points_mm[bare].copy(), pieces.normals[bare].copy(), pieces.area_mm2[bare].copy(), region[bare]
    )
