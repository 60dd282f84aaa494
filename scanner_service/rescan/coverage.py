"""How much of the surface seen meets the requirement, and the density map; knows no reference surface.

Space is cut into cubes of one side. Each judged point stands for the surface between it and its neighbours, Δs'·δp
(half of each strip beside it), so that a cell's area is the area of the surface in it, at any tilt. Where several
passes see the same cell it is the mean of theirs, weighted by themselves, since a pass that only touches the cell says
little. Without a reference surface this is *observed* coverage: what nobody saw, and no gap betrays, is not in it.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import MapSnapshot, UInt8Array
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.regions import RegionReport

Int32Array = npt.NDArray[np.int32]


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

    Raises
    ------
    ValueError : when the cell's side is not a positive finite number.
    """
    if cell_mm is not None and not (np.isfinite(cell_mm) and cell_mm > 0):
        raise ValueError(f"cell_mm must be greater than 0 mm, not {cell_mm}")
    judgement, strips = report.judgement, report.strips
    gap_mm2 = report.gap_mm2
    rows = np.flatnonzero(judgement.judged)
    if not len(rows):
        none = np.zeros(0)
        side = np.nan if cell_mm is None else cell_mm
        empty = (
            np.zeros((0, 3)),
            none,
            none.copy(),
            none.copy(),
            np.zeros(0, np.uint8),
            np.zeros(0, bool),
            np.zeros(0, np.int32),
        )
        return Coverage(side, *empty, gap_mm2, np.nan)
    side = float(np.median(strips.reach_mm[rows])) if cell_mm is None else cell_mm
    cube = np.floor(snapshot.points_mm[rows] / side).astype(np.int64)
    cube -= cube.min(axis=0)
    extent = cube.max(axis=0) + 1
    if float(np.prod(extent.astype(np.float64))) < 2.0**62:
        key = (cube[:, 0] * extent[1] + cube[:, 1]) * extent[2] + cube[:, 2]
        cell, count = np.unique(key, return_inverse=True, return_counts=True)[1:]
    else:
        cell, count = np.unique(cube, axis=0, return_inverse=True, return_counts=True)[1:]
    cell = cell.reshape(-1)
    cells = len(count)

    def mean(values: Float64Array) -> Float64Array:
        average: Float64Array = np.bincount(cell, weights=values, minlength=cells) / count
        return average

    stands_for = _surface_of_points(report)[rows]
    passes = int(strips.group.max()) + 1
    by_pass = np.bincount(cell * passes + strips.group[rows], weights=stands_for, minlength=cells * passes)
    by_pass = by_pass.reshape(cells, passes)
    area = (by_pass**2).sum(axis=1) / np.maximum(by_pass.sum(axis=1), 1e-300)
    verdicts = len(Reason)
    votes = np.bincount(cell * verdicts + report.reason[rows], weights=stands_for, minlength=cells * verdicts)
    votes = votes.reshape(cells, verdicts)
    meets = votes[:, [Reason.NONE, Reason.SHADOW]].sum(axis=1) >= 0.5 * votes.sum(axis=1)
    whole = float(area.sum()) + gap_mm2
    return Coverage(
        cell_mm=side,
        centre_mm=np.column_stack([mean(snapshot.points_mm[rows, k]) for k in range(3)]),
        area_mm2=area,
        density_per_mm2=mean(judgement.judged_per_mm2[rows]),
        required_per_mm2=mean(judgement.required_per_mm2[rows]),
        reason=votes.argmax(axis=1).astype(np.uint8),
        meets=meets,
        points=count.astype(np.int32),
        gap_mm2=gap_mm2,
        share=float(area[meets].sum()) / whole if whole > 0 else np.nan,
    )


def _surface_of_points(report: RegionReport) -> Float64Array:
    """(n,) area each point stands for: half of each strip beside it by its spacing along the line.

    At a border of the part the one strip counts on both sides, where no strip is known the nominal line spacing.
    """
    strips = report.strips
    width = report.judgement.width_mm
    known = np.isfinite(width).sum(axis=1)
    total = np.where(np.isfinite(width), width, 0.0).sum(axis=1)
    across = np.where(known > 0, total / np.maximum(known, 1), strips.line_spacing_mm)
    along = strips.point_spacing_mm
    return across * np.where(np.isfinite(along), along, strips.nominal_point_spacing_mm)
