"""The plan of recommended passes that is in force in one session, and the rig that it is for; carries nothing out."""

import logging
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from drivers.scanline import Pose
from scanner_service.rescan.passes.recommendation import Plan
from scanner_service.rescan.passes.serving import EVERYTHING, Serving
from scanner_service.rescan.reference import ReferenceSurface
from scanner_service.rescan.region import RegionStatus
from scanner_service.sessions.errors import SessionError
from scanner_service.sessions.pass_orders import PassOrder
from scanner_service.sessions.pass_planning import PlanQuestion
from scanner_service.sessions.results import Results
from scanner_service.sessions.rig_setups import RigSetup, setup_of
from scanner_service.sessions.session import LiveSession

_LOG = logging.getLogger(__name__)
T = TypeVar("T")

Asked = Callable[[], tuple[Sequence[PassOrder], Pose | None]]


class PlanInForce:
    """Plans for one session, one plan at a time; may be asked from any thread.

    `lock` is that of the desk where orders are taken, and held for moments only; `asked` gives its orders and where the
    sensor stands, and is called with the lock held. `rigs` is the folder in which rig files lie.
    """

    def __init__(self, session: LiveSession, rigs: Path | None, lock: "threading.RLock", asked: Asked) -> None:
        self._session = session
        self._rigs = rigs
        self._lock = lock
        self._asked = asked
        self._planning = threading.Lock()  # one plan is made at a time
        self._changes = 0  # of what plans are made from
        self._setup: RigSetup | None = None
        self._plan: Plan | None = None
        self._marked: Plan | None = None  # what was told of regions is told by this one
        self._planned_for: tuple[object, ...] = ()  # what is served, and what is asked for
        self._planned_against: ReferenceSurface | None = None  # the nominal part

    def describe_rig(self, setup: RigSetup) -> None:
        """State what the rig can do; passes planned before are forgotten."""
        with self._lock:
            self._setup = setup
            self.changed()

    def rig(self, results: Results | None = None) -> RigSetup:
        """What the rig can do, as it was stated or as the session knows it; raises PlanningError when it does not."""
        known = self._setup
        if known is None:
            results = results or self._session.results() or self._session.fresh_results()
            found = setup_of(self._session, results.snapshot, self._rigs)
            with self._lock:  # what was stated meanwhile counts
                known = self._setup = self._setup or found
        return known

    def changed(self) -> None:
        """What is planned from is not what it was."""
        with self._lock:
            self._plan, self._changes = None, self._changes + 1

    def plan(self, serving: Serving) -> Plan:
        """See `PassDesk.plan`."""
        with self._planning:
            return self._planned(serving)

    def foretell(self, serving: Serving) -> Plan:
        """See `PassDesk.foretell`."""
        with self._planning:
            return self._current(serving)[0]

    def take(self, serving: Serving, take: Callable[[Plan], T]) -> T:
        """What `take` makes of the plan in force; nobody plans anew meanwhile, and the desk's lock is held."""
        with self._planning:
            while True:
                plan = self._planned(serving)
                with self._lock:
                    if self._plan is plan:  # else what it was made from has changed since
                        return take(plan)

    def _planned(self, serving: Serving) -> Plan:
        """One thread at a time comes here."""
        plan, results = self._current(serving)
        if serving == EVERYTHING and self._marked is not plan:
            self._marked = plan
            self._mark(results, plan)
        return plan

    def _current(self, serving: Serving) -> tuple[Plan, Results]:
        """The plan for the map as it is, and the verdict on it.

        It is made without the lock, so that whoever asks meanwhile of orders is answered; made again when what it was
        made from has changed meanwhile.
        """
        while True:
            results = self._session.results() or self._session.fresh_results()
            setup, wanted, nominal = self.rig(results), (serving, results.requirement), results.nominal
            with self._lock:
                known, changes = self._plan, self._changes
                is_same = self._planned_for == wanted and self._planned_against is nominal
                if known is not None and known.version == results.report.version and is_same:
                    return known, results
                orders, standing = self._asked()
                question = PlanQuestion.of(orders, results, setup, serving, standing)
            plan = question.answered()
            with self._lock:
                if self._changes == changes:
                    self._plan, self._planned_for, self._planned_against = plan, wanted, nominal
                    return plan, results

    def _mark(self, results: Results, plan: Plan) -> None:
        """Tell of each region whether a pass can bring it."""
        lost = plan.lost_regions
        for region in results.regions:
            is_lost = region.status is RegionStatus.UNREACHABLE
            why = lost.get(region.region_id)
            if why is None and not is_lost:
                continue
            try:
                if why is not None:
                    self._session.mark_region(region.region_id, RegionStatus.UNREACHABLE, why)
                elif region.region_id in plan.reachable_regions:
                    self._session.mark_region(region.region_id, RegionStatus.OPEN, "a pass can reach it now")
            except SessionError as error:  # it was mended meanwhile
                _LOG.info("region %d was not marked: %s", region.region_id, error)
