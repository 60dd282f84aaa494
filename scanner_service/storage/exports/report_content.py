"""What a report says, as plain values; knows neither HTML nor PDF, and computes nothing."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.coverage import Coverage
from scanner_service.rescan.regions import RegionReport


@dataclass(frozen=True, slots=True)
class Verdictful:
    """A map with the verdict on it, at one moment of the session."""

    snapshot: MapSnapshot
    report: RegionReport
    coverage: Coverage


@dataclass(frozen=True, slots=True)
class PassRow:
    """What was known when a pass was over. `name` says which pass; areas in mm², coverage from 0 to 1 or NaN."""

    name: str
    lines: int
    points: int
    coverage: float
    touched_mm2: float
    gap_mm2: float
    regions: int
    region_mm2: float


@dataclass(frozen=True, slots=True)
class FateRow:
    """What became of a region of the first pass: the share of its points that were still wanting at the end.

    `name` is a letter: the numbers of regions are of those at the end.
    """

    name: str
    reason: str
    area_mm2: float
    left_share: float

    @property
    def outcome(self) -> str:
        """In one word."""
        if self.left_share <= 0.05:
            return "resolved"
        return "open" if self.left_share >= 0.5 else "partly resolved"


@dataclass(frozen=True, slots=True)
class ReportContent:
    """Everything that a report says. `rows_*` are (name, value) as they are to be read."""

    title: str
    session_id: str
    state: str
    created: str
    written: str
    software: str
    raw_sha256: str
    verdict_sha256: str
    final: Verdictful
    first: Verdictful | None
    passes: tuple[PassRow, ...]
    pass_ends: int
    fates: tuple[FateRow, ...]
    required_per_mm2: float
    headlines: tuple[tuple[str, str], ...]
    facts: tuple[tuple[str, str], ...]
    losses: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]
    settings: tuple[tuple[str, str], ...]
    damaged: tuple[str, ...]


def flat_rows(values: Mapping[str, Any], before: str = "") -> list[tuple[str, str]]:
    """A tree of numbers as rows to be read: names of the branches one behind the other."""
    rows: list[tuple[str, str]] = []
    for name, value in values.items():
        words = f"{before}{' · ' if before else ''}{str(name).replace('_', ' ')}"
        if isinstance(value, Mapping):
            rows += flat_rows(value, words) if value else [(words, "none")]
        else:
            rows.append((words, shown(value)))
    return rows


def amount(value: float, digits: int = 0) -> str:
    """A number with so many digits behind the point, its thousands apart as in all of the report."""
    return f"{value:,.{digits}f}".replace(",", "\u202f")


def shown(value: Any) -> str:
    """A value as people read it."""
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return amount(value)
    if isinstance(value, float):
        return "unknown" if value != value else f"{value:.6g}"  # noqa: PLR0124 - NaN
    return str(value)
