"""The live map: scanlines go in one by one, and after each the answer for every point equals a batch computation.

Lines are put into a sparse grid at once; what they reach is queued, and evaluated in full when somebody reads. A
point's answer is thus a function of the set of points alone: no order, no batch and no thread leaves a trace. Knows
no session, no database and no client.
"""

import math
from collections import deque
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.errors import MapFull
from scanner_service.analysis.grid import SMALLEST_SIDE_Q, insert_points, mark_all_stale, reserve_grid
from scanner_service.analysis.intake import QUANTUM_MM, StoredLine
from scanner_service.analysis.line_columns import LineColumns
from scanner_service.analysis.neighbourhood import (
    LISTED,
    Lines,
    Points,
    drop_pass,
    evaluate_cells,
    list_unsettled,
    reserve_points,
    settle_listed,
)
from scanner_service.analysis.passes import Pass, PassBook, PassKey
from scanner_service.analysis.radius import RadiusSettings, line_radius, point_spacing_mm
from scanner_service.analysis.snapshot import Int32Array, MapSnapshot, RadiusRule, Unreliable

_CLOSED_AT_ENTRY = 0


@dataclass(frozen=True, slots=True)
class MapSettings:
    """What the live map is told, once, before the first line.

    `noise_mm` is the scanner's own standard deviation; `max_normal_error_rad` the predicted error up to which a normal
    is believed; `max_radius_mm` bounds every radius and is the clearance after which a point is settled (None: the
    larger of 20 c and twice the radius in force). `needs_lines` asks for two scanlines in a neighbourhood and is off
    only for clouds without scanlines. `cell_limit` bounds the points that one cell counts, `max_points` the whole map.
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

    `left_out` counts points that are kept in the record but not in the map, by reason: `stationary`, `over_dense`.
    """

    line_row: int
    radius_mm: float
    counted: int
    left_out: dict[str, int]


