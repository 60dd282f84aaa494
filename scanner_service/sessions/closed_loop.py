"""The closed loop of one session: plan, carry out the best pass, judge, and again until there is a reason to end.

Knows the desk it works at, no rig and no planner.
"""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from drivers.errors import DriverError
from scanner_service.rescan.passes.errors import PlanningError
from scanner_service.rescan.passes.recommendation import Plan
from scanner_service.rescan.passes.serving import EVERYTHING, Serving
from scanner_service.rescan.region import RegionStatus, RescanRegion
from scanner_service.sessions.errors import PlanOvertaken, SessionError
from scanner_service.sessions.pass_orders import PassOrder, PassStatus
from scanner_service.sessions.pass_planning import name_of
from scanner_service.sessions.results import Results

_LOG = logging.getLogger(__name__)
_HIDDEN = 0.01  # of the surface seen: passes that expect less where no region is left are not worth their time
_HOLDS = "the requirement holds: no region is left"
_MOST_OVERTAKEN = 8
_ALWAYS_OVERTAKEN = "the verdict kept changing while passes were planned; let the scan come to rest and begin anew"


@dataclass(frozen=True, slots=True)
class LoopLimits:
    """When a closed loop ends at the latest: passes, and seconds of passes with the way to them; what it is to serve.

    `coverage_share` None takes the coverage that the session's requirement asks for, where it asks for one.
    """

    max_passes: int = 20
    max_seconds: float = 600.0
    coverage_share: float | None = None
    serving: Serving = EVERYTHING


@dataclass(slots=True)
class LoopState:
    """A closed loop under way, or why it ended."""

    limits: LoopLimits
    passes: int = 0
    seconds: float = 0.0
    overtaken: int = 0  # plans in a row that another verdict came before
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


class LoopDesk(Protocol):
    """What the loop asks of the desk that orders are given to."""

    def judged(self) -> Results:
        """A verdict on everything that was scanned."""

    def plan(self, serving: Serving) -> Plan:
        """Recommended passes for it."""

    def accept(self, number: int, serving: Serving, seen: str) -> PassOrder:
        """Take an order for a pass of the plan that was seen; raises PlanOvertaken."""

    def carry_out(self, order_id: int) -> PassOrder:
        """Begin with it; one that is refused is cancelled, one whose devices do not set off fails, with the reason."""

    def wait_for(self, order: PassOrder) -> None:
        """Return when it is over."""


def run(desk: LoopDesk, loop: LoopState, on_end: Callable[[], None]) -> None:
    """The thread of a closed loop; whatever happens, `loop` says why it ended."""
    try:
        while loop.why_ended is None:
            loop.why_ended = _step(desk, loop)
    except (SessionError, DriverError, PlanningError) as error:
        loop.why_ended = str(error)
    except Exception as error:  # noqa: BLE001 - the thread's end: the user is told
        _LOG.exception("a closed loop")
        loop.why_ended = f"an internal fault: {error}"
    loop.running = False
    on_end()


def _step(desk: LoopDesk, loop: LoopState) -> str | None:
    """One pass of a closed loop; why it ends, or None when it goes on."""
    if loop.wanted_end.is_set():
        return "it was ended by the user"
    limits, results = loop.limits, desk.judged()
    done = _fulfilled(results, limits)
    if done is not None:
        return done
    plan = desk.plan(limits.serving)
    drivable = [one for one in plan.passes if one.turn is None or one.turn.is_none]
    if _share(results, limits) is None and not _wanted(results, limits):
        expected_mm2 = sum(one.gain_mm2 for one in drivable)  # where there is no region they only explore
        if expected_mm2 < _HIDDEN * float(results.coverage.area_mm2.sum()):
            return _HOLDS
    if not drivable:
        return _nothing_left(desk.judged(), plan)
    best = drivable[0]
    seconds = best.duration_s + best.approach_s
    if loop.passes >= limits.max_passes:
        return f"the limit of {limits.max_passes} passes is met"
    if loop.seconds + seconds > limits.max_seconds:
        return f"the limit of {limits.max_seconds:g} s is met"
    try:
        order = desk.accept(best.number, limits.serving, name_of(plan))
    except PlanOvertaken:
        loop.overtaken += 1
        return None if loop.overtaken < _MOST_OVERTAKEN else _ALWAYS_OVERTAKEN
    loop.overtaken = 0
    try:
        desk.carry_out(order.order_id)
    except (SessionError, DriverError, PlanningError) as error:
        return f"pass order {order.order_id} {order.status.value}: {error}"
    loop.passes, loop.seconds = loop.passes + 1, loop.seconds + seconds
    desk.wait_for(order)
    if order.status is PassStatus.FAILED:
        return f"pass order {order.order_id} failed: {order.message}"
    return order.doubt


def _fulfilled(results: Results, limits: LoopLimits) -> str | None:
    """Why nothing more is wanted, or None."""
    share = _share(results, limits)
    if share is not None:
        kind = "observed coverage" if results.reference is None else "coverage of the nominal part"
        return f"the {kind} of {share:.1%} is reached" if results.share >= share else None
    if limits.serving.is_everything or _wanted(results, limits):
        return None  # what nobody saw may be in no region: a plan tells
    return _HOLDS


def _share(results: Results, limits: LoopLimits) -> float | None:
    """The coverage asked for, if one is."""
    return limits.coverage_share if limits.coverage_share is not None else results.requirement.coverage_share


def _wanted(results: Results, limits: LoopLimits) -> list[RescanRegion]:
    return [region for region in results.regions if limits.serving.wants(region)]


def _nothing_left(results: Results, plan: Plan) -> str:
    said = "nothing that the rig reaches by itself is left"
    lost = [region for region in results.regions if region.status is RegionStatus.UNREACHABLE]
    if lost:
        said += f"; {_count(len(lost), 'region is', 'regions are')} unreachable"
    if plan.passes:
        said += f"; {_count(len(plan.passes), 'pass', 'passes')} would need the part to be turned"
    return said


def _count(number: int, one: str, more: str) -> str:
    return f"{number} {one if number == 1 else more}"
