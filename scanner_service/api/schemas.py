"""What requests may say, checked before anything else sees it; angles in degrees only here."""

import math
from dataclasses import asdict
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from drivers.scanline import Float64Array, Scanline
from scanner_service.analysis.normals.field import NormalOptions
from scanner_service.analysis.radius import LiveRule
from scanner_service.rescan.presets import preset_of, requirement_of
from scanner_service.rescan.requirement import Interest, Requirement, RequirementUnusable
from scanner_service.sessions.settings import SessionSettings
from scanner_service.storage.formats.reference_mesh import ReferenceSpec

Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
MAX_PLACES = 100_000


class Strict(BaseModel):
    """A body in which every field is known, and nothing changes."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class DeviceSourceIn(Strict):
    """One pass of a scanner that speaks the native protocol.

    `rearm`: after an interruption longer than the device's dead-man the laser is switched on again by itself and the
    pass goes on; by default the session waits, paused, until it is resumed.
    """

    kind: Literal["device"]
    port: Annotated[str, Field(min_length=1, max_length=500, examples=["/dev/ttyUSB0"])]
    baud_rate: Annotated[int, Field(gt=0, le=12_000_000)] = 3_000_000
    line_spacing_mm: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.2
    start_mm: Finite
    end_mm: Finite
    line_rate_hz: Annotated[float, Field(gt=0, le=100_000, allow_inf_nan=False)] = 50.0
    rearm: bool = False


class RigSourceIn(Strict):
    """One pass of a rig whose file lies in the service's folder of rigs; `rig` is its bare name. It moves the stage."""

    kind: Literal["rig"]
    rig: Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^/\\\x00]+$", examples=["bench.toml"])]
    line_spacing_mm: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.2
    start_mm: Finite
    end_mm: Finite
    speed_mm_per_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    home: bool = False
    at_mm: Finite | None = None


class ReplaySourceIn(Strict):
    """A recorded scan that lies in the service's replay folder; `file` is its bare name.

    Of a record file the newest session is played, or that of the id `session`, with the settings that it has.
    """

    kind: Literal["replay"]
    file: Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^/\\\x00]+$", examples=["part.ply"])]
    speed: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    units: Literal["mm", "m", "inch", "auto"] | None = None
    line_spacing_mm: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    laser_mm: Vector | None = None
    session: Annotated[str, Field(min_length=1, max_length=100)] | None = None


class PushSourceIn(Strict):
    """Scanlines that the client pushes."""

    kind: Literal["push"]


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class InterestIn(Strict):
    """A box along the axes of the part frame, millimetres; only surface in it is judged."""

    low_mm: Vector
    high_mm: Vector


class RequirementIn(Strict):
    """What the scan must reach: a preset, and what is asked for in its place; what is left out is not asked for."""

    preset: Annotated[str, Field(max_length=50, examples=["standard"])] | None = None
    density_per_mm2: Positive | None = None
    density_share: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] | None = None
    line_spacing_mm: Positive | None = None
    chord_error_mm: Positive | None = None
    finest_line_spacing_mm: Positive | None = None
    incidence_deg: Annotated[float, Field(gt=0, lt=90, allow_inf_nan=False)] | None = None
    noise_mm: Positive | None = None
    coverage_share: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] | None = None
    interest: InterestIn | None = None

    def to_requirement(self) -> Requirement:
        """As the session judges by; raises RequirementUnusable."""
        values = self.model_dump(exclude={"preset", "incidence_deg", "interest"})
        return requirement_of(
            self.preset,
            incidence_rad=None if self.incidence_deg is None else math.radians(self.incidence_deg),
            interest=None if self.interest is None else Interest(self.interest.low_mm, self.interest.high_mm),
            **values,
        )


def requirement_told(requirement: Requirement) -> dict[str, Any]:
    """What is asked for, for JSON, under the names of `RequirementIn`: sent back, it asks for the same."""
    told = {name: getattr(requirement, name) for name in RequirementIn.model_fields if hasattr(requirement, name)}
    incidence_rad = requirement.incidence_rad
    return {
        "preset": preset_of(requirement),
        **told,
        "incidence_deg": None if incidence_rad is None else round(math.degrees(incidence_rad), 9),
        "interest": None if requirement.interest is None else asdict(requirement.interest),
    }


class ReferenceIn(Strict):
    """The nominal part: an STL or OBJ file in the service's replay folder, registered to the part frame."""

    file: Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^/\\\x00]+$", examples=["nominal.stl"])]
    units: Literal["mm", "m", "inch"] = "mm"


class SettingsIn(Strict):
    """Radius, reliability and requirement; everything may be left out.

    `density_per_mm2` is short for that of the requirement, where answers tell it.
    """

    radius_rule: LiveRule = "line"
    uncertainty_mm: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.1
    point_spacing_mm: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    noise_mm: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.01
    max_normal_error_deg: Annotated[float, Field(gt=0, le=90, allow_inf_nan=False)] = 5.0
    density_per_mm2: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    max_points: Annotated[int, Field(ge=1, le=100_000_000)] = 20_000_000
    requirement: RequirementIn = RequirementIn()
    reference: ReferenceIn | None = None

    def to_settings(self) -> SessionSettings:
        """As the session keeps it; raises RequirementUnusable."""
        values = self.model_dump(exclude={"requirement", "reference", "density_per_mm2"})
        asked, alone = self.requirement, self.density_per_mm2
        if None not in (alone, asked.density_per_mm2) and alone != asked.density_per_mm2:
            raise RequirementUnusable(
                f"the density is asked for twice, {alone:g} points/mm² in settings and {asked.density_per_mm2:g} in "
                "their requirement: leave the one in settings out",
                "density_per_mm2",
            )
        if alone is not None:
            asked = asked.model_copy(update={"density_per_mm2": alone})
        return SessionSettings(
            max_normal_error_rad=math.radians(values.pop("max_normal_error_deg")),
            target=asked.to_requirement(),
            reference=None if self.reference is None else ReferenceSpec(self.reference.file, self.reference.units),
            **values,
        )


