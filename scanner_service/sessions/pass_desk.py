"""The recommended passes of one session: planned, accepted, carried out, reckoned up; the owner of their state.

Knows the session and the planner, no HTTP. Every step is an event of the session's record.
"""

import logging
import threading
from pathlib import Path

import numpy as np

from drivers.errors import DriverError
from drivers.scanline import Pose
from scanner_service.rescan.passes.guidance import Guidance, guide, reaches_end
from scanner_service.rescan.passes.outcome import reckon
from scanner_service.rescan.passes.recommendation import Plan
from scanner_service.rescan.passes.serving import EVERYTHING, Serving
from scanner_service.rescan.passes.tried import Tried
from scanner_service.rescan.reference import ReferenceSurface
from scanner_service.rescan.region import RegionStatus
from scanner_service.sessions.closed_loop import LoopLimits, LoopState, run
from scanner_service.sessions.errors import PartNotTurned, SessionBusy, SessionError, SourceUnusable
from scanner_service.sessions.pass_orders import (
    ACCEPTED,
    CANCELLED,
    OUTCOME,
    STARTED,
    OrderBook,
    PassOrder,
    PassStatus,
    accepted_event,
    outcome_event,
)
from scanner_service.sessions.pass_planning import PlanQuestion, driven_by, outcomes_of, wanted_of
from scanner_service.sessions.results import Results
from scanner_service.sessions.rig_setups import RigSetup, is_driven, setup_of, start_pass
from scanner_service.sessions.session import LiveSession
from scanner_service.sessions.still_sources import PushSource

_LOG = logging.getLogger(__name__)


