"""How much of the surface seen meets the requirement, and the density map; knows no reference surface.

Space is cut into cubes of one side. Each judged point stands for the surface between it and its neighbours, Δs'·δp
(half of each strip beside it), so that a cell's area is the area of the surface in it, at any tilt. Where several
passes see the same cell it is the mean of theirs, weighted by themselves, since a pass that only touches the cell says
little. Without a reference surface this is *observed* coverage: what nobody saw, and no gap betrays, is not in it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import MapSnapshot, UInt8Array
from scanner_service.rescan.columns import Columns
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.regions import RegionReport
from scanner_service.rescan.stations import IntArray

Int32Array = npt.NDArray[np.int32]

_FAR = 2**20 - 2  # cells are counted this far from the first point
_NO_CELLS: dict[str, Any] = {
    "centre_mm": np.zeros((0, 3)),
    "area_mm2": np.zeros(0),
    "density_per_mm2": np.zeros(0),
    "required_per_mm2": np.zeros(0),
    "reason": np.zeros(0, np.uint8),
    "meets": np.zeros(0, bool),
}


@dataclass(frozen=True, slots=True)
class Coverage:
    """Observed coverage and the density map; one row a cell, cells of `cell_mm` side touched by judged points.

    `centre_mm` (c, 3) is the mean of the cell's points, `area_mm2` (c,) its surface, `density_per_mm2` the mean
    border-aware density, `required_per_mm2` the mean requirement, `reason` the verdict that most of its
    surface has, `meets` whether most of its surface meets the requirement (the ends of a shadow do: what lacks is the
    gap beside them), `points` how many. `gap_mm2` is the area of the bounded gaps
    (shadows) that were found. `share` = area that meets / (all area + gaps), NaN when nothing with an area is judged.
    """

    cell_mm: float
    centre_mm: Float64Array
    area_mm2: Float64Array
    density_per_mm2: Float64Array
    required_per_mm2: Float64Array
    reason: UInt8Array
    meets: BoolArray
    points: Int32Array
    gap_mm2: float
    share: float

    def __post_init__(self) -> None:
        for name in ("centre_mm", "area_mm2", "density_per_mm2", "required_per_mm2", "reason", "meets", "points"):
            read_only(getattr(self, name))

    def __len__(self) -> int:
        return len(self.area_mm2)

    def to_dict(self) -> dict[str, object]:
        """For JSON: plain numbers and lists, None for a share that is unknown."""
        return {
            "kind": "observed",
            "share": None if np.isnan(self.share) else self.share,
            "cell_mm": None if np.isnan(self.cell_mm) else self.cell_mm,
            "touched_mm2": float(self.area_mm2.sum()),
            "gap_mm2": self.gap_mm2,
            "cells": {
                "centre_mm": self.centre_mm.tolist(),
                "area_mm2": self.area_mm2.tolist(),
                "density_per_mm2": self.density_per_mm2.tolist(),
                "required_per_mm2": self.required_per_mm2.tolist(),
                "reason": [Reason(value).label for value in self.reason.tolist()],
                "meets": self.meets.tolist(),
                "points": self.points.tolist(),
            },
        }


def observed_coverage(snapshot: MapSnapshot, report: RegionReport, cell_mm: float | None = None) -> Coverage:
    """Coverage and density map of a report; cells of side `cell_mm`, by default the median radius of the points.

    Where a map is wider than a million cells they are twice as large, or four times: as large as that takes.

    Raises
    ------
    ValueError : when the cell's side is not a positive finite number.
    """
    return CoverageBook(cell_mm).renew(snapshot, report)


class CoverageBook:
    """Coverage of one map that grows: cells whose points are judged as they were are not looked at again."""

    def __init__(self, cell_mm: float | None = None) -> None:
        if cell_mm is not None and not (np.isfinite(cell_mm) and cell_mm > 0):
            raise ValueError(f"cell_mm must be greater than 0 mm, not {cell_mm}")
        self._asked_mm = cell_mm
        self._forget(float("nan"))

    def _forget(self, side_mm: float, extent_mm: float = 0.0) -> None:
        self._side_mm, self._extent_mm = side_mm, extent_mm
        self._points, self._cells = Columns(), Columns()
        self._known = np.zeros(0, dtype=np.int64)  # keys of the cells, rising, and their rows
        self._row = np.zeros(0, dtype=np.int64)
        self._count = 0

    def renew(self, snapshot: MapSnapshot, report: RegionReport, renewed: IntArray | None = None) -> Coverage:
        """Coverage of a report; `renewed` (k,) are the rows that were measured or judged again, None: all were."""
        judged = report.judgement.judged
        side = self._asked_mm
        if side is None:
            side = float(np.median(report.spacings.reach_mm[judged])) if judged.any() else float("nan")
        if renewed is None or len(snapshot) < self._count:
            self._forget(side)
        self._extent_mm = max(self._extent_mm, _extent_mm(snapshot, self._count))
        while np.isfinite(side) and self._extent_mm >= _FAR * side:
            side *= 2.0
        if renewed is None or side != self._side_mm:
            self._forget(side, self._extent_mm)
            renewed = np.arange(len(snapshot), dtype=np.int64)
        if np.isfinite(side):
            self._enter(snapshot, side)
            self._measure(snapshot, report, renewed)
        by_place = self._row[self._cells.view("points", len(self._row))[self._row] > 0] if self._count else self._row
        kept = self._cells.copies("cell", by_place) if len(by_place) else _NO_CELLS
        area, meets = kept["area_mm2"], kept["meets"]
        points = self._cells.view("points", len(self._row))[by_place] if len(by_place) else np.zeros(0, np.int32)
        whole = float(area.sum()) + report.gap_mm2
        share = float(area[meets].sum()) / whole if whole > 0 and len(area) else float("nan")
        return Coverage(cell_mm=side, **kept, points=points, gap_mm2=report.gap_mm2, share=share)

    def _enter(self, snapshot: MapSnapshot, side_mm: float) -> None:
        """Find the cells of the points that are new; points never move."""
        fresh = np.arange(self._count, len(snapshot), dtype=np.int64)
        cube = np.floor(snapshot.points_mm[fresh] / side_mm).astype(np.int64)
        cube -= np.floor(snapshot.points_mm[:1] / side_mm).astype(np.int64)
        key = ((cube[:, 0] + _FAR) << 42) | ((cube[:, 1] + _FAR) << 21) | (cube[:, 2] + _FAR)
        place = np.searchsorted(self._known, key)
        is_new = np.ones(len(key), dtype=bool)
        inside = place < len(self._known)
        is_new[inside] = self._known[place[inside]] != key[inside]
        keys = np.unique(key[is_new])
        at = np.searchsorted(self._known, keys)
        self._row = np.insert(self._row, at, len(self._row) + np.arange(len(keys)))
        self._known = np.insert(self._known, at, keys)
        self._points.make_room(len(snapshot))
        self._points.put(
            fresh, cell=self._row[np.searchsorted(self._known, key)], reason=np.zeros(len(fresh), np.uint8)
        )
        self._cells.make_room(len(self._known))
        self._count = len(snapshot)

    def _measure(self, snapshot: MapSnapshot, report: RegionReport, renewed: IntArray) -> None:
        """Add up anew the cells of points that were renewed, or whose reason is another."""
        count, judgement = len(snapshot), report.judgement
        cell = self._points.view("cell", count)
        touched = np.zeros(len(self._row), dtype=bool)
        touched[cell[renewed]] = True
        touched[cell[self._points.view("reason", count) != report.reason]] = True
        self._points.put(slice(count), reason=report.reason)
        cells = np.flatnonzero(touched)
        rows = np.flatnonzero(touched[cell] & judgement.judged)
        place = np.zeros(len(touched), dtype=np.int64)
        place[cells] = np.arange(len(cells))
        own = place[cell[rows]]
        points = np.bincount(own, minlength=len(cells))

        def mean(values: Float64Array) -> Float64Array:
            total = np.bincount(own, weights=values, minlength=len(cells))
            average: Float64Array = total / np.maximum(points, 1)
            return average

        stands_for = _surface_of_points(report, rows)
        passes = int(report.spacings.group.max(initial=-1)) + 1
        by_pass = _added_up(own, report.spacings.group[rows], stands_for, len(cells), passes)
        votes = _added_up(own, report.reason[rows].astype(np.int64), stands_for, len(cells), len(Reason))
        self._cells.put(
            cells,
            **{
                "points": points.astype(np.int32),
                "cell.centre_mm": np.column_stack([mean(snapshot.points_mm[rows, k]) for k in range(3)]),
                "cell.area_mm2": (by_pass**2).sum(axis=1) / np.maximum(by_pass.sum(axis=1), 1e-300),
                "cell.density_per_mm2": mean(judgement.judged_per_mm2[rows]),
                "cell.required_per_mm2": mean(judgement.required_per_mm2[rows]),
                "cell.reason": votes.argmax(axis=1).astype(np.uint8),
                "cell.meets": votes[:, [Reason.NONE, Reason.SHADOW]].sum(axis=1) >= 0.5 * votes.sum(axis=1),
            },
        )


def _extent_mm(snapshot: MapSnapshot, first: int) -> float:
    """How far along an axis the points from a row on lie from the first of the map."""
    if first >= len(snapshot):
        return 0.0
    return float(np.abs(snapshot.points_mm[first:] - snapshot.points_mm[0]).max())


def _added_up(cell: IntArray, kind: IntArray, values: Float64Array, cells: int, kinds: int) -> Float64Array:
    """(cells, kinds) sums of values by cell and kind."""
    total = np.bincount(cell * kinds + kind, weights=values, minlength=cells * kinds)
    return np.asarray(total, dtype=np.float64).reshape(cells, kinds)


def _surface_of_points(report: RegionReport, rows: IntArray) -> Float64Array:
    """(k,) area each point stands for: half of each strip beside it by its spacing along the line.

    At a border of the part the one strip counts on both sides, where no strip is known the nominal line spacing.
    """
    strips = report.spacings
    width = report.judgement.width_mm[rows]
    known = np.isfinite(width).sum(axis=1)
    total = np.where(np.isfinite(width), width, 0.0).sum(axis=1)
    across = np.where(known > 0, total / np.maximum(known, 1), strips.line_spacing_mm[rows])
    along = strips.point_spacing_mm[rows]
    return across * np.where(np.isfinite(along), along, strips.nominal_point_spacing_mm[rows])
