"""The analyst's own copy of the live map, renewed by what changed; knows no verdict.

A snapshot of the whole map holds the engine up for as long as it takes to describe every point. Here the engine
describes only the points that changed since the copy was made; the rest of the work is done on the analyst's thread.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.snapshot import Int32Array, LineTable, MapSnapshot

_MOST_KEPT = 100_000  # rows


@dataclass(frozen=True, slots=True)
class Difference:
    """What changed of a map: `rows` (m,) and what the map says of them; all rows where `is_whole`."""

    total: int
    rows: Int32Array
    points: MapSnapshot
    is_whole: bool


def difference_since(live_map: LiveMap, version: int) -> Difference:
    """What changed after a version of the map, evaluated to the last line taken in; on the engine's thread."""
    live_map.refresh()
    rows = live_map.changed_since(version) if version > 0 else None
    if rows is None:
        whole = np.arange(len(live_map), dtype=np.int32)
        return Difference(len(live_map), whole, live_map.rows(whole), is_whole=True)
    return Difference(len(live_map), rows, live_map.rows(rows), is_whole=False)


class Mirror:
    """A copy of one live map; one thread owns it.

    What changed is kept until somebody asks for the map, or until it is worth a quarter of the map: then all of it is
    put in place at once, so that copying costs the same a point however large the map is.
    """

    def __init__(self) -> None:
        self.version = 0
        self._snapshot: MapSnapshot | None = None
        self._kept: list[Difference] = []

    def keep(self, change: Difference) -> None:
        """Take in what changed since `version`."""
        if change.is_whole:
            self._snapshot, self._kept = change.points, []
        elif len(change.rows) or change.points.version != self.version:
            self._kept.append(change)
            if sum(len(kept.rows) for kept in self._kept) > max(_MOST_KEPT, change.total // 4):
                self._put_in_place()
        self.version = change.points.version

    def apply(self, change: Difference) -> MapSnapshot:
        """Take in what changed; the whole map as it is now, frozen. What was given before stays as it was."""
        self.keep(change)
        return self._put_in_place()

    def _put_in_place(self) -> MapSnapshot:
        """The map with everything that was kept."""
        old, kept = self._snapshot, self._kept
        if kept:
            last = kept[-1]
            renewed = {}
            for item in fields(MapSnapshot):
                part = getattr(last.points, item.name)
                if isinstance(part, LineTable) or not isinstance(part, np.ndarray) or item.name == "origin_mm":
                    renewed[item.name] = part
                    continue
                whole = np.empty((last.total, *part.shape[1:]), dtype=part.dtype)
                if old is not None:
                    before = getattr(old, item.name)
                    whole[: len(before)] = before
                for change in kept:
                    whole[change.rows] = getattr(change.points, item.name)
                renewed[item.name] = whole
            self._snapshot, self._kept = replace(last.points, **renewed), []
        assert self._snapshot is not None
        return self._snapshot
