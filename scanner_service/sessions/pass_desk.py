"""The recommended passes of one session: planned, accepted, carried out, reckoned up; the owner of their state.

Knows the session and the planner, no HTTP. Every step is an event of the session's record.
"""

import dataclasses
import logging
import threading
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from drivers.errors import DriverError, PortBusy, ScannerSilent
from drivers.rig import Rig
from drivers.rig_limits import AxisKind, RigLimits
from drivers.scanline import Pose
from scanner_service.rescan.passes.errors import OpticsUnknown, PlanningError, RigUnlimited
from scanner_service.rescan.passes.fan import measured_optics
from scanner_service.rescan.passes.guidance import Guidance, guide
from scanner_service.rescan.passes.looks import Look, look_of
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.outcome import Outcome, reckon, trust_of
from scanner_service.rescan.passes.planner import Tried, Wishes, plan_passes
from scanner_service.rescan.passes.reach import Reach
from scanner_service.rescan.passes.recommendation import Plan, RecommendedPass
from scanner_service.sessions.errors import PassUnknown, SessionBusy, SessionError
from scanner_service.sessions.results import Results
from scanner_service.sessions.session import LiveSession
from scanner_service.sessions.source_specs import DeviceSpec
from scanner_service.sessions.sources import DeviceSource, PushSource, Source

_LOG = logging.getLogger(__name__)
_DRIVING = StraightMotion(Pose.identity(), np.array([0.0, 1.0, 0.0]))  # the default rig: part = (x, position, z)


class PassStatus(StrEnum):
    """How far an accepted pass has come."""

    ACCEPTED = "accepted"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class RigSetup:
    """What a session's rig can do, and what its scanner can see."""

    reach: Reach
    optics: ScannerOptics


@dataclass(slots=True)
class PassOrder:
    """A pass that was accepted: which one, how far it has come, and what became of it."""

    order_id: int
    planned: RecommendedPass
    version: int
    status: PassStatus = PassStatus.ACCEPTED
    outcome: Outcome | None = None
    message: str | None = None

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "order": self.order_id,
            "version": self.version,
            "status": self.status.value,
            "message": self.message,
            "pass": self.planned.to_dict(),
            "outcome": self.outcome.to_dict() if self.outcome else None,
        }


@dataclass(frozen=True, slots=True)
class LoopLimits:
    """When a closed loop ends at the latest: passes, and seconds of passes with the way to them."""

    max_passes: int = 20
    max_seconds: float = 600.0
    coverage_share: float | None = None


@dataclass(slots=True)
class LoopState:
    """A closed loop under way, or why it ended."""

    limits: LoopLimits
    passes: int = 0
    seconds: float = 0.0
    running: bool = True
    why_ended: str | None = None
    wanted_end: threading.Event = field(default_factory=threading.Event)

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "running": self.running,
            "passes": self.passes,
            "seconds": self.seconds,
            "max_passes": self.limits.max_passes,
            "max_seconds": self.limits.max_seconds,
            "coverage_share": self.limits.coverage_share,
            "why_ended": self.why_ended,
        }


