"""What a session says of itself to people; knows nothing of how any of it came about."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from scanner_service.sessions.awaited import Awaited
from scanner_service.storage.rows import Watermark

STATES = ("created", "scanning", "paused", "interrupted", "stopped", "failed")


@dataclass(frozen=True, slots=True)
class Status:
    """What a session is doing, for people: counts, rates, losses and, when something is amiss, one sentence.

    `lines` and `points`: stored in the record, and counted in the map. `verdict_age_s`: how long ago the map was read
    that regions and coverage are of, NaN before the first verdict. `coverage_kind`: `observed`, of the
    surface seen, or `reference`, of the nominal part. `held`: a pause that lasts until somebody resumes.
    `holds`: whether the coverage asked for is reached, None when none is asked for or none is known. `judging`: the
    verdict that is waited for, at the end of a scan or since something else is asked for; None when none is.
    """

    session_id: str
    name: str
    state: str
    created_utc: str
    lines: int
    points: int
    points_per_s: float
    coverage: float
    coverage_kind: str
    verdict_age_s: float
    progress: float | None
    losses: dict[str, Any]
    durable: dict[str, dict[str, int]]
    message: str | None
    held: bool
    holds: bool | None
    judging: Awaited | None


def durable_told(marks: Mapping[str, Watermark]) -> dict[str, dict[str, int]]:
    """How far the lines of each device are durable."""
    return {
        device: {"boot_id": mark.boot_id, "line_index": mark.line_index, "lines": mark.line_count}
        for device, mark in marks.items()
    }


def first_said(*said: str | None) -> str | None:
    """Of what there is to say, the most urgent first, the one sentence that is said."""
    return next(filter(None, said), None)
