"""Which rows changed in which version of a map, as far back as is kept; knows no points."""

from collections import deque
from itertools import takewhile

import numpy as np

from scanner_service.analysis.snapshot import Int32Array

_SPARSE = 64
"""Rows that are spread wider than this many times their number are sorted instead of marked."""


class ChangeLog:
    """The latest versions of a map, each with the rows (m,) that changed in it."""

    def __init__(self) -> None:
        self._versions: deque[tuple[int, Int32Array]] = deque()
        self._rows = 0
        self._latest = 0

    def append(self, version: int, rows: Int32Array, keep_rows: int) -> None:
        """Note a version; the oldest are forgotten while more than `keep_rows` rows are kept."""
        self._latest = version
        self._versions.append((version, rows))
        self._rows += len(rows)
        while len(self._versions) > 1 and self._rows > keep_rows:
            self.forget_oldest()

    def forget_oldest(self) -> None:
        """Forget the oldest version that is kept."""
        self._rows -= len(self._versions.popleft()[1])

    def since(self, version: int) -> Int32Array | None:
        """The rows that changed after `version`, sorted; None when that is longer ago than is kept."""
        if version >= self._latest:
            return np.empty(0, dtype=np.int32)
        if not self._versions or self._versions[0][0] > version + 1:
            return None
        newer = [rows for _, rows in takewhile(lambda kept: kept[0] > version, reversed(self._versions))]
        return np.sort(newer[0]) if len(newer) == 1 else _union(newer)


def _union(parts: list[Int32Array]) -> Int32Array:
    """The rows that are in any of the parts, sorted, each once."""
    rows = np.concatenate(parts)
    if not len(rows):
        return rows
    low, high = int(rows.min()), int(rows.max())
    if high - low > _SPARSE * len(rows):
        return np.unique(rows)
    is_in = np.zeros(high - low + 1, dtype=np.bool_)  # a scan changes rows that lie close together
    is_in[rows - low] = True
    return (np.flatnonzero(is_in) + low).astype(np.int32)
