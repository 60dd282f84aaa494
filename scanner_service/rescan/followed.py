"""Regions followed through a scan: which region of a new report is which of the old one, and how far each has come.

A region is known by the surface it covers, cut into cubes of a few radii. A new region takes the id of the old one it
shares most cubes with, of the same reason first. An old region that no new one continues is *resolved* when all points
on its cubes are settled, unless something of its points was not judged again; until then it keeps its status. One whose
pass was withdrawn goes with it, and its history says so. Every change is a moment of its history. Knows no session and
no record.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.scanline import BoolArray
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.judgement import REMEDIES, Reason
from scanner_service.rescan.region import RegionMoment, RegionStatus, RescanRegion
from scanner_service.rescan.stations import IntArray

_CUBE_MM = 1.5
_OVER = 0.1  # share of a region's cubes that a later pass must touch before the region counts as rescanned
_SHOWN = "no verdict finds it any more: what it hid is seen, or there is nothing"
_GONE = "the pass that found it was withdrawn"
_OVER_IS_GONE = "the pass that was over it was withdrawn"
_MOST_MOMENTS = 64
_KEPT_CUBES = 40
_MOST_RESOLVED = 1000


@dataclass(frozen=True, slots=True)
class Change:
    """A moment of one region, to be kept in the record."""

    region_id: int
    reason: Reason
    moment: RegionMoment

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {"region": self.region_id, "reason": self.reason.label, **self.moment.to_dict()}


@dataclass(slots=True)
class _Known:
    region: RescanRegion
    cubes: set[tuple[int, int, int]]
    passes: frozenset[int]  # that had points on it when it was found, or when it last counted as rescanned
    later: frozenset[int] = frozenset()  # those of them that were over it since it was found

    @property
    def found_by(self) -> frozenset[int]:
        """The passes that had points on it when it was found."""
        return self.passes - self.later


class RegionBook:
    """The regions of one session, by id; one thread owns it."""

    def __init__(self) -> None:
        self._known: dict[int, _Known] = {}
        self._resolved: dict[int, _Known] = {}
        self._next = 1
        self._version = -1

    @property
    def current(self) -> tuple[RescanRegion, ...]:
        """Open, rescanned and unreachable regions, by falling priority."""
        return tuple(sorted((known.region for known in self._known.values()), key=lambda region: -region.priority))

    @property
    def resolved(self) -> tuple[RescanRegion, ...]:
        """Regions that meet the requirement now, in the order of their ids; their outline is what it last was."""
        return tuple(known.region for _, known in sorted(self._resolved.items()))

    def follow(self, snapshot: MapSnapshot, regions: Sequence[RescanRegion]) -> list[Change]:
        """Take the regions of a report on `snapshot`; what has changed since the last one.

        A report on an older version than the last changes nothing.
        """
        if snapshot.version < self._version:
            return []
        self._version = snapshot.version
        fresh = [_cubes_of(snapshot, region) for region in regions]
        ids = self._matched(regions, fresh)
        surface = _Surface(snapshot)
        changes: list[Change] = []
        kept: dict[int, _Known] = {}
        for region, cubes, known_id in zip(regions, fresh, ids, strict=True):
            old = self._known.get(known_id) or self._resolved.get(known_id)
            on_it = surface.passes_on(cubes)
            if old is None:
                kept[self._next] = self._begun(region, cubes, on_it, changes)
                self._next += 1
            else:
                kept[known_id] = self._continued(
                    known_id, old, region, cubes, on_it, old.passes - surface.passes, changes
                )
                self._resolved.pop(known_id, None)
        for known_id, old in self._known.items():
            if known_id in kept:
                continue
            is_there = surface.is_there(old.cubes, old.region)
            is_withdrawn = not (old.found_by if is_there else old.passes) <= surface.passes
            if not surface.is_settled(old.cubes) or not (is_there or is_withdrawn):
                kept[known_id] = old  # it waits for points to settle
                continue
            merged = [other for other, cubes in zip(ids, fresh, strict=True) if other and len(cubes & old.cubes)]
            why = "its surface meets the requirement" if old.region.reason is not Reason.SHADOW else _SHOWN
            why = f"is part of region {merged[0]} now" if merged else why
            why = _GONE if is_withdrawn else why
            self._resolved[known_id] = _stepped(known_id, old, RegionStatus.RESOLVED, why, self._version, changes)
        while len(self._resolved) > _MOST_RESOLVED:
            del self._resolved[min(self._resolved)]
        self._known = kept
        return changes

    def mark(self, region_id: int, status: RegionStatus, why: str) -> list[Change]:
        """Set the status of a region that is there (a planner found it unreachable, or reachable after all).

        Raises
        ------
        KeyError : no such region is open.
        """
        changes: list[Change] = []
        old = self._known[region_id]
        if old.region.status is not status or (old.region.history and old.region.history[-1].why != why):
            self._known[region_id] = _stepped(region_id, old, status, why, max(self._version, 0), changes)
        return changes

    def to_dict(self) -> dict[str, Any]:
        """What a later book needs to go on with the same ids, as JSON; cubes are thinned to a few a region."""
        entries = [
            {
                "id": known_id,
                "reason": known.region.reason.label,
                "passes": sorted(known.passes),
                "later": sorted(known.later),
                "cubes": sorted(known.cubes)[:: max(1, len(known.cubes) // _KEPT_CUBES)],
                "history": [moment.to_dict() for moment in known.region.history],
                "line_spacing_mm": _number(known.region.line_spacing_mm),
            }
            for known_id, known in (*self._known.items(), *self._resolved.items())
        ]
        return {"next": self._next, "regions": entries}

    @classmethod
    def from_dict(cls, kept: Mapping[str, Any]) -> "RegionBook":
        """A book that goes on where another was kept; its regions have no outline until the next report.

        Raises
        ------
        KeyError, TypeError, ValueError : it was not kept by `to_dict`.
        """
        book = cls()
        book._next = int(kept["next"])
        for entry in kept["regions"]:
            history = tuple(
                RegionMoment(
                    int(moment["version"]),
                    RegionStatus(moment["status"]),
                    float(moment["area_mm2"]),
                    float(moment["priority"]),
                    str(moment["why"]),
                )
                for moment in entry["history"]
            )
            last = history[-1]
            cubes = {(int(x), int(y), int(z)) for x, y, z in entry["cubes"]}
            reason = Reason[str(entry["reason"]).upper()]
            spacing = entry.get("line_spacing_mm")
            region = RescanRegion(
                number=int(entry["id"]),
                reason=reason,
                outline_mm=(),
                area_mm2=last.area_mm2,
                centroid_mm=(np.array(sorted(cubes), dtype=np.float64).mean(axis=0) + 0.5) * _CUBE_MM,
                normal=np.full(3, np.nan),
                measured_per_mm2=math.nan,
                required_per_mm2=math.nan,
                counting_error_per_mm2=math.nan,
                priority=last.priority,
                point_count=0,
                remedy=REMEDIES[reason],
                point_rows=np.zeros(0, dtype=np.int64),
                region_id=int(entry["id"]),
                status=last.status,
                history=history,
                line_spacing_mm=math.nan if spacing is None else float(spacing),
            )
            passes, later = (frozenset(map(int, entry.get(name, ()))) for name in ("passes", "later"))
            known = _Known(region, cubes, passes, later)
            (book._resolved if last.status is RegionStatus.RESOLVED else book._known)[region.region_id] = known
        return book

    def _begun(
        self, region: RescanRegion, cubes: set[tuple[int, int, int]], passes: frozenset[int], changes: list[Change]
    ) -> _Known:
        moment = RegionMoment(self._version, RegionStatus.OPEN, region.area_mm2, region.priority, "found")
        changes.append(Change(self._next, region.reason, moment))
        known = replace(region, number=self._next, region_id=self._next, history=(moment,))
        return _Known(known, cubes, passes)

    def _continued(
        self,
        known_id: int,
        old: _Known,
        region: RescanRegion,
        cubes: set[tuple[int, int, int]],
        on_it: frozenset[int],
        gone: frozenset[int],
        changes: list[Change],
    ) -> _Known:
        """`on_it` are the passes with points on it now, `gone` those of the ones before that were withdrawn."""
        status, why = old.region.status, ""
        passes, later = on_it | (old.passes - gone), (old.later - gone) | (on_it - old.passes)
        if status is RegionStatus.RESOLVED or not passes - later:  # it is found anew, by those that are on it now
            passes, later = on_it, frozenset()
        if status is RegionStatus.RESOLVED:
            status, why = RegionStatus.OPEN, "fails again"
        elif on_it - old.passes:
            status, why = RegionStatus.RESCANNED, "a later pass was over it, and it fails still"
        elif status is RegionStatus.RESCANNED and gone & old.later and not later:
            status, why = RegionStatus.OPEN, _OVER_IS_GONE
        elif region.reason is not old.region.reason:
            why = f"was {old.region.reason.label} before"
        known = _Known(
            replace(region, number=known_id, region_id=known_id, status=old.region.status, history=old.region.history),
            cubes,
            passes,
            later,
        )
        return _stepped(known_id, known, status, why, self._version, changes) if why else known

    def _matched(self, regions: Sequence[RescanRegion], fresh: list[set[tuple[int, int, int]]]) -> list[int]:
        """The id that each new region takes; 0: a new one."""
        owners: dict[tuple[int, int, int], list[int]] = {}
        pool = {**self._resolved, **self._known}
        for known_id, known in pool.items():
            for cube in known.cubes:
                owners.setdefault(cube, []).append(known_id)
        claims = []
        for at, cubes in enumerate(fresh):
            shared: dict[int, int] = {}
            for cube in cubes:
                for known_id in owners.get(cube, ()):
                    shared[known_id] = shared.get(known_id, 0) + 1
            for known_id, count in shared.items():
                alike = pool[known_id].region.reason is regions[at].reason
                alive = known_id in self._known
                claims.append((not alike, not alive, -count, known_id, at))
        ids = [0] * len(fresh)
        taken: set[int] = set()
        for _, _, _, known_id, at in sorted(claims):
            if not ids[at] and known_id not in taken:
                ids[at] = known_id
                taken.add(known_id)
        return ids


class _Surface:
    """Which passes have points in which cubes of a map, and which cubes hold points that are not settled."""

    def __init__(self, snapshot: MapSnapshot) -> None:
        counted = np.flatnonzero(snapshot.neighbours > 0)
        self._cube = _cube_rows(snapshot.points_mm[counted])
        self._pass = snapshot.lines.pass_number[snapshot.line[counted]]
        self.passes = frozenset(np.unique(self._pass).tolist())  # that are in the map, and not withdrawn
        self._open: BoolArray = ~snapshot.settled[counted]
        key = _key(self._cube)
        self._order = np.argsort(key, kind="stable")
        self._keys = key[self._order]

    def _rows(self, cubes: set[tuple[int, int, int]]) -> list[IntArray]:
        if not cubes:
            return []
        keys = _key(np.array(sorted(cubes), dtype=np.int64))
        first, last = np.searchsorted(self._keys, keys), np.searchsorted(self._keys, keys, side="right")
        return [self._order[a:b].astype(np.int64) for a, b in zip(first.tolist(), last.tolist(), strict=True)]

    def passes_on(self, cubes: set[tuple[int, int, int]]) -> frozenset[int]:
        """Passes with points in a tenth of the cubes at least."""
        seen: dict[int, int] = {}
        for rows in self._rows(cubes):
            for number in np.unique(self._pass[rows]).tolist():
                seen[number] = seen.get(number, 0) + 1
        return frozenset(number for number, count in seen.items() if count >= _OVER * len(cubes))

    def is_settled(self, cubes: set[tuple[int, int, int]]) -> bool:
        """True when no point in the cubes waits."""
        return not any(self._open[rows].any() for rows in self._rows(cubes))

    def is_there(self, cubes: set[tuple[int, int, int]], region: RescanRegion) -> bool:
        """True when the cubes still hold points; untouched surface never had any."""
        return region.reason is Reason.UNTOUCHED or any(len(rows) for rows in self._rows(cubes))


def _stepped(known_id: int, old: _Known, status: RegionStatus, why: str, version: int, changes: list[Change]) -> _Known:
    region = old.region
    moment = RegionMoment(version, status, region.area_mm2, region.priority, why)
    changes.append(Change(known_id, region.reason, moment))
    history = (*region.history, moment)[-_MOST_MOMENTS:]
    return replace(old, region=replace(region, status=status, history=history))


def _cubes_of(snapshot: MapSnapshot, region: RescanRegion) -> set[tuple[int, int, int]]:
    points = [snapshot.points_mm[region.point_rows], *region.outline_mm]
    return {tuple(cube) for cube in np.unique(_cube_rows(np.concatenate(points)), axis=0).tolist()}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _cube_rows(points_mm: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> IntArray:
    return np.floor(points_mm / _CUBE_MM).astype(np.int64)


def _key(cube: IntArray) -> IntArray:
    """One number a cube; coordinates within a million cubes of the origin."""
    shifted = (cube + 2**20) & (2**21 - 1)
    return np.asarray((shifted[:, 0] << 42) | (shifted[:, 1] << 21) | shifted[:, 2], dtype=np.int64)
