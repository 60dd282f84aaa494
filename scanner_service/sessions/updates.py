"""The live stream's answers: which points changed, with everything a client draws; asked on the engine's thread."""

from dataclasses import dataclass

import numpy as np

from scanner_service.analysis.brief import Brief
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.snapshot import Int32Array
from scanner_service.sessions.results import Verdict


@dataclass(frozen=True, slots=True)
class Changes:
    """Which points changed after version `based_on` of the map, up to `version`; what is said of them is read in pages.

    `rows` (m,) are their rows in the map of `total` points, None for all of them: then the client must forget what it
    has. `skipped`: versions merged into this one.
    """

    version: int
    based_on: int
    total: int
    rows: Int32Array | None
    skipped: int

    def __len__(self) -> int:
        return self.total if self.rows is None else len(self.rows)


@dataclass(frozen=True, slots=True)
class PointPage:
    """A part of the changed points: rows (k,), what the map says of them in brief, and the verdict (k,).

    A page read later says what holds later; what changes after `changes.version` is announced once more anyway.
    """

    changes: Changes
    rows: Int32Array
    points: Brief
    verdict: Verdict
    is_first: bool
    is_last: bool


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
        differs = verdict.rescan | (verdict.reason != 0)  # what was not judged before said nothing
        old, both = self._verdict, min(len(differs), len(self._verdict.rescan))
        differs[:both] = old.rescan[:both] != verdict.rescan[:both]
        differs[:both] |= old.reason[:both] != verdict.reason[:both]
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


def changes_since(live_map: LiveMap, version: int) -> Changes:
    """Evaluate what is stale, and tell what changed after `version`; 0, or a version too long ago, asks for all."""
    live_map.refresh()
    rows = live_map.changed_since(version) if version > 0 else None
    return Changes(
        version=live_map.version,
        based_on=0 if rows is None else version,
        total=len(live_map),
        rows=rows,
        skipped=0 if rows is None else max(0, live_map.version - version - 1),
    )


def read_page(live_map: LiveMap, verdicts: VerdictBook, changes: Changes, start: int, count: int) -> PointPage:
    """The changed points from number `start` on, at most `count` of them."""
    end = min(start + count, len(changes))
    rows = np.arange(start, end, dtype=np.int32) if changes.rows is None else changes.rows[start:end]
    return PointPage(
        changes, rows, live_map.brief(rows), verdicts.of(rows), is_first=start == 0, is_last=end >= len(changes)
    )
