"""What is measured and judged of every point of a map that grows, renewed where the map has changed; knows no regions.

What is said of a line depends on the lines around it. So a renewal takes the lines that were *touched*, and those
whose verdict hangs on them; cuts these, with enough lines around them, out of the map; measures and judges the
excerpt as if it was the map; and puts down what is said of them. A verdict on the whole map from nothing is the same
with every line touched. What hangs on what:

    strips, noise      the line and the ones beside it
    gaps               the returns before and after under the same ray, however many lines away: five in a row tell a
                       flank from a shadow; then the whole wall, which is decided over all gaps at once
    verdict            the lines beside, and theirs; what the gaps say of the point; points of other passes near it
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array, SensorGeometry
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.boxes import Boxes, boxes_of
from scanner_service.rescan.columns import Columns
from scanner_service.rescan.excerpt import excerpt_of, rows_of_lines
from scanner_service.rescan.frames import Frames, angle_and_depth, frames_of
from scanner_service.rescan.gaps import (
    Fan,
    GapKind,
    Gaps,
    column_of,
    find_pairs,
    gaps_between,
    marks_of,
)
from scanner_service.rescan.judgement import Judgement, asked_of_the_first_pass, judge
from scanner_service.rescan.partners import partners
from scanner_service.rescan.requirement import Requirement
from scanner_service.rescan.rungs import settled_kinds
from scanner_service.rescan.stations import IntArray, Stations, stations_of
from scanner_service.rescan.strips import Strips, strips_of
from scanner_service.rescan.unseen import AIR, left_by_others, nearer_first, open_sides, windows_of

_HOPS = 2  # a point is judged by the lines beside it, and these by those beside them
_SHIFT = 2  # pairs on either side whose jumps tell the kind of a pair
_ROWS = ("chain", "link", "beside", "order")  # of strips: rows of the map


@dataclass(frozen=True, slots=True)
class Judged:
    """All that is measured and judged of the points of one map; `strips` and `fan` are so until the next renewal only.

    `rows` (k,) are the points that were judged again for it.
    """

    stations: Stations
    frames: Frames
    strips: Strips
    fan: Fan
    gaps: Gaps
    judgement: Judgement
    rows: IntArray


class PointVerdicts:
    """Strips, gaps and verdicts of one map under one requirement; arguments as `find_regions` has them."""

    def __init__(
        self,
        requirement: Requirement,
        geometry: SensorGeometry | None,
        noise_mm: float | None,
        towards_sensor: Float64Array | None,
    ) -> None:
        self._requirement = requirement
        self._geometry = geometry
        self._noise_mm = noise_mm
        self._towards_sensor = towards_sensor
        self._forget()

    def _forget(self) -> None:
        self._columns = Columns()
        self._count = 0
        self._stations: Stations | None = None
        self._frames: Frames | None = None
        self._boxes = Boxes(np.zeros((0, 3)), np.zeros((0, 3)))
        self._rays: list[IntArray] = []  # of each line the columns of the fan in which it has returns
        self._asked = np.inf

    def renew(self, snapshot: MapSnapshot, changed: IntArray | None = None) -> Judged:
        """Judge the map; `changed` (k,) are the rows that are new or other than at the last renewal, None: any."""
        if changed is None or self._is_another(snapshot, changed):
            self._forget()
            changed = np.arange(len(snapshot), dtype=np.int64)
        stations = stations_of(snapshot.lines)
        frames = self._frames_of(snapshot, stations)
        touched = self._touched(snapshot, stations, frames, changed)
        self._stations, self._frames, self._count = stations, frames, len(snapshot)
        core = _with_adjacent(stations, touched, _HOPS)
        self._measure(snapshot, stations, frames, core)
        gaps = self._gaps(snapshot, stations, frames, changed)
        marks = marks_of(len(snapshot), gaps)
        other = np.zeros(len(core), dtype=bool)
        other[snapshot.line[marks != self._columns.view("marks", len(snapshot))]] = True
        self._columns.put(slice(len(snapshot)), marks=marks)
        rows = self._judge(snapshot, stations, frames, core | _with_adjacent(stations, other, 1))
        everything = slice(len(snapshot))
        strips, fan = Strips(**self._columns.views("strips", everything)), Fan(**self._columns.views("fan", everything))
        judgement = Judgement(**self._columns.copies("judgement", everything))
        return Judged(stations, frames, strips, fan, gaps, judgement, rows)

    def _is_another(self, snapshot: MapSnapshot, changed: IntArray) -> bool:
        """Whether the map is one that nothing is known of: points that counted do not any more, or the other way."""
        if self._stations is None or len(snapshot) < self._count:
            return True
        if self._requirement.chord_error_mm is not None and self._noise_mm is None:
            return True  # the noise is then taken from all points
        known = changed[changed < self._count]
        return bool((self._columns.view("counted", self._count)[known] != (snapshot.neighbours[known] > 0)).any())

    def _frames_of(self, snapshot: MapSnapshot, stations: Stations) -> Frames:
        """The frames of the passes, taken over as long as passes keep their numbers."""
        known = self._stations
        same = known is not None and bool((stations.group[: len(known.group)] == known.group).all())
        return frames_of(snapshot, stations, self._towards_sensor, self._frames if same else None)

    def _touched(self, snapshot: MapSnapshot, stations: Stations, frames: Frames, changed: IntArray) -> BoolArray:
        """(L,) Lines of which something is other than it was, or near to which points of other passes changed."""
        known = self._stations
        touched = np.ones(len(stations.group), dtype=bool) if known is None else stations.differs(known)
        asked = asked_of_the_first_pass(snapshot.lines, stations, frames, self._requirement)
        turned = np.zeros(len(touched), dtype=bool)  # lines whose pass has another frame
        if self._frames is not None and known is not None:
            old = np.full(len(frames), -1, dtype=np.int64)
            old[: len(self._frames)] = self._frames.lines[: len(frames)]
            turned = (frames.lines != old)[stations.group]
            if not (stations.group[: len(known.group)] == known.group).all():
                turned[:] = True
            if frames.several != self._frames.several or asked != self._asked:
                touched[:] = True
        touched |= turned
        touched[snapshot.line[changed]] = True
        turned[len(self._rays) :] = True
        self._asked = asked
        self._place(snapshot, stations, frames, np.flatnonzero(turned), changed)
        if self._looks_around(frames):
            rows = np.sort(changed)
            rows = rows[snapshot.neighbours[rows] > 0]
            line, owner = np.unique(snapshot.line[rows], return_inverse=True)
            news = boxes_of(snapshot.points_mm[rows], owner.astype(np.int64), len(line))
            touched |= self._boxes.grown(self._sight_mm(snapshot, stations)).meet(news)
        return touched

    def _place(
        self, snapshot: MapSnapshot, stations: Stations, frames: Frames, lines: IntArray, changed: IntArray
    ) -> None:
        """Note where the points of some lines lie: in the fan, and in which box; and which points count."""
        self._columns.make_room(len(snapshot))
        rows = rows_of_lines(snapshot, lines)
        line, group = snapshot.line[rows], stations.group[snapshot.line[rows]]
        owner = np.searchsorted(lines, line).astype(np.int64)
        along, axis = frames.of_lines(snapshot.lines, lines, stations.group[lines])
        angle, depth = angle_and_depth(
            snapshot.points_mm[rows] - snapshot.lines.laser_mm[line], along[owner], axis[owner]
        )
        self._columns.put(rows, **{"fan.angle_rad": angle, "fan.depth_mm": depth})
        self._columns.put(changed, counted=snapshot.neighbours[changed] > 0, marks=np.zeros(len(changed), np.uint8))
        count = len(stations.group)
        boxes = boxes_of(snapshot.points_mm[rows], owner, len(lines))
        low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
        low[: len(self._boxes)], high[: len(self._boxes)] = self._boxes.low_mm, self._boxes.high_mm
        low[lines], high[lines] = boxes.low_mm, boxes.high_mm
        self._boxes = Boxes(low, high)
        self._rays += [np.zeros(0, dtype=np.int64)] * (count - len(self._rays))
        seen = (snapshot.neighbours[rows] > 0) & (frames.pitch_rad[group] > 0)
        column = column_of(Fan(angle, depth), frames, np.flatnonzero(seen), group[seen])
        border = np.searchsorted(line[seen], lines), np.searchsorted(line[seen], lines, side="right")
        for at, first, last in zip(lines.tolist(), *(side.tolist() for side in border), strict=True):
            self._rays[at] = np.unique(column[first:last])

    def _measure(self, snapshot: MapSnapshot, stations: Stations, frames: Frames, core: BoolArray) -> None:
        """Measure strips and pairs of the core lines anew."""
        far = partners(stations, self._rays, core, 2 * _SHIFT + 1)
        lines = np.flatnonzero(_with_adjacent(stations, core | far, 1))
        rows = rows_of_lines(snapshot, lines)
        excerpt, own_stations = excerpt_of(snapshot, lines, rows), stations.part(lines)
        strips, fan = strips_of(excerpt, own_stations, frames, self._requirement), self._fan(rows)
        is_core = core[lines][excerpt.line]
        home = np.append(rows, -1)
        own = slice(None) if is_core.all() else is_core  # no copies of a whole map
        values = {f"strips.{name}": getattr(strips, name)[own] for name in Strips.__slots__}
        values |= {f"strips.{name}": home[values[f"strips.{name}"]].astype(np.int32) for name in _ROWS}
        self._columns.put(rows[own], **values)
        del values
        for side, pairs in enumerate(find_pairs(excerpt, own_stations, frames, strips, fan, self._geometry)):
            kept = is_core[pairs.first] | is_core[pairs.second]
            goes_on = pairs.first[1:] == pairs.second[:-1]
            for _ in range(_SHIFT):
                before, after = kept[1:] & goes_on, kept[:-1] & goes_on
                kept[:-1] |= before
                kept[1:] |= after
            nothing = np.zeros(int(is_core.sum()), dtype=np.uint8)
            self._columns.put(rows[is_core], **{f"kind.{side}": nothing})
            second = rows[pairs.second[kept]]
            found: dict[str, npt.NDArray[Any]] = {
                f"kind.{side}": pairs.kind[kept],
                f"first.{side}": rows[pairs.first[kept]].astype(np.int32),
                f"is_down.{side}": pairs.is_down[kept],
                f"left.{side}": np.zeros((len(second), 2), dtype=np.int32),
            }
            self._columns.put(second, **found)

    def _gaps(self, snapshot: MapSnapshot, stations: Stations, frames: Frames, changed: IntArray) -> Gaps:
        """All gaps of the map, each wall of one kind; of shadows what other passes have left of them."""
        ends: list[tuple[npt.NDArray[Any], ...]] = []
        for side in (0, 1):
            second = np.flatnonzero(self._columns.view(f"kind.{side}", len(snapshot))).astype(np.int64)
            columns = [self._columns.view(f"{name}.{side}", len(snapshot)) for name in ("first", "kind", "is_down")]
            first, kind, is_down = (column[second] for column in columns)
            ends.append((first, second, kind, is_down))
        firsts, seconds, kinds, downs = zip(*ends, strict=True)
        fan = Fan(**self._columns.views("fan", slice(len(snapshot))))
        strips = Strips(**self._columns.views("strips", slice(len(snapshot))))
        gaps = gaps_between(snapshot, stations, frames, fan, firsts, seconds, kinds, downs)
        gaps = settled_kinds(snapshot, strips, gaps)
        if frames.several:
            gaps = self._left(snapshot, stations, frames, strips, gaps, seconds, changed)
        if self._requirement.interest is None:
            return gaps
        inside = self._requirement.interest.holds
        beyond = ~(inside(snapshot.points_mm[gaps.high]) | inside(snapshot.points_mm[gaps.low]))
        return replace(gaps, kind=np.where(beyond, np.uint8(GapKind.HOLE), gaps.kind))

    def _left(
        self, snapshot: MapSnapshot, stations: Stations, frames: Frames, strips: Strips, gaps: Gaps,
        second: tuple[IntArray, ...], changed: IntArray,
    ) -> Gaps:  # fmt: skip
        """The gaps, shadows with the ends of what other passes have left of them; looked at where something is new."""
        rows = gaps.of_kind(GapKind.SHADOW).astype(np.int64)
        left = np.concatenate(
            [self._columns.view(f"left.{side}", len(snapshot))[second[side]] for side in (0, 1)]
        )  # both 0: not looked at yet
        left[gaps.kind != GapKind.SHADOW] = 0  # and what is no shadow now is looked at when it is one again
        reach = strips.reach_mm[gaps.high[rows]]
        windows = windows_of(snapshot, gaps, rows, reach)
        news = boxes_of(snapshot.points_mm[changed], np.arange(len(changed)), len(changed))
        asked = ~left[rows].any(axis=1) | windows.meet(news)
        near = rows_of_lines(snapshot, np.flatnonzero(self._boxes.meet(windows.part(asked))))
        left[rows[asked]] = left_by_others(snapshot, frames, stations, gaps, rows[asked], reach[asked], near)
        for side, of_side in enumerate(np.split(left, [len(second[0])])):
            self._columns.put(second[side], **{f"left.{side}": of_side})
        kind, high, low = gaps.kind.copy(), gaps.high.copy(), gaps.low.copy()
        filled = left[rows, 0] < 0
        kind[rows[filled]] = np.where(left[rows[filled], 0] == AIR, GapKind.HOLE, GapKind.FILLED)
        rows = rows[~filled]
        ends = nearer_first(snapshot, gaps, rows, left[rows])
        high[rows], low[rows] = ends.T
        open_side = np.full((len(gaps), 3), np.nan)
        open_side[rows] = open_sides(snapshot, frames, gaps, rows, left[rows])
        return replace(gaps, kind=kind, high=high, low=low, open_side=open_side)

    def _judge(self, snapshot: MapSnapshot, stations: Stations, frames: Frames, lines_judged: BoolArray) -> IntArray:
        """Judge the points of some lines anew; their rows."""
        around = _with_adjacent(stations, lines_judged, _HOPS)
        if self._looks_around(frames):
            own = _with_adjacent(stations, lines_judged, 1)
            around |= self._boxes.meet(self._boxes.grown(self._sight_mm(snapshot, stations)).part(own))
        lines = np.flatnonzero(around)
        rows = rows_of_lines(snapshot, lines)
        excerpt = excerpt_of(snapshot, lines, rows)
        found = judge(
            excerpt,
            self._requirement,
            stations.part(lines),
            frames,
            self._strips(rows),
            self._fan(rows),
            self._columns.view("marks", len(snapshot))[rows],
            self._geometry,
            self._noise_mm,
            self._asked,
        )
        is_own: BoolArray | slice = lines_judged[lines][excerpt.line]
        if lines_judged[lines].all():
            is_own = slice(None)
        self._columns.put(
            rows[is_own], **{f"judgement.{name}": getattr(found, name)[is_own] for name in Judgement.__slots__}
        )
        return rows[is_own]

    def _looks_around(self, frames: Frames) -> bool:
        """Whether verdicts hang on points of lines that are neither adjacent nor under the same rays."""
        return frames.several or self._requirement.chord_error_mm is not None

    def _sight_mm(self, snapshot: MapSnapshot, stations: Stations) -> Float64Array:
        """(L,) how far from the points of a line a point may be that its verdict hangs on."""
        asked, c = self._requirement, self._requirement.radius_constant_mm
        reach = np.sqrt(2.0) * np.fmax(snapshot.lines.line_spacing_mm, stations.point_spacing_mm) + c
        stride = np.where(np.isfinite(stations.stride_mm), stations.stride_mm, 0.0).max(axis=1, initial=0.0)
        search = (
            np.maximum(20.0 * c, 4.0 * reach) if asked.search_mm is None else np.maximum(asked.search_mm, 4 * reach)
        )
        return np.asarray(np.maximum(search, 2.0 * stride) + reach)

    def _fan(self, rows: IntArray | slice) -> Fan:
        return Fan(**self._columns.copies("fan", rows))

    def _strips(self, rows: IntArray | slice) -> Strips:
        """The strips of some points (rising rows of whole lines), which then are rows among themselves."""
        values = self._columns.copies("strips", rows)
        if isinstance(rows, slice) or len(rows) in (0, self._count):
            return Strips(**values)
        for name in _ROWS:
            place = np.minimum(np.searchsorted(rows, values[name]), len(rows) - 1)
            values[name] = np.where(rows[place] == values[name], place, -1)
        return Strips(**values)


def _with_adjacent(stations: Stations, lines: BoolArray, hops: int) -> BoolArray:
    """(L,) Some lines, and those that are at most so many lines before or after one of them in its pass."""
    marks = lines.copy()
    for _ in range(hops):
        beside = stations.adjacent[marks]
        marks[beside[beside >= 0]] = True
    return marks
