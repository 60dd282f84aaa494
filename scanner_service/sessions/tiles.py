"""A session too large for one map, read in slabs that overlap by the largest radius; each tells its own points.

What is said of a point depends on the points within its radius and on the scanlines, so that a map of the slab and a
margin says the same as a map of everything. Regions and coverage need the whole and are not told.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from scanner_service.analysis.intake import QUANTUM_MM, StoredLine
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.passes import PassKey, pass_key
from scanner_service.analysis.radius import line_radius, point_spacing_mm
from scanner_service.analysis.snapshot import RadiusRule
from scanner_service.sessions.fingerprint import RawHash
from scanner_service.sessions.settings import SessionSettings
from scanner_service.sessions.stored import OnShare, lines_of
from scanner_service.sessions.withdrawals import ends_of_passes, withdrawn_passes
from scanner_service.storage.exports.errors import NotExportable
from scanner_service.storage.exports.point_stream import BLOCK_POINTS, Int64Array, PointBlock, PointStream, rows_of
from scanner_service.storage.reader import RecordReader
from scanner_service.storage.rows import SessionRow

_SLAB_POINTS = 4_000_000
_BIN_Q = 1 << 13  # a slab ends at a whole millimetre
_NO_XYZ, _NO_INDEX = np.zeros((0, 3), np.int32), np.zeros(0, np.int32)


@dataclass(frozen=True, slots=True)
class _Head:
    """A line without its points: where they lie, their common radius, and whether a scan ended just before it."""

    number: int
    line: StoredLine
    low_q: Int64Array
    high_q: Int64Array
    radius_mm: float
    rule: RadiusRule
    after_an_end: bool


@dataclass(frozen=True, slots=True)
class TiledSession:
    """What is known of a session after its lines were read once; `stream` reads them again, slab by slab."""

    stream: PointStream
    raw_sha256: str
    lines: int
    damaged: tuple[str, ...]
    slabs: int


def read_in_tiles(
    reader: RecordReader, row: SessionRow, points_at_once: int, on_share: OnShare = lambda share: None
) -> TiledSession:
    """Read a session whose points need never be in memory together; at most about `points_at_once` are.

    Raises
    ------
    NotExportable : the radius is one for the whole cloud, which only the whole cloud can tell.
    """
    settings = SessionSettings.from_dict(row.settings)
    refusal = why_not_in_tiles(settings, points_at_once)
    if refusal is not None:
        raise NotExportable(refusal)
    events = list(reader.events(row.session_id))
    withdrawn, scan_ends = withdrawn_passes(events), ends_of_passes(events)
    heads: list[_Head] = []
    damaged: list[str] = []
    bins: list[Counter[int]] = [Counter(), Counter(), Counter()]
    raw = RawHash()
    total = 0
    for number, line in lines_of(reader, row, damaged, on_share):
        ended = [count for count in scan_ends if count <= number]
        scan_ends = scan_ends[len(ended) :]
        heads.append(_head(number, line, settings, after_an_end=bool(ended)))
        for axis, counted in enumerate(bins):
            for place, count in zip(*np.unique(line.xyz_q[:, axis] // _BIN_Q, return_counts=True), strict=True):
                counted[int(place)] += int(count)
        raw.add(line)
        total += len(line.index)
    margin_mm = max([head.radius_mm for head in heads] + [20.0 * settings.uncertainty_mm])
    margin_q = math.ceil(margin_mm / QUANTUM_MM) + 1
    axis = max(range(3), key=lambda one: len(bins[one]))
    slabs = _slabs(bins[axis], -(-margin_q // _BIN_Q), min(points_at_once, _SLAB_POINTS))

    def blocks() -> Iterator[PointBlock]:
        for first_bin, end_bin, most in slabs:
            yield from _slab(
                reader, row, settings, heads, withdrawn, axis, first_bin * _BIN_Q, end_bin * _BIN_Q, margin_q, most
            )

    filled = [head for head in heads if (head.high_q >= head.low_q).all()]
    zero = np.zeros(3, dtype=np.int64)
    stream = PointStream(
        total=total,
        origin_mm=np.array(row.origin_mm),
        low_q=np.min([head.low_q for head in filled], axis=0) if filled else zero,
        high_q=np.max([head.high_q for head in filled], axis=0) if filled else zero,
        is_judged=False,
        blocks=blocks,
    )
    return TiledSession(stream, raw.hexdigest(), len(heads), tuple(damaged), len(slabs))


def why_not_in_tiles(settings: SessionSettings, points_at_once: int) -> str | None:
    """Why a session of more points cannot be told from parts, as one sentence; None when it can."""
    if settings.radius_rule != "global":
        return None
    return (
        "the session has one radius for the whole cloud, which cannot be told from parts of it: "
        f"allow more than {points_at_once:,} points at once"
    )


def _head(number: int, line: StoredLine, settings: SessionSettings, after_an_end: bool) -> _Head:
    spacing = point_spacing_mm(line.xyz_q, line.index)
    radius_mm, rule = line_radius(line.line_spacing_mm, spacing, settings.map_settings().radius)
    has_points = len(line.index) > 0
    low = line.xyz_q.min(axis=0).astype(np.int64) if has_points else np.ones(3, dtype=np.int64)
    high = line.xyz_q.max(axis=0).astype(np.int64) if has_points else np.zeros(3, dtype=np.int64)
    bare = replace(line, xyz_q=_NO_XYZ.copy(), index=_NO_INDEX.copy())
    return _Head(number, bare, low, high, radius_mm, rule, after_an_end)


def _slabs(bins: Counter[int], margin: int, points_at_once: int) -> list[tuple[int, int, int]]:
    """(first bin, end bin, points with the margins) of each slab; one bin at least, else as many as fit."""
    if not bins:
        return []
    first, last = min(bins), max(bins)
    counts = np.array([bins[place] for place in range(first, last + 1)], dtype=np.int64)
    before = np.concatenate([[0], np.cumsum(counts)])

    def within(start: int, end: int) -> int:
        return int(before[min(end + margin, len(counts))] - before[max(start - margin, 0)])

    found, start = [], 0
    while start < len(counts):
        end = start + 1
        while end < len(counts) and within(start, end + 1) <= points_at_once:
            end += 1
        if before[end] > before[start]:
            found.append((first + start, first + end, within(start, end)))
        start = end
    return found


def _slab(
    reader: RecordReader, row: SessionRow, settings: SessionSettings, heads: list[_Head], withdrawn: set[PassKey],
    axis: int, low_q: int, high_q: int, margin_q: int, most: int,
) -> Iterator[PointBlock]:  # fmt: skip
    """The points of one slab, judged by a map of the slab and its margins."""
    from_q, to_q = low_q - margin_q, high_q + margin_q
    reached = [head.number for head in heads if head.high_q[axis] >= from_q and head.low_q[axis] < to_q]
    lines = _some_lines(reader, row, reached)
    wanted = set(reached)
    live_map = LiveMap(replace(settings.map_settings(), max_points=max(most, 1024)), np.array(row.origin_mm))
    open_passes: dict[str, PassKey] = {}
    try:
        for head in heads:
            if head.after_an_end:
                live_map.close_all_passes()
            line = head.line
            if head.number in wanted:
                whole = next(lines)
                kept = (whole.xyz_q[:, axis] >= from_q) & (whole.xyz_q[:, axis] < to_q)
                line = replace(whole, xyz_q=whole.xyz_q[kept], index=whole.index[kept])
            over = open_passes.get(line.device_id)
            if over is not None and over != pass_key(line):
                live_map.close_pass(over)
            open_passes[line.device_id] = pass_key(line)
            if settings.radius_rule == "flexible":
                live_map.add(line)
            else:
                live_map.add(line, np.full(len(line.index), head.radius_mm), head.rule)
        live_map.close_all_passes()
        for key in withdrawn:
            live_map.withdraw_pass(key)
        live_map.refresh()
        for start in range(0, len(live_map), BLOCK_POINTS):
            part = live_map.rows(np.arange(start, min(start + BLOCK_POINTS, len(live_map)), dtype=np.int32))
            place_q = np.rint((part.points_mm[:, axis] - part.origin_mm[axis]) / QUANTUM_MM)
            own = (place_q >= low_q) & (place_q < high_q)
            if own.any():
                yield PointBlock(rows_of(part, own), None, None)
    finally:
        live_map.close()


def _some_lines(reader: RecordReader, row: SessionRow, numbers: list[int]) -> Iterator[StoredLine]:
    """The lines of these numbers, ascending; neighbours are read together."""
    start = 0
    for at in range(1, len(numbers) + 1):
        if at == len(numbers) or numbers[at] != numbers[at - 1] + 1:
            for _, line in reader.lines(row.session_id, numbers[start], numbers[at - 1] + 1):
                yield line
            start = at
