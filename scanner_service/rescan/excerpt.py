"""Some scanlines of a map as a map of their own; knows what belongs together, judges nothing."""

from dataclasses import fields, replace
from typing import Any

import numpy as np

from scanner_service.analysis.snapshot import LineTable, MapSnapshot
from scanner_service.rescan.stations import IntArray


def rows_of_lines(snapshot: MapSnapshot, lines: IntArray) -> IntArray:
    """(k,) rows of the points of some lines, line by line; a map holds its points by line."""
    start = np.searchsorted(snapshot.line, lines)
    count = np.searchsorted(snapshot.line, lines, side="right") - start
    before = np.cumsum(count) - count
    return np.asarray(np.arange(int(count.sum())) + np.repeat(start - before, count), dtype=np.int64)


def excerpt_of(snapshot: MapSnapshot, lines: IntArray, rows: IntArray) -> MapSnapshot:
    """The map of some lines (rising) and their points `rows`, as `rows_of_lines` has them."""
    if len(lines) == len(snapshot.lines):
        return snapshot
    table: dict[str, Any] = {
        item.name: getattr(snapshot.lines, item.name)[lines] for item in fields(LineTable) if item.name != "device_ids"
    }
    points: dict[str, Any] = {
        item.name: getattr(snapshot, item.name)[rows]
        for item in fields(MapSnapshot)
        if item.name not in ("version", "origin_mm", "line", "lines")
    }
    line = np.searchsorted(lines, snapshot.line[rows]).astype(np.int32)
    return replace(snapshot, **points, line=line, lines=replace(snapshot.lines, **table))
