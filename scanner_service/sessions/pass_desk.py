"""The recommended passes of one session: planned, accepted, carried out, reckoned up; the owner of their state.

Knows the session and the planner, no HTTP. Every step is an event of the session's record.
"""

import logging
import threading
from pathlib import Path

import numpy as np

from drivers.scanline import Pose
from scanner_service.rescan.passes.experience import chances_of, trust_of
from scanner_service.rescan.passes.guidance import Guidance, guide, reaches_end
from scanner_service.rescan.passes.looks import Look, look_of
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.outcome import Outcome, reckon
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from scanner_service.rescan.passes.recommendation import Plan
from scanner_service.rescan.passes.serving import EVERYTHING, Serving, number_of
from scanner_service.rescan.passes.tried import Tried
from scanner_service.rescan.region import RegionStatus
from scanner_service.sessions.closed_loop import LoopLimits, LoopState, run
from scanner_service.sessions.errors import PassUnknown, SessionBusy, SessionError
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
from scanner_service.sessions.results import Results
from scanner_service.sessions.rig_setups import RigSetup, is_driven, setup_of, start_pass
from scanner_service.sessions.session import LiveSession
from scanner_service.sessions.sources import PushSource

_LOG = logging.getLogger(__name__)


class PassDesk:
    """Plans, takes orders and reckons up for one session. Its methods may be called from any thread."""

    def __init__(self, session: LiveSession, rigs: Path | None = None) -> None:
        self._session = session
        self._rigs = rigs  # the folder in which rig files lie
        self._lock = threading.RLock()
        self._setup: RigSetup | None = None
        self._plan: Plan | None = None
        self._planned_for = EVERYTHING
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
            self._setup, self._plan = setup, None

    def plan(self, serving: Serving | None = None) -> Plan:
        """Recommended passes for the map as it is now; made anew only when the map or what is to be served has changed.

        Regions that none of the rig's poses sees are marked as unreachable, and those that one sees after all as
        open again.

        Raises
        ------
        PlanningError : the rig or the optics are not known.
        SessionError : the session is closed, or there is no such region.
        """
        results = self._session.results() or self._session.fresh_results()
        serving = serving or EVERYTHING
        with self._lock:
            if self._plan is None or self._plan.version != results.report.version or self._planned_for != serving:
                self._plan, self._planned_for = self._planned(results, serving), serving
                if serving == EVERYTHING:
                    self._mark(results, self._plan)
            return self._plan

    def accept(self, number: int, serving: Serving | None = None) -> PassOrder:
        """Take an order for a pass of the latest plan.

        Raises
        ------
        PassUnknown : there is no such pass in the plan.
        """
        plan = self.plan(serving)
        with self._lock:
            wanted = next((one for one in plan.passes if one.number == number), None)
            if wanted is None:
                raise PassUnknown(
                    f"there is no pass {number} in the plan for version {plan.version} of the map, which has "
                    f"{len(plan.passes)}; list the recommended passes again"
                )
            order = self._orders.take(wanted, plan.version)
            self._session.event(ACCEPTED, accepted_event(order))
        return order

    def cancel(self, order_id: int, why: str = "cancelled by the user") -> PassOrder:
        """Give an accepted pass up before it is carried out; raises PassUnknown, SessionBusy."""
        with self._lock:
            order = self._orders.cancel(order_id, why)
            self._session.event(CANCELLED, {"order": order_id, "message": why})
        return order

    def carry_out(self, order_id: int, part_is_turned: bool = False) -> PassOrder:
        """Drive an accepted pass; pushed scanlines are waited for where a client or a hand moves the scanner.

        A refused order is cancelled with the reason, whoever gave it; accept it again when that is mended.

        Parameters
        ----------
        part_is_turned : the operator says that the part lies as the pass asks.

        Raises
        ------
        PassUnknown, SessionBusy : there is no such order, or the session or the order is in another state.
        PlanningError : the rig cannot carry it out.
        SourceUnusable, DriverError : the pass could not be started.
        """
        with self._lock:
            order = self._orders.get(order_id)
            if order.status is not PassStatus.ACCEPTED:
                raise SessionBusy(f"pass order {order_id} is {order.status.value}: accept a pass of a new plan")
            try:
                before, setup = self._begun(order, part_is_turned)
            except Exception as error:
                self.cancel(order_id, str(error))
                raise
            order.status = PassStatus.RUNNING
        self._session.event(STARTED, {"order": order.order_id})
        threading.Thread(
            target=self._follow, args=(order, before, setup), name=f"pass-{self._session.row.session_id}", daemon=True
        ).start()
        return order

    def run_loop(self, limits: LoopLimits) -> LoopState:
        """Plan and carry out by itself until nothing is left to do; raises SessionBusy while a loop runs."""
        self.plan(limits.serving)  # what cannot be planned is refused now, not in the loop
        with self._lock:
            if self.is_looping:
                raise SessionBusy("a closed loop is running already: end it first")
            by_client = isinstance(self._session.source, PushSource) and self._setup_now().driven_by_client
            if not (by_client or is_driven(self._session)):
                raise SessionBusy(
                    "a closed loop needs a rig that the service drives, or one that a client drives and is stated so "
                    "(driven_by_client); here passes are scanned by hand"
                )
            loop = self.loop = LoopState(limits)
        threading.Thread(
            target=run,
            args=(self, loop, lambda: self._session.event("loop_ended", loop.to_dict())),
            name=f"rescan-{self._session.row.session_id}",
            daemon=True,
        ).start()
        return loop

    @property
    def is_looping(self) -> bool:
        """True while a closed loop runs, between two of its passes too."""
        return self.loop is not None and self.loop.running

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
        latest = self._session.latest_lines()
        if not latest:
            raise SessionBusy("no scanline has come yet: switch the scanner on and move it over the part")
        line, at_s = latest[-1]
        speed = float("nan")
        if len(latest) > 1 and at_s > latest[0][1]:
            speed = float(np.linalg.norm(line.laser_mm - latest[0][0].laser_mm)) / (at_s - latest[0][1])
        laser = self._setup_now().optics.geometry.laser_mm
        return guide(order.planned, laser, line.laser_mm, line.plane_normal, speed)

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
        if self._setup is None:
            results = results or self._session.results() or self._session.fresh_results()
            self._setup = setup_of(self._session, results.snapshot, self._rigs)
        return self._setup

    def _begun(self, order: PassOrder, part_is_turned: bool) -> tuple[Results, RigSetup]:
        """Start the pass of an order; the verdict before it, and the rig that it goes with. Raises as `carry_out`."""
        other = self._orders.running()
        if other is not None:
            raise SessionBusy(
                f"pass order {other.order_id} is being carried out: wait until it is over, or stop the session, "
                "then accept a pass of the new plan"
            )
        turn = order.planned.turn
        if turn is not None and not turn.is_none and not part_is_turned:
            raise SessionBusy(
                f"first {turn}; then accept the pass again and carry it out, saying that the part is turned "
                '(--turned, or "part_is_turned": true)'
            )
        before = self._session.fresh_results()
        setup, planned = self._setup_now(before), order.planned
        setup.reach.check(planned.motion, planned.start_mm, planned.end_mm, planned.line_spacing_mm)
        start_pass(self._session, planned, self._rigs)
        return before, setup

    def _planned(self, results: Results, serving: Serving) -> Plan:
        setup = self._setup_now(results)
        open_ids = {number_of(region) for region in results.regions}
        unknown = sorted(serving.regions - open_ids)
        if unknown:
            raise PassUnknown(f"no region {unknown[0]} is open in this session; list the regions again")
        required = results.requirement.density_per_mm2
        if required is None:
            required = float(np.nanmedian(results.report.judgement.required_per_mm2)) if len(results.snapshot) else 1.0
        earlier = self._outcomes()
        wishes = Wishes(
            required,
            chances=chances_of(earlier),
            trust=trust_of(earlier),
            requirement=results.requirement,
            serving=serving,
        )
        return plan_passes(
            results.snapshot,
            results.report,
            setup.reach,
            setup.optics,
            wishes,
            self._standing,
            self._tried,
            self._looks(results, setup),
            results.regions,
            results.reference,
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

    def _outcomes(self) -> list[Outcome]:
        """What became of the passes that were carried out to their end, the oldest first."""
        done = [one.outcome for one in self._orders.all() if one.teaches]
        return [outcome for outcome in done if outcome is not None]

    def _looks(self, results: Results, setup: RigSetup) -> tuple[Look, ...]:
        """The passes whose poses are known: those that were ordered, and the session's own."""
        snapshot = results.snapshot
        driven = [
            (number, order.planned.motion, order.planned.start_mm, order.planned.end_mm)
            for order in self._orders.all()
            for number in order.map_passes
        ]
        own = setup.scanned_by
        if isinstance(own, StraightMotion):
            ordered = {number for number, *_ in driven}
            for number in sorted(set(snapshot.lines.pass_number.tolist()) - ordered):
                at = snapshot.lines.position_mm[snapshot.lines.pass_number == number]
                if len(at) and np.isfinite(at).all():
                    driven.append((number, own, float(at[0]), float(at[-1])))
        found = [
            look_of(snapshot, number, motion, start_mm, end_mm, setup.optics.rays)
            for number, motion, start_mm, end_mm in driven
            if isinstance(motion, StraightMotion)
        ]
        return tuple(look for look in found if look is not None)

    def _learn(self, order: PassOrder) -> None:
        """Take in where the sensor stands after a pass, and what it was in vain for.

        A pass that failed or was stopped was in vain for nothing, and where it ended is not known.
        """
        if order.teaches and order.outcome is not None:
            self._tried = self._tried.and_also(order.outcome.missed_mm)
            self._standing = order.planned.end_pose
        elif order.status in (PassStatus.DONE, PassStatus.FAILED):
            self._standing = None

    def _follow(self, order: PassOrder, before: Results, setup: RigSetup) -> None:
        """The thread of one pass: wait for its end, then say what it brought."""
        try:
            self._session.wait_until_over()
            after = self._session.fresh_results()
            outcome = reckon(order.planned, before.snapshot, before.report, after.snapshot, after.report)
            with self._lock:
                fresh = set(after.snapshot.lines.pass_number.tolist()) - set(before.snapshot.lines.pass_number.tolist())
                order.map_passes = sorted(fresh)
                order.outcome = outcome
                taken = np.isin(after.snapshot.lines.pass_number, order.map_passes) & ~after.snapshot.lines.stationary
                laser_mm = setup.optics.geometry.laser_mm
                order.reached_end = reaches_end(order.planned, laser_mm, after.snapshot.lines.laser_mm[taken])
                self._plan = None
                failed = self._session.state == "failed"
                order.message = self._session.status().message if failed else None
                order.status = PassStatus.FAILED if failed else PassStatus.DONE
        except Exception as error:  # noqa: BLE001 - the thread's end: whoever waits for the order must be told
            _LOG.exception("pass order %d of session %s", order.order_id, self._session.row.session_id)
            order.message, order.status = str(error), PassStatus.FAILED
        try:
            with self._lock:
                self._learn(order)
            self._session.event(OUTCOME, outcome_event(order))
        finally:
            order.done.set()
