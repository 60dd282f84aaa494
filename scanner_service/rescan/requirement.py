"""What a scan must reach before it is called good; knows numbers only, no points and no map."""

from dataclasses import dataclass
from math import isfinite, pi

import numpy as np

from drivers.scanline import Float64Array

_LEAST_AREA_MM2 = 1.0


class RequirementUnusable(ValueError):
    """A requirement that no scan could be judged by; the message names the field, its value and what it must be."""


@dataclass(frozen=True, slots=True)
class Requirement:
    """The target a surface is judged by.

    `density_per_mm2` is the required density; None means `density_share` of the nominal density 1 / (Δs·δp) of each
    scanline. `radius_constant_mm` is c of Eq. 6.3. `noise_factor` times the sensor's noise is the largest noise
    accepted. `region_points` is the least number of points of a region, `region_area_mm2` its least area (None: 1 mm²,
    or the disc of one neighbourhood, π r², where that is larger: what is smaller no neighbourhood can tell), and
    `region_angle_deg` the largest angle between normals of neighbouring points of one region. `search_mm` bounds the
    search for the adjacent scanline (None: the larger of 20·c and 3·r).
    """

    density_per_mm2: float | None = None
    density_share: float = 0.5
    radius_constant_mm: float = 0.1
    noise_factor: float = 3.0
    region_points: int = 10
    region_area_mm2: float | None = None
    region_angle_deg: float = 45.0
    search_mm: float | None = None

    def __post_init__(self) -> None:
        for name in ("density_per_mm2", "search_mm"):
            value = getattr(self, name)
            if value is not None and not (isfinite(value) and value > 0):
                raise RequirementUnusable(f"{name} must be greater than 0, or left out for the default, not {value}")
        if not 0 < self.density_share <= 1:
            raise RequirementUnusable(f"density_share must be above 0 and at most 1, not {self.density_share}")
        if not (isfinite(self.radius_constant_mm) and self.radius_constant_mm > 0):
            raise RequirementUnusable(f"radius_constant_mm must be greater than 0 mm, not {self.radius_constant_mm}")
        if not (isfinite(self.noise_factor) and self.noise_factor >= 1):
            raise RequirementUnusable(f"noise_factor must be at least 1, not {self.noise_factor}")
        if self.region_area_mm2 is not None and not (isfinite(self.region_area_mm2) and self.region_area_mm2 >= 0):
            raise RequirementUnusable(f"region_area_mm2 must be 0 mm² or more, not {self.region_area_mm2}")
        if self.region_points < 1:
            raise RequirementUnusable(f"region_points must be at least 1, not {self.region_points}")
        if not 0 < self.region_angle_deg <= 180:
            raise RequirementUnusable(f"region_angle_deg must be above 0 and at most 180, not {self.region_angle_deg}")

    def least_area_mm2(self, radius_mm: float) -> float:
        """Least area of a region in a map whose neighbourhoods have the given radius."""
        if self.region_area_mm2 is not None:
            return self.region_area_mm2
        return max(_LEAST_AREA_MM2, pi * radius_mm**2)

    def per_mm2(self, line_spacing_mm: Float64Array, point_spacing_mm: Float64Array) -> Float64Array:
        """Required density of scanlines of the given spacings, same shape; NaN where a spacing is unknown."""
        nominal: Float64Array = 1.0 / (line_spacing_mm * point_spacing_mm)
        if self.density_per_mm2 is None:
            return self.density_share * nominal
        return np.full_like(nominal, self.density_per_mm2)
