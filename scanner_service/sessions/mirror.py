"""The analyst's own copy of the live map, renewed by what changed; knows no verdict.

A snapshot of the whole map holds the engine up for as long as it takes to copy every point. Here the engine copies
what changed, a page at a time between scanlines; all further work is done on the analyst's thread.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Protocol, TypeVar

import numpy as np

from scanner_service.analysis.describing import Records
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.snapshot import Int32Array, LineTable, MapSnapshot

T = TypeVar("T")
PAGE_ROWS = 50_000
"""The engine copies so many rows between two scanlines, in some two milliseconds."""

_MOST_KEPT = 100_000  # rows


class Ask(Protocol):
    """Has a question answered on the engine's thread; raises SessionError when there is none any more."""

    def __call__(self, question: Callable[[LiveMap], T], /) -> T:
        """The answer."""


@dataclass(frozen=True, slots=True)
class _News:
    """What changed of a map up to `version`: its rows (m,), and copies of them where they are few."""

    version: int
    total: int
    rows: Int32Array
    records: Records | None


@dataclass(frozen=True, slots=True)
class _Kept:
    """Rows (m,) of a map of `total` points and what it says of them, not yet put in place."""

    total: int
    rows: Int32Array
    points: MapSnapshot


class Mirror:
    """A copy of one live map; one thread owns it.

    What changed is kept until somebody asks for the map, or until it is worth a quarter of the map: then all of it is
    put in place at once, so that copying costs the same a point however large the map is.
    """

    def __init__(self) -> None:
        self.version = 0
        self._snapshot: MapSnapshot | None = None
        self._kept: list[_Kept] = []

    def catch_up(self, ask: Ask, ask_between: Ask) -> int:
        """Take in everything that the engine was given before this call; returns how many rows were copied.

        `ask` waits for its turn, `ask_between` for the scanline under way only. Rows that change while many are copied
        page by page are copied once more, until what is left fits one answer, which then is of one version.
        """
        copied = 0
        while True:
            since = self.version
            news = ask(partial(_news_since, version=since))
            copied += len(news.rows)
            if news.records is not None:
                if len(news.rows) or news.version != since or self._snapshot is None:
                    self._keep(_Kept(news.total, news.rows, news.records.describe()))
                self.version = news.version
                return copied
            for start in range(0, len(news.rows), PAGE_ROWS):
                rows = news.rows[start : start + PAGE_ROWS]
                records = ask_between(partial(LiveMap.records, rows=rows))
                self._keep(_Kept(news.total, rows, records.describe()))
            self.version = news.version

    def snapshot(self) -> MapSnapshot:
        """The whole map as it was caught up with last, frozen; what was given before stays as it was."""
        if self._kept:
            self._put_in_place()
        assert self._snapshot is not None
        return self._snapshot

    def _keep(self, change: _Kept) -> None:
        self._kept.append(change)
        if sum(len(kept.rows) for kept in self._kept) > max(_MOST_KEPT, change.total // 4):
            self._put_in_place()

    def _put_in_place(self) -> None:
        old, kept = self._snapshot, self._kept
        last = kept[-1]
        renewed = {}
        for item in fields(MapSnapshot):
            part = getattr(last.points, item.name)
            if isinstance(part, LineTable) or not isinstance(part, np.ndarray) or item.name == "origin_mm":
                renewed[item.name] = part
                continue
            whole = np.empty((last.total, *part.shape[1:]), dtype=part.dtype)
            if old is not None:
                before = getattr(old, item.name)
                whole[: len(before)] = before
            for change in kept:
                whole[change.rows] = getattr(change.points, item.name)
            renewed[item.name] = whole
        self._snapshot, self._kept = replace(last.points, **renewed), []


def _news_since(live_map: LiveMap, version: int) -> _News:
    """What changed after a version of the map, evaluated to the last line taken in; on the engine's thread."""
    live_map.refresh()
    rows = live_map.changed_since(version) if version > 0 else None
    if rows is None:
        rows = np.arange(len(live_map), dtype=np.int32)
    return _News(live_map.version, len(live_map), rows, live_map.records(rows) if len(rows) <= PAGE_ROWS else None)