class PassDesk:
    """Plans, takes orders and reckons up for one session. Its methods may be called from any thread."""

    def __init__(self, session: LiveSession, rigs: Path | None = None) -> None:
        self._session = session
        self._rigs = rigs  # the folder in which rig files lie
        self._lock = threading.RLock()  # held for moments only: whoever asks is answered at once
        self._planning = threading.Lock()  # one plan is made at a time
        self._setting_off: int | None = None  # the order whose pass is just being started: one at a time
        self._tasks = 0  # passes and loops under way
        self._changes = 0  # of what plans are made from
        self._setup: RigSetup | None = None
        self._plan: Plan | None = None
        self._marked: Plan | None = None  # what was told of regions is told by this one
        self._planned_for: tuple[object, ...] = ()  # what is served, and what is asked for
        self._planned_against: ReferenceSurface | None = None  # the nominal part
        self._orders = OrderBook()
        self._tried = Tried.nothing()
        self._standing: Pose | None = None
        self.loop: LoopState | None = None
        self._orders.restore(session.past_events())
        for order in self._orders.all():
            self._learn(order)

    # -- what a user does ---------------------------------------------------------------------------------------

    def describe_rig(self, setup: RigSetup) -> None:
        """State what the rig can do; passes planned before are forgotten."""
        with self._lock:
            self._setup = setup
            self._changed()

    def plan(self, serving: Serving | None = None) -> Plan:
        """Recommended passes for the map as it is now; made anew when map, requirement or what is served changed.

        Regions that none of the rig's poses sees are marked as unreachable, and those that one sees after all as
        open again.

        Raises
        ------
        PlanningError : the rig or the optics are not known.
        SessionError : the session is closed, or there is no such region.
        """
        with self._planning:
            return self._planned(serving or EVERYTHING)

    def foretell(self, serving: Serving | None = None) -> Plan:
        """The same for whoever only looks: no region is marked, nothing is written; raises as `plan`."""
        with self._planning:
            return self._current_plan(serving or EVERYTHING)[0]

    def accept(self, number: int, serving: Serving | None = None, seen: str | None = None) -> PassOrder:
        """Take an order for a pass of the plan in force.

        Parameters
        ----------
        seen : the name (`name_of`) of the plan in which somebody saw the pass; None takes what is in force.

        Raises
        ------
        PlanOvertaken : the plan that was seen is not in force any more.
        PassUnknown : there is no such pass in the plan.
        """
        with self._planning:  # nobody plans anew meanwhile
            while True:
                plan = self._planned(serving or EVERYTHING)
                with self._lock:
                    if self._plan is not plan:  # what it was made from has changed since
                        continue
                    wanted = wanted_of(plan, number, seen)
                    order = self._orders.take(wanted, plan.version)
                    self._session.event(ACCEPTED, accepted_event(order))
                    return order

    def cancel(self, order_id: int) -> PassOrder:
        """Give an accepted pass up before it is carried out, at once; raises PassUnknown, SessionBusy."""
        with self._lock:
            if self._setting_off == order_id:
                raise SessionBusy(
                    f"pass order {order_id} is just being set off and cannot be cancelled any more: stop the session "
                    "once it scans"
                )
            return self._give_up(order_id, "cancelled by the user")

    def carry_out(self, order_id: int, part_is_turned: bool = False) -> PassOrder:
        """Drive an accepted pass; pushed scanlines are waited for where a client or a hand moves the scanner.

        A refused order is cancelled with the reason, whoever gave it; accept it again when that is mended. One whose
        devices do not set off has failed, with the reason. One for which only the operator's word is missing waits on.

        Parameters
        ----------
        part_is_turned : the operator says that the part lies as the pass asks.

        Raises
        ------
        PassUnknown, SessionBusy : there is no such order, or the session or the order is in another state.
        PartNotTurned : the pass asks for a turn of the part; the order is as it was.
        PlanningError : the rig cannot carry it out.
        SourceUnusable, DriverError : the pass could not be started.
        """
        order = self._claimed(order_id, part_is_turned)
        try:
            before, setup = self._begun(order)
        except Exception as error:
            self._not_begun(order, error)
            raise
        with self._lock:
            order.status, self._setting_off = PassStatus.RUNNING, None
        self._session.event(STARTED, {"order": order.order_id})
        threading.Thread(
            target=self._follow, args=(order, before, setup), name=f"pass-{self._session.row.session_id}", daemon=True
        ).start()
        return order

    def run_loop(self, limits: LoopLimits) -> LoopState:
        """Plan and carry out by itself until nothing is left to do; raises SessionBusy while a loop runs."""
        self.plan(limits.serving)  # what cannot be planned is refused now, not in the loop
        by_client = isinstance(self._session.source, PushSource) and self._setup_now().driven_by_client
        with self._lock:
            if self.loop is not None and self.loop.running:
                raise SessionBusy("a closed loop is running already: end it first")
            if not (by_client or is_driven(self._session)):
                raise SessionBusy(
                    "a closed loop needs a rig that the service drives, or one that a client drives and is stated so "
                    "(driven_by_client); here passes are scanned by hand"
                )
            loop = self.loop = LoopState(limits)
            self._task(+1)
        threading.Thread(
            target=run,
            args=(self, loop, lambda: self._loop_ended(loop)),
            name=f"rescan-{self._session.row.session_id}",
            daemon=True,
        ).start()
        return loop

    def end_loop(self) -> None:
        """End the closed loop after the pass that is under way."""
        if self.loop is not None:
            self.loop.wanted_end.set()

    # -- what a reader asks -------------------------------------------------------------------------------------

    def orders(self) -> list[PassOrder]:
        """All orders, the oldest first."""
        with self._lock:
            return self._orders.all()

    def order(self, order_id: int) -> PassOrder:
        """One order; raises PassUnknown."""
        with self._lock:
            return self._orders.get(order_id)

    def guidance(self, order_id: int) -> Guidance:
        """Where the scanner is beside an accepted pass, from the latest scanlines; raises PassUnknown, SessionBusy."""
        order = self.order(order_id)
        if order.is_over:
            raise SessionBusy(f"pass order {order_id} is {order.status.value}: nobody needs guidance along it any more")
        latest = self._session.hearing.latest_lines()
        if not latest:
            raise SessionBusy("no scanline has come yet: switch the scanner on and move it over the part")
        (first, since_s), (line, at_s) = latest[0], latest[-1]
        way_mm = float(np.linalg.norm(line.laser_mm - first.laser_mm))
        speed = way_mm / (at_s - since_s) if at_s > since_s else float("nan")
        laser = self._setup_now().optics.geometry.laser_mm
        return guide(order.planned, laser, line.laser_mm, line.plane_normal, speed)

    @property
    def is_at_work(self) -> bool:
        """True while a pass is started, carried out or reckoned up, or a closed loop runs."""
        return self._tasks > 0

    # -- what the closed loop asks ------------------------------------------------------------------------------

    def judged(self) -> Results:
        """A verdict on everything that was scanned; raises SessionError when the session is closed."""
        return self._session.fresh_results()

    def wait_for(self, order: PassOrder) -> None:
        """Return when a pass that is being carried out is over."""
        if order.status is PassStatus.RUNNING:
            order.done.wait()

    # -- inside -------------------------------------------------------------------------------------------------

    def _setup_now(self, results: Results | None = None) -> RigSetup:
        known = self._setup
        if known is None:
            results = results or self._session.results() or self._session.fresh_results()
            found = setup_of(self._session, results.snapshot, self._rigs)
            with self._lock:  # what was stated meanwhile counts
                known = self._setup = self._setup or found
        return known

    def _task(self, more: int) -> None:
        """One pass or loop more, or less, is under way."""
        with self._lock:
            self._tasks += more

    def _loop_ended(self, loop: LoopState) -> None:
        try:
            self._session.event("loop_ended", loop.to_dict())
        finally:
            self._task(-1)

    def _changed(self) -> None:
        """What is planned from is not what it was; the lock is held."""
        self._plan, self._changes = None, self._changes + 1

    def _planned(self, serving: Serving) -> Plan:
        """See `plan`; one thread at a time comes here."""
        plan, results = self._current_plan(serving)
        if serving == EVERYTHING and self._marked is not plan:
            self._marked = plan
            self._mark(results, plan)
        return plan

    def _current_plan(self, serving: Serving) -> tuple[Plan, Results]:
        """The plan for the map as it is, and the verdict on it.

        It is made without the lock, so that whoever asks meanwhile of orders is answered; made again when what it was
        made from has changed meanwhile.
        """
        while True:
            results = self._session.results() or self._session.fresh_results()
            setup, wanted, nominal = self._setup_now(results), (serving, results.requirement), results.nominal
            with self._lock:
                known, changes = self._plan, self._changes
                is_same = self._planned_for == wanted and self._planned_against is nominal
                if known is not None and known.version == results.report.version and is_same:
                    return known, results
                question = self._question(results, setup, serving)
            plan = question.answered()
            with self._lock:
                if self._changes == changes:
                    self._plan, self._planned_for, self._planned_against = plan, wanted, nominal
                    return plan, results

    def _claimed(self, order_id: int, part_is_turned: bool) -> PassOrder:
        """The order, now being set off; raises PartNotTurned and leaves it, or SessionBusy.

        It is cancelled where that is for another on its way.
        """
        with self._lock:
            order = self._orders.get(order_id)
            if order.status is not PassStatus.ACCEPTED or self._setting_off == order_id:
                state = "being set off" if self._setting_off == order_id else order.status.value
                raise SessionBusy(f"pass order {order_id} is {state}: accept a pass of a new plan")
            turn = order.planned.turn
            if turn is not None and not turn.is_none and not part_is_turned:
                raise PartNotTurned(
                    f'first {turn}; then carry pass order {order_id} out with {{"part_is_turned": true}}: it waits on'
                )
            running = self._orders.running()
            other = self._setting_off if running is None else running.order_id
            if other is not None:
                why = (
                    f"pass order {other} is being carried out: wait until it is over, or stop the session, then accept "
                    "a pass of the new plan"
                )
                self._give_up(order_id, why)
                raise SessionBusy(why)
            self._setting_off = order_id
            self._tasks += 1
        return order

    def _give_up(self, order_id: int, why: str) -> PassOrder:
        """Cancel an order; the lock is held."""
        order = self._orders.cancel(order_id, why)
        self._session.event(CANCELLED, {"order": order_id, "message": why})
        return order

    def _not_begun(self, order: PassOrder, error: Exception) -> None:
        """An order whose pass was refused is cancelled; it has failed where the devices did not do what they should."""
        try:
            with self._lock:
                self._setting_off = None
                if not isinstance(error, DriverError | SourceUnusable):
                    self._give_up(order.order_id, str(error))
                    return
                order.status, order.message = PassStatus.FAILED, str(error)
                self._learn(order)
            self._session.event(OUTCOME, outcome_event(order))
        finally:
            self._task(-1)
            order.done.set()

    def _begun(self, order: PassOrder) -> tuple[Results, RigSetup]:
        """Start the pass of an order; the verdict before it, and the rig that it goes with. Raises as `carry_out`."""
        before = self._session.fresh_results()
        setup, planned = self._setup_now(before), order.planned
        setup.reach.check(planned.motion, planned.start_mm, planned.end_mm, planned.line_spacing_mm)
        start_pass(self._session, planned, self._rigs)
        return before, setup

    def _question(self, results: Results, setup: RigSetup, serving: Serving) -> PlanQuestion:
        """What is planned from now; the lock is held."""
        orders = self._orders.all()
        return PlanQuestion(
            results, setup, serving, outcomes_of(orders), self._tried, self._standing, driven_by(orders)
        )

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

    def _learn(self, order: PassOrder) -> None:
        """Take in where the sensor stands after a pass, and what it was in vain for; the lock is held.

        A pass that failed or was stopped was in vain for nothing, and where it ended is not known.
        """
        if order.teaches and order.outcome is not None:
            self._tried = self._tried.and_also(order.outcome.missed_mm, order.outcome.empty_mm)
            self._standing = order.planned.end_pose
        elif order.status in (PassStatus.DONE, PassStatus.FAILED):
            self._standing = None
        self._changed()

    def _follow(self, order: PassOrder, before: Results, setup: RigSetup) -> None:
        """The thread of one pass: wait for its end, then say what it brought."""
        try:
            self._session.wait_until_over()
            after = self._session.fresh_results()
            outcome = reckon(order.planned, before.snapshot, before.report, after.snapshot, after.report, setup.optics)
            with self._lock:
                fresh = set(after.snapshot.lines.pass_number.tolist()) - set(before.snapshot.lines.pass_number.tolist())
                order.map_passes = sorted(fresh)
                order.outcome = outcome
                taken = np.isin(after.snapshot.lines.pass_number, order.map_passes) & ~after.snapshot.lines.stationary
                laser_mm = setup.optics.geometry.laser_mm
                order.reached_end = reaches_end(order.planned, laser_mm, after.snapshot.lines.laser_mm[taken])
                failed = self._session.state == "failed"
                order.message = self._session.status().message if failed else None
                order.status = PassStatus.FAILED if failed else PassStatus.DONE
                self._learn(order)
        except Exception as error:  # noqa: BLE001 - the thread's end: whoever waits for the order must be told
            _LOG.exception("pass order %d of session %s", order.order_id, self._session.row.session_id)
            with self._lock:
                order.message, order.status = str(error), PassStatus.FAILED
                self._learn(order)
        try:
            self._session.event(OUTCOME, outcome_event(order))
        finally:
            self._task(-1)
            order.done.set()