class SessionIn(Strict):
    """A session to be made."""

    name: Annotated[str, Field(min_length=1, max_length=200)] = "scan"
    source: Annotated[DeviceSourceIn | RigSourceIn | ReplaySourceIn | PushSourceIn, Field(discriminator="kind")]
    settings: SettingsIn = SettingsIn()
    origin_mm: Vector = (0.0, 0.0, 0.0)


class DescriptionIn(Strict):
    """What a person says of a session; what is left out stays."""

    name: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    notes: Annotated[str, Field(max_length=20_000)] | None = None


class ScanlineIn(Strict):
    """One scanline in the part frame; a point without a return is null.

    A line is known by device, boot and index: pushed again it is answered as `duplicate` and not stored twice.
    """

    device_id: Annotated[str, Field(min_length=1, max_length=200)] = "client"
    boot_id: Annotated[int, Field(ge=0, lt=2**63)] = 0
    pass_index: Annotated[int, Field(ge=0, lt=2**31)] = 0
    line_index: Annotated[int, Field(ge=0, lt=2**63)]
    device_time_s: Finite = 0.0
    points_mm: Annotated[list[Vector | None], Field(max_length=MAX_PLACES)]
    laser_mm: Vector
    plane_normal: Vector | None = None
    travel: Vector | None = None
    position_mm: Finite | None = None
    line_spacing_mm: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    step_mm: Finite | None = None

    @field_validator("plane_normal", "travel")
    @classmethod
    def _has_a_length(cls, vector: Vector | None) -> Vector | None:
        if vector is not None and not math.hypot(*vector) > 1e-9:
            raise ValueError("a direction must have a length; leave it out when it is not known")
        return vector

    def to_scanline(self) -> Scanline:
        """As the session takes it."""
        unknown = (math.nan, math.nan, math.nan)
        points = np.array([unknown if point is None else point for point in self.points_mm], dtype=np.float64)
        return Scanline(
            device_id=self.device_id,
            boot_id=self.boot_id,
            pass_index=self.pass_index,
            line_index=self.line_index,
            device_time_s=self.device_time_s,
            points_mm=points.reshape(-1, 3),
            missing=np.zeros(len(points), dtype=np.bool_),
            laser_mm=np.array(self.laser_mm),
            plane_normal=_unit(self.plane_normal),
            travel=_unit(self.travel),
            position_mm=math.nan if self.position_mm is None else self.position_mm,
            line_spacing_mm=self.line_spacing_mm,
            step_mm=math.nan if self.step_mm is None else self.step_mm,
        )


class SessionPointsIn(Strict):
    """The points of a session, each normal turned to the laser of its own scanline."""

    kind: Literal["session"]
    session_id: Annotated[str, Field(min_length=1, max_length=100, pattern=r"^[0-9a-z]+$", examples=["1m82614ch5ada4"])]


class FilePointsIn(Strict):
    """A cloud that lies in the service's replay folder; `file` is its bare name."""

    kind: Literal["file"]
    file: Annotated[str, Field(min_length=1, max_length=200, pattern=r"^[^/\\\x00]+$", examples=["part.ply"])]
    units: Literal["mm", "m", "inch", "auto"] | None = None
    seen_from_mm: Vector | None = None


Length = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]


class MethodOptionsIn(Strict):
    """What a method is told; each reads its own, and what is left out it chooses itself."""

    radius_mm: Length | None = None
    neighbours: Annotated[int, Field(ge=6, le=5000)] | None = None
    noise_mm: Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)] | None = None
    floor_mm: Length | None = None
    ceiling_mm: Length | None = None
    ball_factor: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | None = None
    max_error_deg: Annotated[float, Field(gt=0, le=90, allow_inf_nan=False)] = 5.0

    def to_options(self) -> NormalOptions:
        """As the methods take them; raises ValueError where two do not go together."""
        values = self.model_dump()
        return NormalOptions(max_error_rad=math.radians(values.pop("max_error_deg")), **values)


class AnalysisIn(Strict):
    """A method, and the points it is to work on."""

    method: Annotated[str, Field(min_length=1, max_length=60, examples=["gaussian", "bivariate_quadric"])]
    source: Annotated[SessionPointsIn | FilePointsIn, Field(discriminator="kind")]
    options: MethodOptionsIn = MethodOptionsIn()
    orient: Annotated[
        bool, Field(description="Turn normals to the outside of the surface over a graph, and say how sure that is.")
    ] = False


class PassIn(Strict):
    """What names a pass within a session."""

    device_id: Annotated[str, Field(min_length=1, max_length=200)]
    boot_id: Annotated[int, Field(ge=0, lt=2**63)]
    pass_index: Annotated[int, Field(ge=0, lt=2**31)]


class ScanlinesIn(Strict):
    """Scanlines, in the order in which they were taken."""

    lines: Annotated[list[ScanlineIn], Field(min_length=1, max_length=256)]


def _unit(vector: Vector | None) -> Float64Array:
    """The direction at length 1; NaN when it is not known."""
    if vector is None:
        return np.full(3, np.nan)
    direction = np.array(vector)
    unit: Float64Array = direction / math.hypot(*vector)
    return unit
