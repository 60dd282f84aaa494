"""One rescan region as it is told: where, how large, why, how urgent and how far it has come; finds none."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from drivers.scanline import Float64Array, read_only
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.stations import IntArray

_HALF_PRIORITY_MM2 = 25.0


class RegionStatus(StrEnum):
    """How far a region has come.

    `open`: found, and no pass has been over it since. `rescanned`: a later pass put points on it, and it fails still.
    `resolved`: its surface meets the requirement. `unreachable`: no pose that the rig can take sees it.
    """

    OPEN = "open"
    RESCANNED = "rescanned"
    RESOLVED = "resolved"
    UNREACHABLE = "unreachable"


@dataclass(frozen=True, slots=True)
class RegionMoment:
    """What was said of a region at one version of the map: its status then, area, priority, and a sentence."""

    version: int
    status: RegionStatus
    area_mm2: float
    priority: float
    why: str

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "version": self.version,
            "status": self.status.value,
            "area_mm2": self.area_mm2,
            "priority": self.priority,
            "why": self.why,
        }


_SAID = {
    "density": "density",
    "line_spacing": "scanlines on the surface apart by",
    "incidence": "incidence",
    "noise": "noise",
}


@dataclass(frozen=True, slots=True)
class Limit:
    """Which limit a region misses: `measured` against `required` in one unit, the latter the largest or the least.

    `quantity` is `density` (points/mm²), `line_spacing` (mm), `incidence` (°) or `noise` (mm).
    """

    quantity: str
    measured: float
    required: float
    unit: str

    @property
    def is_largest(self) -> bool:
        """Whether more than `required` fails; less does, of a density."""
        return self.quantity != "density"

    @property
    def text(self) -> str:
        """For people: what was measured, and what is the most or the least."""
        bound = "at most" if self.is_largest else "at least"
        measured, required = (_with_unit(value, self.unit) for value in (self.measured, self.required))
        return f"{_SAID[self.quantity]} {measured}, {bound} {required}"

    @property
    def has(self) -> str:
        """What was measured, for a narrow table."""
        return _with_unit(self.measured, self.unit.removeprefix("points"))

    @property
    def needs(self) -> str:
        """The most or the least, for a narrow table."""
        return f"{'≤' if self.is_largest else '≥'} {_with_unit(self.required, self.unit.removeprefix('points'))}"

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "quantity": self.quantity,
            "measured": _known(self.measured),
            "required": _known(self.required),
            "unit": self.unit,
            "bound": "at most" if self.is_largest else "at least",
            "text": self.text,
            "has": self.has,
            "needs": self.needs,
        }

    @classmethod
    def from_dict(cls, kept: Mapping[str, Any] | None) -> "Limit | None":
        """As `to_dict` gave it; None where there is none."""
        if kept is None or kept["measured"] is None or kept["required"] is None:
            return None
        return cls(str(kept["quantity"]), float(kept["measured"]), float(kept["required"]), str(kept["unit"]))


@dataclass(frozen=True, slots=True)
class RescanRegion:
    """A patch of surface worth another pass; part frame, millimetres.

    `outline_mm` are closed loops of (k, 3) points on the surface, the longest first. `normal` (3,) is the mean unit
    normal towards the laser, NaN if unknown; a wall's points to its open side. `measured_per_mm2` is the median density
    that the spacing on the surface gives (0 in a shadow), `counting_error_per_mm2` the robust spread of the points
    around it (1.4826 times the median absolute deviation). `priority` = deficit · area / (area + 25 mm²), where deficit
    is 1 - measured / required, or 1 - limit / noise for noise, at least 1 - r / Δs' for steep surface, 1 out of range
    and 0 for isolated points. 0 is not worth a pass, near 1 is large and empty.
    `point_rows` (point_count,) are rows of the snapshot: the failing points, or a gap's ends.

    `number` is what everybody calls it: `region_id`, which names it as long as the session lives, and in a report by
    itself, whose regions are not followed (0), its place in the list. `confidence` = (agreeing + 1) / (points + 2): how
    many of its points fail by their own measurement, not by their neighbours' only. `line_spacing_mm` is the largest
    spacing on the surface that the requirement allows there, NaN if unknown. `limit` is what it fails by, None where
    nothing was measured (a shadow, the end of the range, surface that nobody touched) or it is not known. `history` are
    the changes of its status, the oldest first.
    """

    number: int
    reason: Reason
    outline_mm: tuple[Float64Array, ...]
    area_mm2: float
    centroid_mm: Float64Array
    normal: Float64Array
    measured_per_mm2: float
    required_per_mm2: float
    counting_error_per_mm2: float
    priority: float
    point_count: int
    remedy: str
    point_rows: IntArray
    confidence: float = 1.0
    line_spacing_mm: float = float("nan")
    region_id: int = 0
    status: RegionStatus = RegionStatus.OPEN
    history: tuple[RegionMoment, ...] = ()
    limit: Limit | None = None

    def __post_init__(self) -> None:
        for array in (*self.outline_mm, self.centroid_mm, self.normal, self.point_rows):
            read_only(array)

    def to_dict(self) -> dict[str, object]:
        """For JSON: plain numbers and lists, None where a value is unknown, without the point rows."""
        return {
            "number": self.number,
            "id": self.region_id or None,
            "status": self.status.value,
            "reason": self.reason.label,
            "remedy": self.remedy,
            "area_mm2": self.area_mm2,
            "centroid_mm": self.centroid_mm.tolist(),
            "normal": None if np.isnan(self.normal).any() else self.normal.tolist(),
            "measured_per_mm2": _known(self.measured_per_mm2),
            "required_per_mm2": _known(self.required_per_mm2),
            "counting_error_per_mm2": _known(self.counting_error_per_mm2),
            "line_spacing_mm": _known(self.line_spacing_mm),
            "limit": None if self.limit is None else self.limit.to_dict(),
            "priority": self.priority,
            "confidence": self.confidence,
            "point_count": self.point_count,
            "outline_mm": [loop.tolist() for loop in self.outline_mm],
            "history": [moment.to_dict() for moment in self.history],
        }


def mean_normal(normals: Float64Array) -> Float64Array:
    """Unit mean of the known normals; NaN where none is known or they point everywhere."""
    known = normals[np.isfinite(normals).all(axis=1)]
    total = known.sum(axis=0)
    length = float(np.linalg.norm(total))
    if not len(known) or length < 0.5 * len(known):
        return np.full(3, np.nan)
    return np.asarray(total / length, dtype=np.float64)


def priority_of(deficit: float, area_mm2: float) -> float:
    """Share of the requirement that is missing, times how large the area is beside 25 mm²."""
    return max(0.0, min(1.0, deficit)) * area_mm2 / (area_mm2 + _HALF_PRIORITY_MM2)


def succession(agreeing: int, witnesses: int) -> float:
    """Trust in a verdict on which so many of the witnesses agree (Laplace's rule of succession, 1774)."""
    return (agreeing + 1.0) / (witnesses + 2.0)


def _with_unit(value: float, unit: str) -> str:
    if not np.isfinite(value):
        return "–"
    return f"{value:.3g}{'' if unit == '°' else ' '}{unit}"


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
