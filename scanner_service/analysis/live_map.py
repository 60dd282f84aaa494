"""The live map: scanlines go in one by one, and after each the answer for every point equals a batch computation.

Lines are put into a sparse grid at once; what they reach is queued, and evaluated in full when somebody reads. A
point's answer is thus a function of the set of points alone: no order, no batch and no thread leaves a trace. Knows
no session, no database and no client.
"""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array
from scanner_service.analysis.ahead import Ahead
from scanner_service.analysis.brief import Brief, brief_of
from scanner_service.analysis.change_log import ChangeLog
from scanner_service.analysis.describing import Records
from scanner_service.analysis.errors import MapFull
from scanner_service.analysis.flexible import flexible_radii_mm
from scanner_service.analysis.fresh_blocks import blocks_to_evaluate, count_points, forget_fresh, mark_all_fresh
from scanner_service.analysis.gathering import reserve_scratch
from scanner_service.analysis.global_radius import GlobalRadius
from scanner_service.analysis.grid import (
    BLOCKS,
    CELLS,
    CHUNKS,
    cell_side_q,
    insert_points,
    remove_points,
    reserve_grid,
)
from scanner_service.analysis.intake import QUANTUM_MM, StoredLine
from scanner_service.analysis.kernel_rules import Lines, Rules, radius_limit_mm
from scanner_service.analysis.line_columns import LineColumns
from scanner_service.analysis.map_settings import Accepted, MapSettings
from scanner_service.analysis.neighbourhood import evaluate_blocks
from scanner_service.analysis.passes import Pass, PassBook, PassKey
from scanner_service.analysis.points import (
    GROWTH_REACH,
    NOT_COUNTED,
    POINT,
    PointArray,
    gather_points,
    reserve_points,
    write_points,
)
from scanner_service.analysis.radius import line_radius, point_spacing_mm
from scanner_service.analysis.settling import drop_pass, settle_lines
from scanner_service.analysis.snapshot import Int32Array, MapSnapshot, RadiusRule, Unreliable

_AHEAD_ROWS = {"points": 1 << 17, "chunks": 1 << 16, "cells": 1 << 15, "blocks": 1 << 13}
"""Rows of each table that have memory before they are needed: some hundred lines, about 20 MB in all."""

_SHARED_BLOCKS = 600
"""Fewer blocks than this, what some lines touch, are evaluated sooner by the calling thread alone."""

_PARTS_A_THREAD = 8

_KEPT_CHANGES = 500_000
"""Changed rows are remembered for half as many rows as the map has, and at least this many."""


