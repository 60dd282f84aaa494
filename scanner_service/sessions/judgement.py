"""The verdict in force on a live session: renewed when it is asked to, regions followed through; decides no state.

Any thread may ask for a verdict. The map is read through its engine, the copy of it and the regions are owned here.
"""

import contextlib
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from drivers.scanline import SensorGeometry
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.coverage import Coverage, CoverageBook
from scanner_service.rescan.followed import Change, RegionBook
from scanner_service.rescan.region import RegionStatus
from scanner_service.rescan.regions import RegionFinder, RegionReport
from scanner_service.rescan.requirement import Requirement
from scanner_service.rescan.stations import IntArray
from scanner_service.sessions.engine import Engine
from scanner_service.sessions.errors import SessionError
from scanner_service.sessions.left_regions import (
    REGIONS_CHANGED,
    REGIONS_FOLLOWED,
    LeftRegions,
    as_in,
    to_leave,
)
from scanner_service.sessions.mirror import Mirror
from scanner_service.sessions.references import Nominal
from scanner_service.sessions.results import Results, conclude
from scanner_service.sessions.source import Source
from scanner_service.sessions.updates import VerdictBook

T = TypeVar("T")

WriteEvent = Callable[[str, dict[str, Any]], None]
Begins = Callable[[str], None]


