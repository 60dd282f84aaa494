"""All that a plan of passes is made from, gathered at one moment, and the plan made of it; owns no state or lock."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.scanline import Pose
from scanner_service.rescan.passes.experience import experience_of
from scanner_service.rescan.passes.looks import Look, look_of
from scanner_service.rescan.passes.motion import Motion, StraightMotion
from scanner_service.rescan.passes.outcome import Outcome
from scanner_service.rescan.passes.planner import Wishes, plan_passes
from scanner_service.rescan.passes.recommendation import Plan, RecommendedPass
from scanner_service.rescan.passes.serving import Serving
from scanner_service.rescan.passes.tried import Tried
from scanner_service.sessions.errors import PassUnknown, PlanOvertaken
from scanner_service.sessions.pass_orders import PassOrder
from scanner_service.sessions.results import Results
from scanner_service.sessions.rig_setups import RigSetup

_NAME_LENGTH = 8
Driven = tuple[int, Motion, float, float]
"""A pass as it was driven: its number in the map, its motion, where it started and ended."""


@dataclass(frozen=True, slots=True)
class PlanQuestion:
    """What is to be planned for: the verdict, the rig, what is to be served, and what earlier passes taught."""

    results: Results
    setup: RigSetup
    serving: Serving
    earlier: tuple[Outcome, ...]
    tried: Tried
    standing: Pose | None
    driven: tuple[Driven, ...]
    ordered: frozenset[int]  # the passes of the map that were ordered, also those that were driven otherwise

    @classmethod
    def of(
        cls, orders: Sequence[PassOrder], results: Results, setup: RigSetup, serving: Serving, standing: Pose | None
    ) -> "PlanQuestion":
        """What is to be planned for after these orders."""
        ordered = frozenset(number for order in orders for number in order.map_passes)
        return cls(results, setup, serving, outcomes_of(orders), tried_by(orders), standing, driven_by(orders), ordered)

    def answered(self) -> Plan:
        """The plan. It takes about a second for a large map.

        Raises
        ------
        PassUnknown : a region that is to be served is not open.
        PlanningError : the rig or the optics are not known.
        """
        results, setup = self.results, self.setup
        open_ids = {region.number for region in results.regions}
        unknown = sorted(self.serving.regions - open_ids)
        if unknown:
            raise PassUnknown(f"no region {unknown[0]} is open in this session; list the regions again")
        required = results.requirement.density_per_mm2
        if required is None:
            required = float(np.nanmedian(results.report.judgement.required_per_mm2)) if len(results.snapshot) else 1.0
        wishes = Wishes(
            required,
            learned=experience_of(self.earlier),
            requirement=results.requirement,
            serving=self.serving,
        )
        return plan_passes(
            results.snapshot,
            results.report,
            setup.reach,
            setup.optics,
            wishes,
            self.standing,
            self.tried,
            self._looks(),
            results.regions,
            results.reference,
        )

    def _looks(self) -> tuple[Look, ...]:
        """The passes whose poses are known: those that were ordered, and the session's own."""
        snapshot, driven, own = self.results.snapshot, list(self.driven), self.setup.scanned_by
        counted = np.unique(snapshot.lines.pass_number[snapshot.line[snapshot.neighbours > 0]])
        if isinstance(own, StraightMotion):  # one that was withdrawn has seen nothing, and found nothing empty
            for number in sorted(set(counted.tolist()) - self.ordered):
                at = snapshot.lines.position_mm[snapshot.lines.pass_number == number]
                if len(at) and np.isfinite(at).all():
                    driven.append((number, own, float(at[0]), float(at[-1])))
        found = [
            look_of(snapshot, number, motion, start_mm, end_mm, self.setup.optics.rays)
            for number, motion, start_mm, end_mm in driven
            if isinstance(motion, StraightMotion)
        ]
        return tuple(look for look in found if look is not None)


def name_of(plan: Plan) -> str:
    """A short name that two plans share only when they say the same: each number is the same pass, for the same gain.

    The version of the map is left out: it also grows where nothing changes that a pass depends on.
    """
    said = json.dumps([one.to_dict() for one in plan.passes], sort_keys=True)
    return hashlib.sha256(said.encode()).hexdigest()[:_NAME_LENGTH]


def wanted_of(plan: Plan, number: int, seen: str | None) -> RecommendedPass:
    """The pass of a number in the plan in force, which must be the one that was `seen` (None: whichever it is).

    Raises
    ------
    PlanOvertaken : it is another one.
    PassUnknown : there is no such pass in the plan.
    """
    if seen is not None and seen != name_of(plan):
        raise PlanOvertaken(
            f"plan {seen} is not in force, the plan now is {name_of(plan)}: map, requirement, rig or what is to be "
            "served may have changed since it was made; list the passes again"
        )
    wanted = next((one for one in plan.passes if one.number == number), None)
    if wanted is None:
        raise PassUnknown(
            f"there is no pass {number} in plan {name_of(plan)}, which has {len(plan.passes)}; list the passes again"
        )
    return wanted


def outcomes_of(orders: Sequence[PassOrder]) -> tuple[Outcome, ...]:
    """What became of the passes that were carried out to their end, the oldest first."""
    return tuple(order.outcome for order in orders if order.teaches and order.outcome is not None)


def driven_by(orders: Sequence[PassOrder]) -> tuple[Driven, ...]:
    """The passes of the map that were ordered, as they were driven; doubted and withdrawn ones are left out."""
    return tuple(
        (number, order.planned.motion, order.planned.start_mm, order.planned.end_mm)
        for order in orders
        if order.is_in_force
        for number in order.map_passes
    )


def tried_by(orders: Sequence[PassOrder]) -> Tried:
    """What the passes that were carried out to their end were in vain for."""
    tried = Tried.nothing()
    for outcome in outcomes_of(orders):
        tried = tried.and_also(outcome.missed_mm, outcome.empty_mm)
    return tried