class LiveMap:
    """The accumulated surface of one session.

    Not thread-safe: one thread owns it (the kernels release the GIL and use `settings.threads` threads of their own).
    """

    def __init__(self, settings: MapSettings | None = None, origin_mm: Float64Array | None = None) -> None:
        self.settings = settings or MapSettings()
        self.origin_mm = np.zeros(3) if origin_mm is None else np.array(origin_mm, dtype=np.float64)
        self.version = 0
        self._points: PointArray = reserve_points(self.settings.max_points)
        self._place: Int32Array = np.empty(self.settings.max_points, dtype=np.int32)
        self._settled: Int32Array = np.empty(self.settings.max_points, dtype=np.int32)  # what a kernel found last
        self._used = 0
        self._first_new = 0  # rows from here on were never evaluated
        self._ahead = Ahead(_AHEAD_ROWS)
        self._ahead.watch("points", (self._points, self._place))
        self._grid = reserve_grid(1, 1)
        self._grid_rows = 0
        self._largest_radius_mm = 0.0
        self._lines = LineColumns()
        self._passes = PassBook()
        self._scratch = [reserve_scratch(self.settings.cell_limit) for _ in range(self.settings.threads)]
        self._pending: list[Int32Array] = []
        self._changes = ChangeLog()
        self._rules = Rules(
            needs_lines=self.settings.needs_lines,
            noise_mm=self.settings.noise_mm,
            max_error_rad=self.settings.max_normal_error_rad,
            max_radius_mm=self._max_radius_mm(),
            is_flexible=self.settings.radius.rule == "flexible",
            uncertainty_mm=self.settings.radius.uncertainty_mm,
        )
        self._global = GlobalRadius() if self.settings.radius.rule == "global" else None
        self._pool = ThreadPoolExecutor(self.settings.threads) if self.settings.threads > 1 else None

    def __len__(self) -> int:
        return self._used

    @property
    def line_count(self) -> int:
        """How many scanlines the map has accepted."""
        return len(self._lines)

    def close(self) -> None:
        """End the map's own threads."""
        self._ahead.close()
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
        elif self._rules.is_flexible:
            common, rule = self._rules.max_radius_mm, RadiusRule.FLEXIBLE
        elif self._global is not None and self._global.radius_mm is not None:
            common, rule = self._global.radius_mm, RadiusRule.GLOBAL
        self.can_take(line)
        of = self._passes.enter(line)
        stationary = of.slot >= 0 and of.stands_still_at(line)
        passed_over = "withdrawn" if of.is_withdrawn else "stationary" if stationary else None
        first, last = self._used, self._used + len(line.index)
        radii = np.array([common]) if radius_mm is None else np.ascontiguousarray(radius_mm, dtype=np.float64)
        clearance_mm = float(radius_limit_mm(radii.min(initial=common), self._rules))
        row = self._lines.append(line, of, spacing, stationary, first, clearance_mm, self.origin_mm)
        said = Unreliable.TOO_FEW if passed_over is None else Unreliable.NOT_COUNTED
        write_points(self._points, first, line.xyz_q, row, radii, int(rule), int(said), self._lines.box_q(row))
        self._place[first:last] = line.index
        self._used = last
        if passed_over is not None:
            self._grid_rows = last
            self._pending.append(np.arange(first, last, dtype=np.int32))
            return Accepted(row, common, 0, {passed_over: last - first} if last > first else {})
        if of.slot >= 0:
            self._follow(of, line)
        over_dense = 0
        if self._rules.is_flexible or self._global is not None:
            over_dense = self._reach_at_least(self._rules.max_radius_mm / GROWTH_REACH)  # what a search spans
        if not self._rules.is_flexible:
            over_dense += self._reach_at_least(common)
        over_dense += self._insert(row, first, last)
        if self._global is not None and self._global.wants_estimate(line, first, last):
            over_dense += self._estimate_global()
        return Accepted(row, common, last - first - over_dense, {"over_dense": over_dense} if over_dense else {})

    def close_pass(self, key: PassKey) -> None:
        """The motion is over: its points wait no longer. Closing a pass that is not open does nothing."""
        closed = self._passes.close(key)
        if closed is None:
            return
        first_row, _, _ = self._lines.extents()
        done = drop_pass(first_row, self._points, self._line_state().waits, 1 << closed.slot, self._settled)
        self._pending.append(self._settled[:done].copy())
        self._lines.drop_pass(closed.number)

    def withdraw_pass(self, key: PassKey) -> int:
        """Take a pass out of the map, which then answers as if it had never had it; returns how many points that were.

        The rows stay, marked as not counted, and so do the raw lines in the record. A pass that is unknown or already
        withdrawn has nothing to take out.
        """
        self.close_pass(key)
        number = self._passes.withdraw(key)
        if number is None:
            return 0
        count = 0
        for _, first, last in self._lines.ranges(self._used, number):
            rows = first + np.flatnonzero(self._points["unreliable"][first:last] != NOT_COUNTED)
            count += int(remove_points(self._grid, self._points, rows.astype(np.int32)))
            self._leave_out(rows)
        self._first_new = 0
        return count

    def has_pass(self, key: PassKey) -> bool:
        """True for a pass that is known and not withdrawn."""
        return self._passes.is_in_force(key)

    def pass_keys(self, numbers: Iterable[int]) -> list[PassKey]:
        """The names of passes that are told by their number, as the lines of a snapshot have it."""
        return self._passes.keys_of(numbers)

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
        if self._grid_rows and int(self._grid.used[BLOCKS]) + more > len(self._grid.block):
            raise MapFull(
                "the live map has no room for another line: the points are scattered too widely for "
                f"{self.settings.max_points} max_points; raise it or start another session"
            )

    def _follow(self, of: Pass, line: StoredLine) -> None:
        """Advance the front of a pass; when it stops being steady, all it ever reached waits again."""
        if of.advance(line):
            mark_all_fresh(self._grid)
            self._first_new = 0
        self._passes.publish(of, self.origin_mm)

    def _reach_at_least(self, radius_mm: float) -> int:
        """Make the cells at least as large as the largest radius, building the grid again when they are not.

        Returns how many points that left out.
        """
        if radius_mm <= self._largest_radius_mm:
            return 0
        if cell_side_q(radius_mm, QUANTUM_MM) <= self._grid.side_q[0]:
            self._largest_radius_mm = radius_mm
            return 0
        # Radii that creep up line by line must not build the grid anew each time.
        side_mm = radius_mm if self._largest_radius_mm == 0.0 else 1.25 * radius_mm
        self._largest_radius_mm = radius_mm
        return self._build_grid(cell_side_q(side_mm, QUANTUM_MM))

    def _build_grid(self, side_q: int) -> int:
        """Build the grid anew with cells of this side; every point is evaluated again with the next reading.

        Returns how many points larger cells had to leave out.
        """
        self._grid = grid = reserve_grid(side_q, self.settings.max_points)
        self._ahead.watch("blocks", (grid.block, grid.bits, grid.block_laser_q, grid.fresh))
        self._ahead.watch("cells", (grid.cell,))
        self._ahead.watch("chunks", (grid.chunk, grid.chunk_next))
        self._first_new = 0
        rows, self._grid_rows = self._grid_rows, 0
        return sum(self._insert(line, first, last) for line, first, last in self._lines.ranges(rows))

    def _insert(self, line: int, first: int, last: int) -> int:
        """Put the rows of a line into the grid; returns how many a full cell had to leave out."""
        said = self._points["unreliable"][first:last]
        counted = (said != NOT_COUNTED).astype(np.uint8)
        wanted = int(counted.sum())
        laser_q = self._lines.laser_q(line)
        shares = self.settings.radius.rule == "line"  # the others count points, and entries would be too few
        taken = insert_points(self._grid, self._points, first, line, laser_q, self.settings.cell_limit, shares, counted)
        if taken < last - first:
            raise MapFull("the live map has no cells left: the points are scattered too widely for max_points")
        self._grid_rows = last
        self._fetch_ahead()
        left_out = wanted - int(counted.sum())
        if left_out:
            self._leave_out(first + np.flatnonzero((counted == 0) & (said != NOT_COUNTED)))
        return left_out

    def _fetch_ahead(self) -> None:
        """Have the memory at hand that the next lines will touch."""
        used = self._grid.used.tolist()
        self._ahead.use({"points": self._used, "chunks": used[CHUNKS], "blocks": used[BLOCKS], "cells": used[CELLS]})

    def _estimate_global(self) -> int:
        """Take the median of the sample's flexible radii as the radius of the whole cloud, and re-key the map by it.

        Returns how many points that left out.
        """
        if self._global is None:
            return 0
        rows = self._global.sample()
        rows = rows[self._points["unreliable"][rows] != NOT_COUNTED]
        radii = np.empty(len(rows))
        flexible_radii_mm(rows, self._grid, self._points, self._rules, self._scratch[0], radii)
        radius_mm = self._global.settle_on(radii, self._used)
        if radius_mm is None:
            return 0
        self._points["radius_mm"][: self._used] = radius_mm
        self._points["rule"][: self._used] = RadiusRule.GLOBAL
        self._points["changed_at"][: self._used] = 0  # another radius is another answer, whatever it counts
        self._lines.set_clearance(float(radius_limit_mm(radius_mm, self._rules)))
        self._largest_radius_mm = radius_mm
        side_mm = max(radius_mm, self._rules.max_radius_mm / GROWTH_REACH)
        return self._build_grid(cell_side_q(side_mm, QUANTUM_MM))

    def _leave_out(self, rows: npt.NDArray[np.int64]) -> None:
        """Keep rows without counting them, and without an answer."""
        self._points["unreliable"][rows] = NOT_COUNTED
        for name in ("neighbours", "other_side", "growth"):
            self._points[name][rows] = 0
        for name in ("nx", "ny", "nz", "middle_mm2", "smallest_mm2", "offset_sq"):
            self._points[name][rows] = np.nan
        self._points["open_passes"][rows] = 0
        self._pending.append(rows.astype(np.int32))

    # -- reading ------------------------------------------------------------------------------------------------

    def touch(self, rows: Int32Array) -> None:
        """Announce rows (m,) with the next reading, although the map's own answer stands: a verdict on them changed."""
        self._pending.append(rows)

    def refresh(self) -> Int32Array:
        """Evaluate what the lines since the last call reach; returns the rows (m,) whose answer changed, each once."""
        version = self.version + 1
        blocks = blocks_to_evaluate(self._grid)
        changed = self._evaluate(blocks, version) if len(blocks) else []
        forget_fresh(self._grid)
        self._first_new = self._used
        if self._pending:
            pending = np.unique(np.concatenate(self._pending))
            changed.append(pending[self._points["changed_at"][pending] != version])
            self._points["changed_at"][pending] = version
            self._pending.clear()
        changed.append(self._settle(version))
        rows = np.concatenate(changed)
        if len(rows):
            self.version = version
            self._changes.append(version, rows, keep_rows=max(self._used // 2, _KEPT_CHANGES))
        return rows

    def read_version(self) -> int:
        """The version after everything taken in was evaluated."""
        self.refresh()
        return self.version

    def changed_since(self, version: int) -> Int32Array | None:
        """The rows that changed after `version`, sorted; None when that is too long ago, and all must be read."""
        return self._changes.since(version)

    def snapshot(self) -> MapSnapshot:
        """Everything the map says, evaluated to the last line taken in; a copy that the engine never touches again."""
        self.refresh()
        return self.rows(np.arange(self._used, dtype=np.int32))

    def rows(self, rows: Int32Array) -> MapSnapshot:
        """The given rows as they were last evaluated; `line` still refers to the whole line table."""
        return self.records(rows).describe()

    def records(self, rows: Int32Array) -> Records:
        """The same, yet to be described: a fifth of the work."""
        taken, place = np.empty(len(rows), dtype=POINT), np.empty(len(rows), dtype=np.int32)
        gather_points(self._points, self._place, rows, taken, place)
        return Records(
            taken,
            place,
            self.version,
            self.origin_mm,
            self._lines.table(),
            self.settings.noise_mm,
            self._rules.max_radius_mm,
        )

    def brief(self, rows: Int32Array) -> Brief:
        """What a live stream tells of the given rows, as they were last evaluated."""
        return brief_of(self._points, rows, self._rules.max_radius_mm)

    def _line_state(self) -> Lines:
        laser_q, pass_bit, waits = self._lines.kernel_columns()
        passes = self._passes
        return Lines(laser_q, pass_bit, passes.open_bits, passes.heading, passes.front_q, waits)

    def _settle(self, version: int) -> Int32Array:
        """Let the points settle that the passes have left behind; the rows of those that nothing else changed."""
        extents = self._lines.extents()
        done = settle_lines(*extents, self._points, self._line_state(), self._rules, version, self._settled)
        return self._settled[:done].copy()

    def _max_radius_mm(self) -> float:
        limit = self.settings.max_radius_mm
        return 20.0 * self.settings.radius.uncertainty_mm if limit is None else limit

    def _evaluate(self, blocks: Int32Array, version: int) -> list[Int32Array]:
        """Evaluate blocks, split among the threads; every point belongs to one block, so none is written twice."""
        lines = self._line_state()

        def work(part: Int32Array) -> Int32Array:
            scratch = self._scratch.pop()
            changed = np.empty(count_points(part, self._grid), dtype=np.int32)
            count = evaluate_blocks(
                part, self._grid, self._points, lines, self._rules, version, self._first_new, scratch, changed
            )
            self._scratch.append(scratch)
            return changed[:count]

        if self._pool is None or len(blocks) < _SHARED_BLOCKS:
            return [work(blocks)]
        parts: Iterable[Int32Array] = np.array_split(blocks, _PARTS_A_THREAD * self.settings.threads)
        return list(self._pool.map(work, parts))