class PassDesk:
    """Plans, takes orders and reckons up for one session. Its methods may be called from any thread."""

    def __init__(self, session: LiveSession) -> None:
        self._session = session
        self._lock = threading.RLock()
        self._setup: RigSetup | None = None
        self._plan: Plan | None = None
        self._orders: list[PassOrder] = []
        self._tried = Tried.nothing()
        self._driven: list[tuple[int, StraightMotion, float, float]] = []
        self._standing: Pose | None = None
        self.loop: LoopState | None = None

    # -- what a user does ---------------------------------------------------------------------------------------

    def describe_rig(self, setup: RigSetup) -> None:
        """State what the rig can do; passes planned before are forgotten."""
        with self._lock:
            self._setup, self._plan = setup, None

    def plan(self) -> Plan:
        """Recommended passes for the map as it is now; made anew only when the map has changed.

        Raises
        ------
        PlanningError : the rig or the optics are not known.
        SessionError : the session is closed.
        """
        results = self._session.results() or self._session.fresh_results()
        with self._lock:
            if self._plan is None or self._plan.version != results.report.version:
                self._plan = self._planned(results)
            return self._plan

    def accept(self, number: int) -> PassOrder:
        """Take an order for a pass of the latest plan.

        Raises
        ------
        PassUnknown : there is no such pass in the plan.
        """
        plan = self.plan()
        with self._lock:
            wanted = next((one for one in plan.passes if one.number == number), None)
            if wanted is None:
                raise PassUnknown(
                    f"there is no pass {number} in the plan for version {plan.version} of the map, which has "
                    f"{len(plan.passes)}; list the recommended passes again"
                )
            order = PassOrder(len(self._orders) + 1, wanted, plan.version)
            self._orders.append(order)
        self._session.event("pass_accepted", order.to_dict())
        return order

    def carry_out(self, order_id: int, part_is_turned: bool = False) -> PassOrder:
        """Drive an accepted pass; pushed scanlines are waited for where a client or a hand moves the scanner.

        Parameters
        ----------
        part_is_turned : the operator says that the part lies as the pass asks.

        Raises
        ------
        PassUnknown, SessionBusy : there is no such order, or the session or the order is in another state.
        SourceUnusable, DriverError : the pass could not be started; the order can be carried out again.
        """
        with self._lock:
            order = self.order(order_id)
            if order.status is not PassStatus.ACCEPTED:
                raise SessionBusy(f"pass order {order_id} is {order.status.value}: accept a pass of a new plan")
            turn = order.planned.turn
            if turn is not None and not turn.is_none and not part_is_turned:
                raise SessionBusy(f"first {turn}; then carry the pass out and say that the part is turned")
            before = self._session.fresh_results()
            self._setup_now().reach.check(
                order.planned.motion, order.planned.start_mm, order.planned.end_mm, order.planned.line_spacing_mm
            )
            self._drive(order.planned)
            order.status = PassStatus.RUNNING
        self._session.event("pass_started", {"order": order.order_id})
        threading.Thread(
            target=self._follow, args=(order, before), name=f"pass-{self._session.row.session_id}", daemon=True
        ).start()
        return order

    def run_loop(self, limits: LoopLimits) -> LoopState:
        """Plan and carry out by itself until nothing is left to do; raises SessionBusy while a loop runs."""
        self.plan()  # what cannot be planned is refused now, not in the loop
        with self._lock:
            if self.loop is not None and self.loop.running:
                raise SessionBusy("a closed loop is running already: end it first")
            if isinstance(self._session.source, PushSource):
                raise SessionBusy("a closed loop needs a rig that the service drives; here passes are scanned by hand")
            self.loop = LoopState(limits)
        threading.Thread(
            target=self._loop, args=(self.loop,), name=f"rescan-{self._session.row.session_id}", daemon=True
        ).start()
        return self.loop

    def end_loop(self) -> None:
        """End the closed loop after the pass that is under way."""
        if self.loop is not None:
            self.loop.wanted_end.set()

    # -- what a reader asks -------------------------------------------------------------------------------------

    def orders(self) -> list[PassOrder]:
        """All orders, the oldest first."""
        with self._lock:
            return list(self._orders)

    def order(self, order_id: int) -> PassOrder:
        """One order; raises PassUnknown."""
        with self._lock:
            for one in self._orders:
                if one.order_id == order_id:
                    return one
        raise PassUnknown(f"no pass order {order_id} was taken in this session; accept a recommended pass first")

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

    # -- inside -------------------------------------------------------------------------------------------------

    def _setup_now(self) -> RigSetup:
        if self._setup is None:
            self._setup = self._setup_of_device()
        return self._setup

    def _setup_of_device(self) -> RigSetup:
        """What is known of a device on its own stage: the travel and the rate at which the session scanned."""
        source = self._session.source
        if not isinstance(source, DeviceSource):
            raise RigUnlimited(
                "the service does not know what this session's rig can do: state its limits and the scanner's optics "
                "(PUT .../rig) before passes are planned"
            )
        results = self._session.results() or self._session.fresh_results()
        known = self._session.row.source
        rate, start, end = float(known["line_rate_hz"]), float(known["start_mm"]), float(known["end_mm"])
        optics = measured_optics(results.snapshot, source.info.geometry, _DRIVING, source.info.points_per_line)
        half = 0.5 * optics.field_of_view_mm
        limits = RigLimits(
            AxisKind.LINEAR,
            (min(start, end), max(start, end)),
            (0.0, rate * float(known["line_spacing_mm"])),
            (0.0, rate),
            source.info.geometry,
            (optics.middle_mm - half, optics.middle_mm + half),
        )
        return RigSetup(Reach(limits), optics)

    def _planned(self, results: Results) -> Plan:
        setup = self._setup_now()
        required = self._session.settings.density_per_mm2
        if required is None:
            required = float(np.nanmedian(results.report.judgement.required_per_mm2)) if len(results.snapshot) else 1.0
        return plan_passes(
            results.snapshot,
            results.report,
            setup.reach,
            setup.optics,
            Wishes(required, trust=self._trust()),
            self._standing,
            self._tried,
            self._looks(results, setup.optics),
        )

    def _trust(self) -> float:
        """How much of what this session's passes promised was reached."""
        done = [(one.outcome, one.planned.trust) for one in self._orders if one.status is PassStatus.DONE]
        return trust_of([(out.promised_mm2, out.reached_mm2, trust) for out, trust in done if out is not None])

    def _looks(self, results: Results, optics: ScannerOptics) -> tuple[Look, ...]:
        found = [look_of(results.snapshot, *one, optics.rays) for one in self._driven]
        return tuple(look for look in found if look is not None)

    def _drive(self, wanted: RecommendedPass) -> None:
        """Start the pass on the session's device, or make the session take pushed lines again."""
        if isinstance(self._session.source, PushSource):
            self._session.start()
            return
        known = dict(self._session.row.source)
        if known.pop("kind", None) != "device" or not isinstance(wanted.motion, StraightMotion):
            raise SessionBusy(
                "this session's source cannot be driven: scan the pass by hand into a session of pushed lines"
            )
        spec = dataclasses.replace(
            DeviceSpec(**known),
            line_spacing_mm=wanted.line_spacing_mm,
            start_mm=wanted.start_mm,
            end_mm=wanted.end_mm,
            line_rate_hz=wanted.line_rate_hz,
        )
        rig = Rig(stage_from_sensor=wanted.motion.at_zero, travel_stage=wanted.motion.travel.copy())
        self._session.carry_out(lambda: _open_patiently(spec, rig))

    def _follow(self, order: PassOrder, before: Results) -> None:
        """The thread of one pass: wait for its end, then say what it brought."""
        try:
            self._session.wait_until_over()
            after = self._session.fresh_results()
            outcome = reckon(order.planned, before.snapshot, before.report, after.snapshot, after.report)
            with self._lock:
                fresh = set(after.snapshot.lines.pass_number.tolist()) - set(before.snapshot.lines.pass_number.tolist())
                planned = order.planned
                if isinstance(planned.motion, StraightMotion):
                    self._driven += [
                        (number, planned.motion, planned.start_mm, planned.end_mm) for number in sorted(fresh)
                    ]
                self._tried = self._tried.and_also(outcome.missed_mm)
                self._standing = planned.end_pose
                self._plan = None
                order.outcome = outcome
                failed = self._session.state == "failed"
                order.message = self._session.status().message if failed else None
                order.status = PassStatus.FAILED if failed else PassStatus.DONE
        except Exception as error:  # noqa: BLE001 - the thread's end: whoever waits for the order must be told
            _LOG.exception("pass order %d of session %s", order.order_id, self._session.row.session_id)
            order.message, order.status = str(error), PassStatus.FAILED
        self._session.event("pass_outcome", order.to_dict())

    def _loop(self, loop: LoopState) -> None:
        """The thread of a closed loop."""
        try:
            while loop.why_ended is None:
                loop.why_ended = self._step(loop)
        except (SessionError, DriverError, PlanningError) as error:
            loop.why_ended = str(error)
        except Exception as error:  # noqa: BLE001 - the thread's end: the user is told
            _LOG.exception("the closed loop of session %s", self._session.row.session_id)
            loop.why_ended = f"an internal fault: {error}"
        loop.running = False
        self._session.event("loop_ended", loop.to_dict())

    def _step(self, loop: LoopState) -> str | None:
        """One pass of a closed loop; why it ends, or None when it goes on."""
        if loop.wanted_end.is_set():
            return "it was ended by the user"
        results = self._session.fresh_results()
        share = loop.limits.coverage_share
        if share is not None and results.coverage.share >= share:
            return f"the observed coverage of {share:.1%} is reached"
        if share is None and not results.report.regions:
            return "the requirement holds: no region is left"
        plan = self.plan()
        drivable = [one for one in plan.passes if one.turn is None or one.turn.is_none]
        if not drivable:
            left = f"; {len(plan.passes)} passes would need the part to be turned" if plan.passes else ""
            return f"nothing that the rig reaches by itself is left{left}"
        best = drivable[0]
        seconds = best.duration_s + best.approach_s
        if loop.passes >= loop.limits.max_passes:
            return f"the limit of {loop.limits.max_passes} passes is met"
        if loop.seconds + seconds > loop.limits.max_seconds:
            return f"the limit of {loop.limits.max_seconds:g} s is met"
        order = self.accept(best.number)
        try:
            self.carry_out(order.order_id)
        except (SessionError, DriverError, PlanningError) as error:
            order.status, order.message = PassStatus.FAILED, str(error)
            raise
        loop.passes, loop.seconds = loop.passes + 1, loop.seconds + seconds
        self._wait_for(order)
        return order.message if order.status is PassStatus.FAILED else None

    def _wait_for(self, order: PassOrder, poll_s: float = 0.05) -> None:
        done = threading.Event()
        while order.status is PassStatus.RUNNING:
            done.wait(poll_s)


def _open_patiently(spec: DeviceSpec, rig: Rig, tries: int = 3) -> Source:
    """Open the device's port again; what the pass before left on the wire may spoil the first greeting."""
    for _ in range(tries - 1):
        try:
            return spec.open(rig)
        except (ScannerSilent, PortBusy) as error:
            _LOG.info("the scanner did not answer at once: %s", error)
    return spec.open(rig)


def optics_stated(
    geometry: Any, field_of_view_mm: float, rays: int, max_incidence_rad: float, middle_mm: float = 0.0
) -> ScannerOptics:
    """Optics as a user states them; raises OpticsUnknown when they cannot be."""
    if not 0 < max_incidence_rad < 0.5 * np.pi:
        raise OpticsUnknown("the largest incidence must lie between 0° and 90°")
    return ScannerOptics(geometry, field_of_view_mm, rays, middle_mm, max_incidence_rad)
