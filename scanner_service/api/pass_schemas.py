"""What requests about passes may say: rig, loop, order; angles in degrees only here."""

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.config import JsonDict

from drivers.rig_limits import AxisKind, RigLimits
from drivers.scanline import SensorGeometry
from scanner_service.api.errors import ValueUnusable
from scanner_service.api.schemas import Finite, Strict, Vector
from scanner_service.rescan.judgement import Reason
from scanner_service.rescan.passes.errors import RigUnlimited
from scanner_service.rescan.passes.reach import Reach
from scanner_service.rescan.passes.serving import Serving
from scanner_service.sessions.closed_loop import LoopLimits
from scanner_service.sessions.rig_setups import RigSetup, optics_stated

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
RIG_OF_A_RECORDING: JsonDict = {
    "axis": "free_pose",
    "scanner": {
        "laser_mm": [0, 0, 150],
        "camera_mm": [0, 76, 150],
        "range_mm": [-30, 30],
        "field_of_view_mm": 50,
        "points_per_line": 400,
    },
    "reach_low_mm": [-100, -100, -20],
    "reach_high_mm": [100, 100, 100],
    "max_tilt_deg": 60,
    "line_rate_hz": 50,
}
"""A body that states a scanner which is held in any pose within a box: what a recorded scan cannot tell of itself."""


class ScannerIn(Strict):
    """The optics of a scanner in its sensor frame: x along the laser line, z towards the sensor."""

    laser_mm: Vector
    camera_mm: Vector
    range_mm: tuple[Finite, Finite]
    field_of_view_mm: Positive
    points_per_line: Annotated[int, Field(ge=2, le=100_000)]
    noise_mm: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.01
    max_incidence_deg: Annotated[float, Field(gt=0, lt=90, allow_inf_nan=False)] = 60.0


class RigIn(Strict):
    """What a rig can do: a linear axis between two ends, or a sensor that is held in any pose within a box.

    `driven_by_client`: a client carries out what is accepted, by itself, so that the closed loop may run.
    """

    model_config = ConfigDict(json_schema_extra={"examples": [RIG_OF_A_RECORDING]})

    axis: Literal["linear", "free_pose"]
    scanner: ScannerIn
    travel_mm: tuple[Finite, Finite] | None = None
    reach_low_mm: Vector | None = None
    reach_high_mm: Vector | None = None
    max_tilt_deg: Annotated[float, Field(ge=0, le=180, allow_inf_nan=False)] = 70.0
    line_rate_hz: Positive = 50.0
    speed_mm_per_s: Positive = 50.0
    line_spacing_mm: tuple[Positive, Positive] = (0.05, 1.0)
    part_may_turn: bool = True
    driven_by_client: bool = False

    def to_setup(self) -> RigSetup:
        """As the pass desk takes it; raises PlanningError or ValueError when it cannot be meant."""
        optics = self.scanner
        geometry = SensorGeometry(
            np.array(optics.laser_mm), np.array(optics.camera_mm), optics.range_mm, optics.noise_mm
        )
        half = 0.5 * optics.field_of_view_mm
        box = None
        if self.axis == "linear" and self.travel_mm is None:
            raise RigUnlimited("the ends of the stage's travel are not known: state travel_mm of the rig")
        if self.reach_low_mm is not None and self.reach_high_mm is not None:
            box = (self.reach_low_mm, self.reach_high_mm)
        travel = (-math.inf, math.inf) if self.travel_mm is None else self.travel_mm
        if not travel[0] < travel[1]:
            raise RigUnlimited(f"travel_mm must be (lowest, highest), not {list(travel)}")
        limits = RigLimits(
            AxisKind(self.axis),
            travel,
            (0.0, self.speed_mm_per_s),
            (0.0, self.line_rate_hz),
            geometry,
            (-half, half),
            reach_mm=box,
        )
        reach = Reach(
            limits,
            max_tilt_rad=math.radians(self.max_tilt_deg),
            part_may_turn=self.part_may_turn,
            line_spacing_mm=self.line_spacing_mm,
        )
        stated = optics_stated(
            geometry, optics.field_of_view_mm, optics.points_per_line, math.radians(optics.max_incidence_deg)
        )
        return RigSetup(reach, stated, driven_by_client=self.driven_by_client)


class AcceptIn(Strict):
    """The plan in which the pass was seen, as the list of recommended passes names it."""

    plan: Annotated[str, Field(min_length=1, max_length=64)] | None = None

    def seen(self) -> str:
        """The plan's name; raises ValueUnusable without it: a number alone may mean another pass."""
        if self.plan is None:
            raise ValueUnusable(
                'say in which plan the pass was seen: {"plan": "…"}, as the list of recommended passes names it'
            )
        return self.plan


class CarryOutIn(Strict):
    """Whether the part lies as the pass asks."""

    part_is_turned: bool = False


ReasonName = Literal["steep", "sparse", "shadow", "out_of_range", "lost_lines", "noisy", "untouched"]
RegionId = Annotated[int, Field(ge=1)]


def serving_of(regions: list[int], reasons: list[ReasonName]) -> Serving:
    """What is to be served; nothing named: everything."""
    return Serving(frozenset(regions), frozenset(Reason[name.upper()] for name in reasons))


class LoopIn(Strict):
    """When a closed loop ends at the latest, and what it serves: regions by id, and by reason."""

    max_passes: Annotated[int, Field(ge=1, le=200)] = 20
    max_seconds: Annotated[float, Field(gt=0, le=86_400, allow_inf_nan=False)] = 600.0
    coverage_share: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] | None = None
    regions: Annotated[list[RegionId], Field(max_length=1000)] = Field(default_factory=list)
    reasons: Annotated[list[ReasonName], Field(max_length=10)] = Field(default_factory=list)

    def to_limits(self) -> LoopLimits:
        """As the pass desk takes them."""
        serving = serving_of(self.regions, self.reasons)
        return LoopLimits(self.max_passes, self.max_seconds, self.coverage_share, serving)
