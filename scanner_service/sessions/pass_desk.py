"""The recommended passes of one session: planned, accepted, carried out, reckoned up; the owner of their state.

Knows the session and the planner, no HTTP. Every step is an event of the session's record.
"""

import logging
import threading
from pathlib import Path

import numpy as np

from drivers.errors import DriverError
from drivers.scanline import Pose
from scanner_service.analysis.passes import PassKey
from scanner_service.rescan.passes.guidance import Guidance, guide
from scanner_service.rescan.passes.recommendation import Plan
from scanner_service.rescan.passes.serving import EVERYTHING, Serving
from scanner_service.sessions.closed_loop import LoopLimits, LoopState, run
from scanner_service.sessions.errors import PartNotTurned, SessionBusy, SourceUnusable
from scanner_service.sessions.pass_orders import (
    ACCEPTED,
    CANCELLED,
    KEPT,
    OUTCOME,
    STARTED,
    OrderBook,
    PassOrder,
    PassStatus,
    accepted_event,
    outcome_event,
)
from scanner_service.sessions.pass_planning import wanted_of
from scanner_service.sessions.plan_in_force import PlanInForce
from scanner_service.sessions.reckoning import Brought, brought_by
from scanner_service.sessions.results import Results
from scanner_service.sessions.rig_setups import RigSetup, is_driven, start_pass
from scanner_service.sessions.session import LiveSession
from scanner_service.sessions.still_sources import PushSource

_LOG = logging.getLogger(__name__)


