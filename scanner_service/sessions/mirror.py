"""The analyst's own copy of the live map, renewed by what changed; knows no verdict.

A snapshot of the whole map holds the engine up for as long as it takes to copy every point. Here the engine copies
what changed, a page at a time between scanlines; all further work is done on the analyst's thread.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from scanner_service.analysis.describing import Records
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.snapshot import Int32Array, MapSnapshot
from scanner_service.rescan.columns import Columns

T = TypeVar("T")
PAGE_ROWS = 50_000
"""The engine copies so many rows between two scanlines, in some two milliseconds."""


_COLUMNS = [item.name for item in fields(MapSnapshot) if item.name not in ("version", "origin_mm", "lines")]


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


class Mirror:
    """A copy of one live map; one thread owns it.

    It holds what a snapshot says of every point; rows are described as they come, on the thread that reads.
    """

    def __init__(self) -> None:
        self.version = 0
        self._total = 0
        self._latest: MapSnapshot | None = None
        self._changed: list[Int32Array] = []
        self._described = Columns()

    def catch_up(self, ask: Ask, ask_between: Ask) -> int:
        """Take in everything that the engine was given before this call; returns how many rows were copied.

        `ask` waits for its turn, `ask_between` for the scanline under way only. Rows that change while many are copied
        page by page are copied once more, until what is left fits one answer, which then is of one version.
        """
        copied = 0
        while True:
            news = ask(partial(_news_since, version=self.version))
            self._described.make_room(news.total)
            copied += len(news.rows)
            self._changed.append(news.rows)
            if news.records is not None:
                self._put(news.rows, news.records)
                self.version, self._total = news.version, news.total
                return copied
            for start in range(0, len(news.rows), PAGE_ROWS):
                rows = news.rows[start : start + PAGE_ROWS]
                self._put(rows, ask_between(partial(LiveMap.records, rows=rows)))
            self.version = news.version

    def changes(self) -> tuple[MapSnapshot, npt.NDArray[np.int64]]:
        """The whole map as it was caught up with last, and its rows (k,), rising, that are new or other than before.

        The map is frozen: what is copied later does not change it. "Before" is at the last call.
        """
        assert self._latest is not None
        is_in = np.zeros(self._total, dtype=np.bool_)
        for part in self._changed:
            is_in[part] = True
        self._changed.clear()
        points: dict[str, Any] = self._described.copies("point", slice(self._total))
        return replace(self._latest, **points), np.flatnonzero(is_in).astype(np.int64)

    def _put(self, rows: Int32Array, records: Records) -> None:
        self._latest = news = records.describe()
        self._described.put(rows.astype(np.int64), **{f"point.{name}": getattr(news, name) for name in _COLUMNS})


def _news_since(live_map: LiveMap, version: int) -> _News:
    """What changed after a version of the map, evaluated to the last line taken in; on the engine's thread."""
    live_map.refresh()
    rows = live_map.changed_since(version) if version > 0 else None
    if rows is None:
        rows = np.arange(len(live_map), dtype=np.int32)
    return _News(live_map.version, len(live_map), rows, live_map.records(rows) if len(rows) <= PAGE_ROWS else None)
