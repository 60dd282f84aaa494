"""What a scan must reach before it is called good; knows numbers only, no points and no map."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import degrees, isfinite, pi
from typing import Any

import numpy as np

from drivers.scanline import Float64Array

_LEAST_AREA_MM2 = 1.0


class RequirementUnusable(ValueError):
    """A requirement that no scan could be judged by; the message names the field, its value and what it must be.

    `fields` are the names of the fields that it is about.
    """

    def __init__(self, message: str, *fields: str) -> None:
        super().__init__(message)
        self.fields = fields


@dataclass(frozen=True, slots=True)
class Interest:
    """A box along the axes of the part frame, `low_mm` to `high_mm` (3,): only surface in it is judged.

    Raises
    ------
    RequirementUnusable : the box is empty, upside down or not finite.
    """

    low_mm: tuple[float, float, float]
    high_mm: tuple[float, float, float]

    def __post_init__(self) -> None:
        if len(self.low_mm) != 3 or len(self.high_mm) != 3 or not all(map(isfinite, (*self.low_mm, *self.high_mm))):
            raise RequirementUnusable(
                "a region of interest is two corners of three finite millimetres each", "interest"
            )
        if not all(low < high for low, high in zip(self.low_mm, self.high_mm, strict=True)):
            raise RequirementUnusable(
                f"the region of interest is empty: its low corner {list(self.low_mm)} must lie below its high corner "
                f"{list(self.high_mm)} in x, y and z",
                "interest",
            )

    def holds(self, points_mm: Float64Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """(n,) True for the points (n, 3) in the box, its faces included."""
        inside = (points_mm >= np.array(self.low_mm)) & (points_mm <= np.array(self.high_mm))
        return np.asarray(inside.all(axis=1))

    @property
    def largest_face_mm2(self) -> float:
        """Area of the largest face."""
        _, b, c = sorted(high - low for low, high in zip(self.low_mm, self.high_mm, strict=True))
        return b * c


@dataclass(frozen=True, slots=True)
class Requirement:
    """The target a surface is judged by.

    Set by the user; None does not ask for it:

    `density_per_mm2` is the required density; None means `density_share` of the nominal density 1 / (Δs·δp) of each
    scanline. `line_spacing_mm` is the largest spacing of scanlines on the surface, Δs'. `chord_error_mm` is the largest
    distance κ·Δs'²/8 of the straight line between two scanlines from the surface, κ its curvature there, so
    that curved places ask for finer lines; below `finest_line_spacing_mm` it never asks. `incidence_rad`
    is the largest angle between surface normal and laser ray. `noise_mm` is the largest standard deviation of the
    returns; None: `noise_factor` times the sensor's. `coverage_share` is the share of the surface that must meet all
    this. `interest` bounds what is judged.

    How it is judged: `radius_constant_mm` is c of Eq. 6.3. `region_points` is the least number of points of a region,
    `region_area_mm2` its least area (None: 1 mm², or the disc of one neighbourhood, π r², where that is larger: what
    is smaller no neighbourhood can tell), and `region_angle_deg` the largest angle between normals of neighbouring
    points of one region. `search_mm` bounds the search for the adjacent scanline (None: the larger of 20·c and 3·r).

    Raises
    ------
    RequirementUnusable : a value out of its bounds, or two that contradict each other.
    """

    density_per_mm2: float | None = None
    density_share: float = 0.5
    radius_constant_mm: float = 0.1
    noise_factor: float = 3.0
    region_points: int = 10
    region_area_mm2: float | None = None
    region_angle_deg: float = 45.0
    search_mm: float | None = None
    line_spacing_mm: float | None = None
    chord_error_mm: float | None = None
    finest_line_spacing_mm: float = 0.05
    incidence_rad: float | None = None
    noise_mm: float | None = None
    coverage_share: float | None = None
    interest: Interest | None = None

    def __post_init__(self) -> None:
        for name in ("density_per_mm2", "search_mm", "line_spacing_mm", "chord_error_mm", "noise_mm"):
            value = getattr(self, name)
            if value is not None and not (isfinite(value) and value > 0):
                raise RequirementUnusable(
                    f"{name} must be greater than 0, or left out for the default, not {value}", name
                )
        if not 0 < self.density_share <= 1:
            raise RequirementUnusable(
                f"density_share must be above 0 and at most 1, not {self.density_share}", "density_share"
            )
        for name in ("radius_constant_mm", "finest_line_spacing_mm"):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0):
                raise RequirementUnusable(f"{name} must be greater than 0 mm, not {value}", name)
        if not (isfinite(self.noise_factor) and self.noise_factor >= 1):
            raise RequirementUnusable(f"noise_factor must be at least 1, not {self.noise_factor}")
        if self.region_area_mm2 is not None and not (isfinite(self.region_area_mm2) and self.region_area_mm2 >= 0):
            raise RequirementUnusable(f"region_area_mm2 must be 0 mm² or more, not {self.region_area_mm2}")
        if self.region_points < 1:
            raise RequirementUnusable(f"region_points must be at least 1, not {self.region_points}")
        if not 0 < self.region_angle_deg <= 180:
            raise RequirementUnusable(f"region_angle_deg must be above 0 and at most 180, not {self.region_angle_deg}")
        if self.incidence_rad is not None and not 0 < self.incidence_rad < pi / 2:
            raise RequirementUnusable(
                f"the largest incidence angle must lie between 0° and 90°, not {degrees(self.incidence_rad):g}°",
                "incidence_deg",
            )
        if self.coverage_share is not None and not 0 < self.coverage_share <= 1:
            raise RequirementUnusable(
                f"coverage_share must be above 0 and at most 1, not {self.coverage_share}", "coverage_share"
            )
        self._agrees_with_itself()

    def _agrees_with_itself(self) -> None:
        """Refuse what no surface can meet at once."""
        if self.line_spacing_mm is not None and self.line_spacing_mm < self.finest_line_spacing_mm:
            raise RequirementUnusable(
                f"a line spacing of at most {self.line_spacing_mm:g} mm is asked for, and none finer than "
                f"{self.finest_line_spacing_mm:g} mm: raise line_spacing_mm or lower finest_line_spacing_mm",
                "line_spacing_mm",
                "finest_line_spacing_mm",
            )
        if self.chord_error_mm is not None and self.noise_mm is not None and self.chord_error_mm < self.noise_mm:
            raise RequirementUnusable(
                f"a chord error of at most {self.chord_error_mm:g} mm cannot be told where noise up to "
                f"{self.noise_mm:g} mm is accepted: raise chord_error_mm or lower noise_mm",
                "chord_error_mm",
                "noise_mm",
            )
        if self.interest is not None and (self.region_area_mm2 or 0.0) > 6.0 * self.interest.largest_face_mm2:
            raise RequirementUnusable(
                f"region_area_mm2 is {self.region_area_mm2:g} mm², more than the surface of the region of interest: "
                "nothing could ever be reported; lower it or enlarge the region of interest",
                "interest",
            )

    def to_dict(self) -> dict[str, Any]:
        """What the user set, for JSON and the record; None for what is not asked for."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Requirement":
        """As `to_dict` gave it; names that this version does not know raise TypeError."""
        interest = values.get("interest")
        if interest is not None:
            interest = Interest(tuple(interest["low_mm"]), tuple(interest["high_mm"]))
        return cls(**{**values, "interest": interest})

    def check_scanner(self, noise_mm: float) -> None:
        """Refuse what a scanner of this noise (one standard deviation) cannot reach.

        Raises
        ------
        RequirementUnusable : the noise or chord error asked for is below the scanner's own noise.
        """
        for name in ("noise_mm", "chord_error_mm"):
            value = getattr(self, name)
            if value is not None and value < noise_mm:
                raise RequirementUnusable(
                    f"{name} asks for at most {value:g} mm, but the scanner's own noise is {noise_mm:g} mm: "
                    f"ask for at least that",
                    name,
                )

    def noise_limit_mm(self, noise_mm: float | None) -> float | None:
        """Largest noise accepted of a sensor with one standard deviation `noise_mm`; None: nothing is judged noisy."""
        if self.noise_mm is not None:
            return self.noise_mm
        return None if noise_mm is None else self.noise_factor * noise_mm

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

    def allowed_spacing_mm(self, curvature_per_mm: Float64Array) -> Float64Array:
        """Largest line spacing on surfaces of the given curvature (n,), 1/mm; inf where nothing is asked for.

        NaN curvature is unknown: only `line_spacing_mm` counts there. The chord of an arc of length Δs' and curvature κ
        stands off by κ·Δs'²/8.
        """
        allowed = np.full(len(curvature_per_mm), np.inf)
        if self.chord_error_mm is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                by_chord = np.sqrt(8.0 * self.chord_error_mm / np.abs(curvature_per_mm))
            allowed = np.fmin(allowed, np.maximum(by_chord, self.finest_line_spacing_mm))
        return allowed if self.line_spacing_mm is None else np.minimum(allowed, self.line_spacing_mm)
