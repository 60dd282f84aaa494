"""From the map's records to what a reader gets: units, NaN for what is not known, derived quantities."""

import math
from dataclasses import dataclass

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.analysis.intake import QUANTUM_MM
from scanner_service.analysis.points import NOT_COUNTED, PointArray, used_radius_mm
from scanner_service.analysis.snapshot import Int32Array, LineTable, MapSnapshot, RadiusRule


def describe(
    points: PointArray,
    *,
    version: int,
    origin_mm: Float64Array,
    place: Int32Array,
    lines: LineTable,
    noise_mm: float,
    max_radius_mm: float,
) -> MapSnapshot:
    """The snapshot of records (n,) that lie at the places (n,) of their scanlines."""
    radius = used_radius_mm(points, max_radius_mm)
    neighbours = np.ascontiguousarray(points["neighbours"])
    unreliable = np.ascontiguousarray(points["unreliable"])
    counted = unreliable != NOT_COUNTED
    settled = points["open_passes"] == 0
    normals = np.column_stack([points["nx"], points["ny"], points["nz"]]).astype(np.float64)
    normals /= np.sqrt((normals * normals).sum(axis=1, keepdims=True))
    smallest = points["smallest_mm2"].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        residual = np.sqrt(np.where(neighbours > 3, smallest / (neighbours - 3.0), np.nan))
        error = np.fmax(residual, noise_mm) / np.sqrt(points["middle_mm2"].astype(np.float64))
    return MapSnapshot(
        version=version,
        origin_mm=origin_mm.copy(),
        points_mm=origin_mm + np.column_stack([points["x"], points["y"], points["z"]]) * QUANTUM_MM,
        line=np.ascontiguousarray(points["line"]),
        index=place,
        radius_mm=radius,
        radius_rule=np.where(points["growth"] > 0, np.uint8(RadiusRule.GROWN), points["rule"]),
        neighbours=neighbours,
        same_side=neighbours - points["other_side"],
        density_per_mm2=neighbours / (math.pi * radius * radius),
        normals=normals,
        unreliable=unreliable,
        settled=settled,
        isolated=settled & (neighbours <= 3) & counted,
        offset=np.sqrt(points["offset_sq"].astype(np.float64)),
        residual_mm=residual,
        normal_error_rad=np.where(np.isfinite(error) & (neighbours > 3), error, np.nan),
        lines=lines,
    )


@dataclass(frozen=True, slots=True)
class Records:
    """Rows (m,) copied out of a map at one version, to be described by whoever has the time; see `describe`."""

    points: PointArray
    place: Int32Array
    version: int
    origin_mm: Float64Array
    lines: LineTable
    noise_mm: float
    max_radius_mm: float

    def describe(self) -> MapSnapshot:
        """What the map says of them."""
        return describe(
            self.points,
            version=self.version,
            origin_mm=self.origin_mm,
            place=self.place,
            lines=self.lines,
            noise_mm=self.noise_mm,
            max_radius_mm=self.max_radius_mm,
        )