class LiveMap:
    """The accumulated surface of one session.

    Not thread-safe: one thread owns it (the kernels release the GIL and use `settings.threads` threads of their own).
    """

    def __init__(self, settings: MapSettings | None = None, origin_mm: Float64Array | None = None) -> None:
        self.settings = settings or MapSettings()
        self.origin_mm = np.zeros(3) if origin_mm is None else np.array(origin_mm, dtype=np.float64)
        self.version = 0
        self._points: Points = reserve_points(self.settings.max_points)
        self._used = 0
        self._grid = reserve_grid(1, 1)
        self._grid_rows = 0
        self._largest_radius_mm = 0.0
        self._lines = LineColumns()
        self._passes = PassBook()
        self._listed: Int32Array = np.empty(self.settings.max_points, dtype=np.int32)
        self._listed_used = 0
        self._pending: list[Int32Array] = []
        self._history: deque[tuple[int, Int32Array]] = deque()
        self._pool = ThreadPoolExecutor(self.settings.threads) if self.settings.threads > 1 else None

    def __len__(self) -> int:
        return self._used

    @property
    def line_count(self) -> int:
        """How many scanlines the map has accepted."""
        return len(self._lines)

    def close(self) -> None:
        """End the map's own threads."""
        if self._pool is not None:
            self._pool.shutdown()

    # -- writing ------------------------------------------------------------------------------------------------

    def add(
        self, line: StoredLine, radius_mm: Float64Array | None = None, given_by: RadiusRule = RadiusRule.FIXED
    ) -> Accepted:
        """Take in one scanline; its answer, and that of everything it reaches, is ready at the next reading.

        Parameters
        ----------
        line : the scanline as it is stored.
        radius_mm : (k,) radius of each point, for clouds whose radii are known beforehand; by default r_min of Eq. 6.3
            with the governing spacing, the same for the whole line.
        given_by : the rule that `radius_mm` came from.

        Raises
        ------
        MapFull : the map would exceed its ceiling; nothing of the line was taken in.
        TooManyPasses : the line opens a pass too many; nothing was taken in.
        ValueError : the line spacing or a radius is not a positive finite number.
        """
        spacing = point_spacing_mm(line.xyz_q, line.index)
        common, rule = line_radius(line.line_spacing_mm, spacing, self.settings.radius)
        if radius_mm is not None:
            if radius_mm.shape != (len(line.index),) or not (np.isfinite(radius_mm) & (radius_mm > 0)).all():
                raise ValueError("radius_mm must hold one positive finite radius a point")
            rule = given_by
            common = float(radius_mm.max(initial=0.0)) or common
        self.can_take(line)
        of = self._passes.enter(line)
        stationary = of.slot >= 0 and of.stands_still_at(line)
        row = self._lines.append(line, of, spacing, stationary, self.origin_mm)
        first, last = self._used, self._used + len(line.index)
        points = self._points
        points.xyz_q[first:last] = line.xyz_q
        points.line[first:last] = row
        points.place[first:last] = line.index
        points.radius_mm[first:last] = common if radius_mm is None else radius_mm
        points.radius_rule[first:last] = rule
        _clear_answers(points, first, last)
        self._used = last
        if stationary:
            _leave_out(points, first, np.ones(last - first, dtype=np.bool_))
            self._grid_rows = last
            self._pending.append(np.arange(first, last, dtype=np.int32))
            return Accepted(row, common, 0, {"stationary": last - first} if last > first else {})
        if of.slot >= 0:
            self._follow(of, line)
        self._reach_at_least(common)
        over_dense = self._insert(first, last)
        return Accepted(row, common, last - first - over_dense, {"over_dense": over_dense} if over_dense else {})

    def close_pass(self, key: PassKey) -> None:
        """The motion is over: its points wait no longer. Closing a pass that is not open does nothing."""
        closed = self._passes.close(key)
        if closed is None:
            return
        drop_pass(self._listed[: self._listed_used], self._points, 1 << closed.slot)
        self._lines.drop_pass(closed.number)

    def close_all_passes(self) -> None:
        """Close every pass that is open."""
        for key in self._passes.open_keys():
            self.close_pass(key)

    def can_take(self, line: StoredLine) -> None:
        """Return when `add` would take the line, raise MapFull or TooManyPasses as it would when not."""
        more = len(line.index)
        self._passes.check_room(line)
        if self._used + more > self.settings.max_points:
            raise MapFull(
                f"the live map is configured for {self.settings.max_points} points and holds {self._used}: "
                f"{more} more do not fit; raise max_points or start another session"
            )

    def _follow(self, of: Pass, line: StoredLine) -> None:
        """Advance the front of a pass; when it stops being steady, all it ever reached waits again."""
        if of.advance(line):
            mark_all_stale(self._grid)
        self._passes.publish(of, self.origin_mm)

    def _reach_at_least(self, radius_mm: float) -> None:
        """Make the cells at least as large as the largest radius, building the grid again when they are not."""
        if radius_mm <= self._largest_radius_mm:
            return
        if radius_mm <= self._grid.side_q[0] * QUANTUM_MM:
            self._largest_radius_mm = radius_mm
            return
        # Radii that creep up line by line must not build the grid anew each time.
        side_mm = radius_mm if self._largest_radius_mm == 0.0 else 1.25 * radius_mm
        side_q = max(math.ceil(side_mm / QUANTUM_MM), SMALLEST_SIDE_Q)
        self._largest_radius_mm = radius_mm
        self._grid = reserve_grid(side_q, self.settings.max_points)
        rows, self._grid_rows = self._grid_rows, 0
        if rows:
            self._insert(0, rows)

    def _insert(self, first: int, last: int) -> int:
        """Put rows into the grid; returns how many a full cell had to leave out."""
        points = self._points
        counted = (points.unreliable[first:last] != Unreliable.NOT_COUNTED).astype(np.uint8)
        wanted = int(counted.sum())
        taken = insert_points(self._grid, points.xyz_q[first:last], first, self.settings.cell_limit, counted)
        if taken < last - first:
            raise MapFull("the live map has no cells left: the points are scattered too widely for max_points")
        self._grid_rows = last
        left_out = counted == 0
        _leave_out(points, first, left_out)
        return wanted - int(counted.sum())

    # -- reading ------------------------------------------------------------------------------------------------

    def touch(self, rows: Int32Array) -> None:
        """Announce rows (m,) with the next reading, although the map's own answer stands: a verdict on them changed."""
        self._pending.append(rows)

    def refresh(self) -> Int32Array:
        """Evaluate whatever the lines since the last call reach; returns the rows (m,) whose answer changed, sorted."""
        grid = self._grid
        stale = grid.stale[: grid.stale_used[0]].copy()
        grid.cell_stale[stale] = 0
        grid.stale_used[0] = 0
        changed = self._pending
        self._pending = []
        if len(stale):
            changed += self._evaluate(stale)
        for rows in changed:
            self._list(rows)
        settled = np.empty(self._listed_used, dtype=np.int32)
        waiting = settle_listed(
            self._listed[: self._listed_used], self._points, self._line_state(), self._clearance_q(), settled
        )
        changed.append(settled[: self._listed_used - waiting])
        self._listed_used = waiting
        rows = np.unique(np.concatenate(changed))
        if len(rows):
            self.version += 1
            self._history.append((self.version, rows))
            while len(self._history) > 1 and sum(len(item) for _, item in self._history) > 2 * self._used:
                self._history.popleft()
        return rows

    def changed_since(self, version: int) -> Int32Array | None:
        """The rows that changed after `version`, sorted; None when that is too long ago, and all must be read."""
        if version >= self.version:
            return np.empty(0, dtype=np.int32)
        if not self._history or self._history[0][0] > version + 1:
            return None
        return np.unique(np.concatenate([rows for at, rows in self._history if at > version]))

    def snapshot(self) -> MapSnapshot:
        """Everything the map says, evaluated to the last line taken in; a copy that the engine never touches again."""
        self.refresh()
        return self.rows(np.arange(self._used, dtype=np.int32))

    def rows(self, rows: Int32Array) -> MapSnapshot:
        """The given rows as they were last evaluated; `line` still refers to the whole line table."""
        points = self._points
        radius = points.radius_mm[rows]
        neighbours = points.neighbours[rows]
        unreliable = points.unreliable[rows]
        settled = points.open_passes[rows] == 0
        normals = points.normal[rows].astype(np.float64)
        normals /= np.sqrt((normals * normals).sum(axis=1, keepdims=True))
        return MapSnapshot(
            version=self.version,
            origin_mm=self.origin_mm.copy(),
            points_mm=self.origin_mm + points.xyz_q[rows] * QUANTUM_MM,
            line=points.line[rows],
            index=points.place[rows],
            radius_mm=radius,
            radius_rule=points.radius_rule[rows],
            neighbours=neighbours,
            density_per_mm2=neighbours / (math.pi * radius * radius),
            normals=normals,
            unreliable=unreliable,
            settled=settled,
            isolated=settled & (neighbours <= 3) & (unreliable != Unreliable.NOT_COUNTED),
            offset=points.offset[rows].astype(np.float64),
            residual_mm=points.residual_mm[rows].astype(np.float64),
            normal_error_rad=points.normal_error_rad[rows].astype(np.float64),
            lines=self._lines.table(),
        )

    def _line_state(self) -> Lines:
        laser_q, pass_bit = self._lines.kernel_columns()
        return Lines(laser_q, pass_bit, self._passes.heading, self._passes.front_q)

    def _clearance_q(self) -> float:
        limit = self.settings.max_radius_mm
        if limit is None:
            limit = max(20.0 * self.settings.radius.uncertainty_mm, 2.0 * self._largest_radius_mm)
        return limit / QUANTUM_MM

    def _list(self, rows: Int32Array) -> None:
        self._listed_used = int(list_unsettled(rows, self._points, self._listed, self._listed_used))

    def _evaluate(self, stale: Int32Array) -> list[Int32Array]:
        """Evaluate cells, split among the map's threads; every point belongs to one cell, so none is written twice."""
        lines, clearance_q = self._line_state(), self._clearance_q()

        def work(cells: Int32Array) -> Int32Array:
            changed = np.empty(int(self._grid.cell_count[cells].sum()), dtype=np.int32)
            count = evaluate_cells(
                cells,
                self._grid,
                self._points,
                lines,
                self.settings.needs_lines,
                self.settings.noise_mm,
                self.settings.max_normal_error_rad,
                clearance_q,
                changed,
            )
            return changed[:count]

        if self._pool is None or len(stale) < 256:
            return [work(stale)]
        parts: Iterable[Int32Array] = np.array_split(stale, self.settings.threads)
        return list(self._pool.map(work, parts))


def _clear_answers(points: Points, first: int, last: int) -> None:
    """What a row says before it was ever evaluated."""
    points.neighbours[first:last] = 0
    points.normal[first:last] = np.nan
    points.unreliable[first:last] = Unreliable.TOO_FEW
    points.open_passes[first:last] = _CLOSED_AT_ENTRY
    points.offset[first:last] = np.nan
    points.residual_mm[first:last] = np.nan
    points.normal_error_rad[first:last] = np.nan


def _leave_out(points: Points, first: int, left_out: BoolArray) -> None:
    """Mark rows that are kept but not counted."""
    rows = first + np.flatnonzero(left_out)
    points.unreliable[rows] = Unreliable.NOT_COUNTED
    points.neighbours[rows] = 0
    points.open_passes[rows] &= LISTED
