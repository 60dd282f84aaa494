"""What a session is told when it is created, and keeps for ever; knows no device and no thread."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from scanner_service.analysis.live_map import MapSettings
from scanner_service.analysis.radius import LiveRule, RadiusSettings
from scanner_service.rescan.requirement import Requirement


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """Radius, reliability and requirement of one session; kept in the record as a JSON object.

    `radius_rule` is `line`, `flexible` or `global`; `uncertainty_mm` is c of Eq. 6.3. `point_spacing_mm` None measures
    it line by line, a number states it, 0 ignores it. `noise_mm` is one standard deviation of the scanner.
    `density_per_mm2` is the required density, None for half of 1 / (line spacing * point spacing).
    """

    radius_rule: LiveRule = "line"
    uncertainty_mm: float = 0.1
    point_spacing_mm: float | None = None
    noise_mm: float = 0.01
    max_normal_error_rad: float = math.radians(5.0)
    density_per_mm2: float | None = None
    max_points: int = 20_000_000
    threads: int = 1

    def __post_init__(self) -> None:
        self.map_settings()
        self.requirement()

    def map_settings(self) -> MapSettings:
        """The part that the live map is told."""
        return MapSettings(
            radius=RadiusSettings(self.uncertainty_mm, self.point_spacing_mm, self.radius_rule),
            noise_mm=self.noise_mm,
            max_normal_error_rad=self.max_normal_error_rad,
            max_points=self.max_points,
            threads=self.threads,
        )

    def requirement(self) -> Requirement:
        """The part that the rescan regions are judged by."""
        return Requirement(density_per_mm2=self.density_per_mm2)

    def to_dict(self) -> dict[str, Any]:
        """As it is kept in the record."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "SessionSettings":
        """From the record; names that this version does not know raise TypeError."""
        return cls(**values)
