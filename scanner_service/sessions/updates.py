"""The live stream's answers: which points changed, with everything a client draws; asked on the engine's thread."""

from dataclasses import dataclass

import numpy as np

from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.snapshot import Int32Array, MapSnapshot
from scanner_service.sessions.results import Verdict


@dataclass(frozen=True, slots=True)
class Update:
    """The points that changed after `based_on`, as they are at `version`.

    `rows` (m,) are their rows in the map of `total` points; `points` (m rows) and `verdict` (m,) what is said of them.
    `is_full`: the client must forget what it has, the update holds every point. `skipped`: versions merged into it.
    """

    version: int
    based_on: int
    total: int
    rows: Int32Array
    points: MapSnapshot
    verdict: Verdict
    is_full: bool
    skipped: int


class VerdictBook:
    """The verdict in force on each point; owned by the engine, replaced whole whenever a new one was reached."""

    def __init__(self) -> None:
        self._verdict = Verdict(np.zeros(0, dtype=np.bool_), np.zeros(0, dtype=np.uint8))
        self._version = -1

    def replace(self, verdict: Verdict, version: int, live_map: LiveMap) -> None:
        """Take a verdict on that version of the map, unless a newer one is in force already.

        Rows of which it says something new are announced with the next reading.
        """
        if version < self._version:
            return
        self._version = version
        old = self.of(np.arange(len(verdict.rescan), dtype=np.int32))
        differs = (old.rescan != verdict.rescan) | (old.reason != verdict.reason)
        live_map.touch(np.flatnonzero(differs).astype(np.int32))
        self._verdict = verdict

    def of(self, rows: Int32Array) -> Verdict:
        """The verdict on rows (m,); rows that came after it are not judged yet."""
        known = rows < len(self._verdict.rescan)
        rescan = np.zeros(len(rows), dtype=np.bool_)
        reason = np.zeros(len(rows), dtype=np.uint8)
        rescan[known] = self._verdict.rescan[rows[known]]
        reason[known] = self._verdict.reason[rows[known]]
        return Verdict(rescan, reason)


def update_since(live_map: LiveMap, verdicts: VerdictBook, version: int) -> Update:
    """Evaluate what is stale, and gather everything that changed after `version`."""
    live_map.refresh()
    rows = live_map.changed_since(version) if version > 0 else None
    is_full = rows is None
    if rows is None:
        rows = np.arange(len(live_map), dtype=np.int32)
    return Update(
        version=live_map.version,
        based_on=0 if is_full else version,
        total=len(live_map),
        rows=rows,
        points=live_map.rows(rows),
        verdict=verdicts.of(rows),
        is_full=is_full,
        skipped=0 if is_full else max(0, live_map.version - version - 1),
    )
