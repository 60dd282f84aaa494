"""What one client of the live stream has been told of rescan regions, and what is new to it; knows no socket."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from scanner_service.rescan.region import RescanRegion


class RegionsTold:
    """The regions as one client knows them: a long list is not sent again because one of them has grown."""

    def __init__(self) -> None:
        self._told: dict[int, tuple[object, ...]] = {}

    def news(self, regions: Sequence[RescanRegion]) -> dict[str, Any]:
        """The order in which the regions stand, by id, and those that the client does not know as they are now."""
        looks = {region.region_id: _look(region) for region in regions}
        changed = [region for region in regions if self._told.get(region.region_id) != looks[region.region_id]]
        self._told = looks
        return {"order": list(looks), "regions": [region.to_dict() for region in changed]}


def _look(region: RescanRegion) -> tuple[object, ...]:
    """Everything that is told of a region but its place in the list; equal when there is nothing new to tell."""
    numbers = (
        region.area_mm2,
        region.priority,
        region.confidence,
        region.measured_per_mm2,
        region.required_per_mm2,
        region.counting_error_per_mm2,
        region.line_spacing_mm,
    )
    return (
        region.status,
        region.reason,
        region.remedy,
        region.point_count,
        region.limit,
        region.history,
        np.array([*numbers, *region.centroid_mm, *region.normal]).tobytes(),  # as bytes an unknown number equals itself
        *(loop.tobytes() for loop in region.outline_mm),
    )