class Judgement:
    """Verdicts on one session, the latest of which is in force.

    `verdicts` is the engine's book of them, into which each new one is put; `write_event` takes what became of regions;
    `now_s` tells seconds.
    """

    def __init__(
        self,
        engine: Engine,
        verdicts: VerdictBook,
        requirement: Requirement,
        nominal: Nominal,
        write_event: WriteEvent,
        now_s: Callable[[], float],
    ) -> None:
        self._engine = engine
        self._verdicts = verdicts
        self._requirement = requirement
        self._nominal = nominal
        self._write_event = write_event
        self._now_s = now_s
        self._read_s = math.nan  # when the map was read that the results are of
        self._regions = RegionBook()
        self._left: LeftRegions | None = None
        self._is_as_left = False  # the results list the regions that were left, of the same verdict
        self._results: Results | None = None
        self._judging = threading.Lock()
        self._in_force = threading.Lock()  # of the regions and the results
        self._mirror = Mirror()
        self._finder: RegionFinder | None = None
        self._coverage = CoverageBook()
        self._seen_from: tuple[object, ...] = ()  # what the finder judges by
        self._mirroring = threading.Lock()

    def results(self) -> Results | None:
        """The latest verdict; None before the first."""
        return self._results

    def age_s(self) -> float:
        """How long ago the map was read that the latest verdict is on; NaN before the first."""
        return self._now_s() - self._read_s

    def read_map(self) -> None:
        """Take over what changed of the map since the last reading, so that no reading holds the engine up for long."""
        with contextlib.suppress(SessionError), self._mirroring:
            self._mirror.catch_up(self._ask, self._ask_between)

    def go_on_from(self, left: LeftRegions) -> None:
        """Follow the regions that an earlier opening left; before the first verdict only."""
        self._left, self._regions = left, left.book()

    def compare_with(self, left: LeftRegions) -> None:
        """List, as soon as the verdict is the same, the regions that another playing of the same lines left."""
        self._left = left

    def judge_by(self, requirement: Requirement, nominal: Nominal) -> None:
        """Ask for something else from the next verdict on; regions left of another requirement are not compared."""
        with self._judging, self._in_force:
            self._requirement, self._nominal = requirement, nominal
            self._left, self._is_as_left = None, False
            self._finder = None  # it knows verdicts by what was asked before

    def renew(self, source: Source, only_new: bool = False, begins: Begins = lambda step: None) -> Results | None:
        """Judge the map as it is, seen from that source; None when the engine is gone.

        With `only_new` the verdict in force is the answer while the map is as it was. Verdicts are reached one after
        the other, so that map and regions of each are of one version. `begins` hears of each step, see `awaited.STEPS`.
        """
        with self._judging:
            return self._judge(source, only_new, begins)

    def _judge(self, source: Source, only_new: bool, begins: Begins) -> Results | None:
        try:
            if only_new and self._results is not None and self._map_version() == self._results.snapshot.version:
                return self._results
            begins("reading the map")
            with self._mirroring:
                read_s = self._now_s()
                self._mirror.catch_up(self._ask, self._ask_between)
                snapshot, changed = self._mirror.changes()
            report, coverage = self._found_again(snapshot, changed, source, begins)
            begins("following the regions")
            nominal = self._nominal
            found = conclude(snapshot, self._requirement, report, coverage, nominal.surface, nominal.refused)
            with self._in_force:
                results, changes = self._follow(found)
            self._tell(changes)
            self._engine.ask(
                lambda engine: self._verdicts.replace(results.verdict, snapshot.version, engine.live_map)
            ).result()
        except SessionError:
            return None
        with self._in_force:
            results = self._results = self._followed(results)  # somebody may have marked a region meanwhile
            self._read_s = read_s
        return results

    def _found_again(
        self, snapshot: MapSnapshot, changed: IntArray, source: Source, begins: Begins
    ) -> tuple[RegionReport, Coverage]:
        """Regions and coverage of the map, of which these rows have changed; from nothing when it is seen otherwise."""
        towards = source.towards_sensor
        seen_from = _values_of(source.geometry), None if towards is None else tuple(towards.tolist())
        if self._finder is None or seen_from != self._seen_from:
            self._finder = RegionFinder(self._requirement, source.geometry, towards_sensor=towards)
            self._coverage = CoverageBook()
            self._seen_from = seen_from
        try:
            begins("looking for regions")
            report = self._finder.find(snapshot, changed)
            begins("measuring coverage")
            return report, self._coverage.renew(snapshot, report, self._finder.renewed)
        except BaseException:
            self._finder = None  # what it knows is half renewed
            raise

    def mark_region(self, region_id: int, status: RegionStatus, why: str) -> None:
        """Say of a region that it is unreachable, or that it is not after all; written down.

        Raises
        ------
        SessionError : no such region is open.
        """
        with self._in_force:
            try:
                changes = self._regions.mark(region_id, status, why)
            except KeyError:
                raise SessionError(f"there is no open region {region_id} in this session") from None
            if self._results is not None:
                self._results = self._followed(self._results)
        self._tell(changes)

    def write_regions_down(self) -> None:
        """Leave the regions as they are now to a later opening."""
        with self._in_force:
            self._write_event(REGIONS_FOLLOWED, to_leave(self._regions, self._results))

    def _follow(self, found: Results) -> tuple[Results, list[Change]]:
        """The results with their regions followed, and what has changed; of a verdict that was left, as it was left."""
        if self._left is not None:
            told = self._left.told_of(found)
            if told is not None:
                if not self._is_as_left:
                    self._regions, self._is_as_left = self._left.book(), True
                return self._followed(told), []
            if self._is_as_left:  # there is more now than was left
                self._left, self._is_as_left = None, False
        changes = self._regions.follow(found.snapshot, found.regions)
        return self._followed(found), changes

    def _followed(self, results: Results) -> Results:
        """The results, their regions with the ids, the status and the history that they have had."""
        if self._is_as_left:
            told = as_in(self._regions, results.regions), as_in(self._regions, results.resolved)
            return replace(results, regions=told[0], resolved=told[1])
        return replace(results, regions=self._regions.current, resolved=self._regions.resolved)

    def _tell(self, changes: Sequence[Change]) -> None:
        if changes:
            self._write_event(REGIONS_CHANGED, {"changes": [change.to_dict() for change in changes]})

    def _map_version(self) -> int:
        return self._ask(lambda live_map: live_map.read_version())

    def _ask(self, question: Callable[[LiveMap], T]) -> T:
        return self._engine.ask(lambda engine: question(engine.live_map)).result()

    def _ask_between(self, question: Callable[[LiveMap], T]) -> T:
        return self._engine.ask_between(lambda engine: question(engine.live_map)).result()


def _values_of(geometry: SensorGeometry | None) -> tuple[object, ...]:
    """A geometry as numbers that can be compared."""
    if geometry is None:
        return ()
    laser_mm, camera_mm = np.asarray(geometry.laser_mm), np.asarray(geometry.camera_mm)
    return (*laser_mm.tolist(), *camera_mm.tolist(), *geometry.range_mm, geometry.noise_mm)