class PassDesk:
    """Plans, takes orders and reckons up for one session. Its methods may be called from any thread."""

    def __init__(self, session: LiveSession, rigs: Path | None = None) -> None:
        self._session = session
        self._rigs = rigs  # the folder in which rig files lie
        self._lock = threading.RLock()  # held for moments only: whoever asks is answered at once
        self._plans = PlanInForce(session, rigs, self._lock, lambda: (self._orders.all(), self._standing))
        self._setting_off: int | None = None  # the order whose pass is just being started: one at a time
        self._withdrawing = 0  # how many withdrawals are under way: no pass is set off meanwhile
        self._tasks = 0  # passes and loops under way
        self._orders = OrderBook()
        self._standing: Pose | None = None
        self.loop: LoopState | None = None
        self._orders.restore(session.past_events())
        for order in self._orders.all():
            self._learn(order)
        self._session.doubted = self._orders.doubt()

    # -- what a user does ---------------------------------------------------------------------------------------

    def describe_rig(self, setup: RigSetup) -> None:
        """State what the rig can do; passes planned before are forgotten."""
        self._plans.describe_rig(setup)

    def plan(self, serving: Serving | None = None) -> Plan:
        """Recommended passes for the map as it is now; made anew when map, requirement or what is served changed.

        Regions that none of the rig's poses sees are marked as unreachable, and those that one sees after all as
        open again.

        Raises
        ------
        PlanningError : the rig or the optics are not known.
        SessionError : the session is closed, or there is no such region.
        """
        return self._plans.plan(serving or EVERYTHING)

    def foretell(self, serving: Serving | None = None) -> Plan:
        """The same for whoever only looks: no region is marked, nothing is written; raises as `plan`."""
        return self._plans.foretell(serving or EVERYTHING)

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

        def taken(plan: Plan) -> PassOrder:
            order = self._orders.take(wanted_of(plan, number, seen), plan.version)
            self._session.event(ACCEPTED, accepted_event(order))
            return order

        return self._plans.take(serving or EVERYTHING, taken)

    def cancel(self, order_id: int) -> PassOrder:
        """Give an accepted pass up before it is carried out, at once; raises PassUnknown, SessionBusy."""
        with self._lock:
            if self._setting_off == order_id:
                raise SessionBusy(
                    f"pass order {order_id} is just being set off and cannot be cancelled any more: stop the session "
                    "once it scans"
                )
            return self._give_up(order_id, "cancelled by the user")

    def withdraw(self, order_id: int) -> PassOrder:
        """Take what a pass has scanned out of the map, not of the record; raises PassUnknown, SessionBusy."""
        with self._lock:
            keys = self._orders.to_withdraw(order_id)
        self._take_out(keys)
        return self.order(order_id)

    def withdraw_pass(self, key: PassKey) -> int:
        """Take any pass of the session out of the map; returns how many points that were, 0 when it is not there.

        Raises SessionBusy.
        """
        return self._take_out([key])

    def keep(self, order_id: int) -> PassOrder:
        """Count what a doubted pass has brought after all; raises PassUnknown, SessionBusy."""
        with self._lock:
            order = self._orders.get(order_id)
            order.keep()
            self._decided()  # where the sensor stands is not asked: other passes may have moved it since
            self._session.event(KEPT, {"order": order_id})
        return order

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
        if (doubt := self._orders.doubt()) is not None:  # a plan would be of surface that is not there
            raise SessionBusy(doubt)
        self.plan(limits.serving)  # what cannot be planned is refused now, not in the loop
        by_client = isinstance(self._session.source, PushSource) and self._plans.rig().driven_by_client
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
        laser = self._plans.rig().optics.geometry.laser_mm
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

    def _take_out(self, keys: list[PassKey]) -> int:
        """Withdraw passes, while none is set off: what one brings is told by the surface that was known before it."""
        with self._lock:
            other = self._under_way()
            if other is not None:
                raise SessionBusy(f"pass order {other} is being carried out: withdraw a pass when that is over")
            self._withdrawing += 1
        try:
            points = 0
            for key in keys:
                points += self._session.withdraw_pass(key)
                with self._lock:
                    self._orders.withdrawn(key)
                    self._decided()
            return points
        finally:
            with self._lock:
                self._withdrawing -= 1

    def _task(self, more: int) -> None:
        """One pass or loop more, or less, is under way."""
        with self._lock:
            self._tasks += more

    def _loop_ended(self, loop: LoopState) -> None:
        try:
            self._session.event("loop_ended", loop.to_dict())
        finally:
            self._task(-1)

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
            if self._withdrawing:
                raise SessionBusy(f"a pass is being withdrawn: carry pass order {order_id} out when that is over")
            other = self._under_way()
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

    def _under_way(self) -> int | None:
        """The order that is being set off or carried out; the lock is held."""
        running = self._orders.running()
        return self._setting_off if running is None else running.order_id

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
        setup, planned = self._plans.rig(before), order.planned
        setup.reach.check(planned.motion, planned.start_mm, planned.end_mm, planned.line_spacing_mm)
        start_pass(self._session, planned, self._rigs)
        return before, setup

    def _learn(self, order: PassOrder) -> None:
        """Take in where the sensor stands after a pass; the lock is held.

        Where a pass ended that failed or was stopped, or that lies elsewhere, is not known.
        """
        if order.teaches:
            self._standing = order.planned.end_pose
        elif order.is_over and order.status is not PassStatus.CANCELLED:
            self._standing = None
        self._plans.changed()

    def _decided(self) -> None:
        """The session says what is to be decided of its passes, if there is anything; the lock is held."""
        self._session.doubted = self._orders.doubt()
        self._plans.changed()

    def _follow(self, order: PassOrder, before: Results, setup: RigSetup) -> None:
        """The thread of one pass: wait for its end, then say what it brought."""
        brought: Brought | None = None
        try:
            self._session.wait_until_over()
            after = self._session.fresh_results()
            brought = brought_by(order.planned, before, after, setup, self._session.engine)
            has_failed = self._session.state == "failed"
            failure = (self._session.status().message or "the scan failed") if has_failed else None
        except Exception as error:  # noqa: BLE001 - the thread's end: whoever waits for the order must be told
            _LOG.exception("pass order %d of session %s", order.order_id, self._session.row.session_id)
            failure = str(error)
        try:
            with self._lock:  # the record has what becomes of an order as it comes
                if brought is None:
                    order.message, order.status = failure, PassStatus.FAILED
                else:
                    self._orders.ended(order, brought, failure)
                self._learn(order)
                self._decided()
                self._session.event(OUTCOME, outcome_event(order))
        finally:
            self._task(-1)
            order.done.set()
