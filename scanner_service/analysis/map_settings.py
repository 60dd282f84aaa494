"""What a live map is told before the first line, and what it answers to each; knows no map."""

import math
from dataclasses import dataclass, field

from scanner_service.analysis.radius import RadiusSettings


@dataclass(frozen=True, slots=True)
class MapSettings:
    """What the live map is told, once, before the first line.

    `noise_mm` is the scanner's own standard deviation; `max_normal_error_rad` the predicted error up to which a normal
    is believed. A radius that leaves its neighbourhood unreliable grows to at most `max_radius_mm` (None: 20 c) and at
    most four times itself; where a pass is that far beyond a point, the point is settled. `needs_lines` asks for two
    scanlines in a neighbourhood and is off only for clouds without scanlines. `cell_limit` bounds the points that one
    cell counts, `max_points` the whole map.
    """

    radius: RadiusSettings = field(default_factory=RadiusSettings)
    noise_mm: float = 0.0
    max_normal_error_rad: float = math.radians(5.0)
    max_radius_mm: float | None = None
    needs_lines: bool = True
    cell_limit: int = 2048
    max_points: int = 20_000_000
    threads: int = 1

    def __post_init__(self) -> None:
        if not (math.isfinite(self.noise_mm) and self.noise_mm >= 0):
            raise ValueError(f"the scanner's noise must be 0 mm or more, not {self.noise_mm}")
        if not 0 < self.max_normal_error_rad <= math.pi:
            raise ValueError(f"the normal error limit must lie in (0, pi] rad, not {self.max_normal_error_rad}")
        if self.cell_limit < 1 or self.max_points < 1 or self.threads < 1:
            raise ValueError("cell_limit, max_points and threads must be at least 1")


@dataclass(frozen=True, slots=True)
class Accepted:
    """What became of one line: its row in the line table, its radius, and how many of its points count.

    `left_out` counts points that are kept in the record but not in the map, by reason: `stationary`,
    `over_dense`, `withdrawn` (a line of a pass that was taken out before). A line whose radius needs larger cells can
    leave out points of earlier lines: `counted` is then that much less, and may be negative, so that sums stay true.
    """

    line_row: int
    radius_mm: float
    counted: int
    left_out: dict[str, int]
