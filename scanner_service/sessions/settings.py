"""What a session is told when it is created; only what is asked for may change. Knows no device and no thread."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from scanner_service.analysis.map_settings import MapSettings
from scanner_service.analysis.radius import LiveRule, RadiusSettings
from scanner_service.rescan.requirement import Requirement
from scanner_service.storage.formats.reference_mesh import ReferenceSpec


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """Radius, reliability and requirement of one session; kept in the record as a JSON object.

    `radius_rule` is `line`, `flexible` or `global`; `uncertainty_mm` is c of Eq. 6.3. `point_spacing_mm` None measures
    it line by line, a number states it, 0 ignores it. `noise_mm` is one standard deviation of the scanner.
    `target` is what the scan must reach. `reference` is the nominal part that coverage is measured against, None when
    there is none.

    Raises
    ------
    RequirementUnusable : what is asked for contradicts itself, or the scanner's own noise.
    """

    radius_rule: LiveRule = "line"
    uncertainty_mm: float = 0.1
    point_spacing_mm: float | None = None
    noise_mm: float = 0.01
    max_normal_error_rad: float = math.radians(5.0)
    max_points: int = 20_000_000
    threads: int = 1
    target: Requirement = field(default_factory=Requirement)
    reference: ReferenceSpec | None = None

    def __post_init__(self) -> None:
        self.map_settings()
        self.requirement().check_scanner(self.noise_mm)

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
        return replace(self.target, radius_constant_mm=self.uncertainty_mm)

    def to_dict(self) -> dict[str, Any]:
        """As it is kept in the record."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "SessionSettings":
        """From the record; names that this version does not know raise TypeError.

        Records of the first version have a required density beside the target.
        """
        values = dict(values)
        target, reference = values.get("target"), values.get("reference")
        asked = Requirement() if target is None else Requirement.from_dict(target)
        alone = values.pop("density_per_mm2", None)
        return cls(
            **{
                **values,
                "target": asked if alone is None else replace(asked, density_per_mm2=alone),
                "reference": None if reference is None else ReferenceSpec(**reference),
            }
        )
