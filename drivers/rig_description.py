"""What a rig is made of, as its owner describes it: scanner, stage, mounting, pairing; opens nothing, reads no file."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

import numpy as np

from drivers.rig import Rig, Turntable
from drivers.rig_limits import AxisKind, Interval, RigLimits
from drivers.scanline import Float64Array, Pose, SensorGeometry

Option = str | int | float | bool
ENDLESS: Interval = (-math.inf, math.inf)


class PairBy(StrEnum):
    """How a profile gets its stage position."""

    DEVICE = "device"
    """The scanner latches it with the exposure and sends it in the line's header."""
    TIME = "time"
    """Interpolated between readings of the stage at the time of the exposure."""
    COUNT = "count"
    """The k-th line belongs to the k-th place: a trigger for each line, or a stop for each."""


@dataclass(frozen=True, slots=True)
class DeviceChoice:
    """A driver by its name, and where its device is.

    `port` is an absolute path (best one of /dev/serial/by-id) or `usb:VID:PID` or `usb:VID:PID:SERIAL`; None where the
    kind has no port of its own. `baud_rate` None takes the driver's usual one. `options` are the driver's own.
    """

    kind: str
    port: str | None = None
    baud_rate: int | None = None
    options: Mapping[str, Option] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True)
class Pairing:
    """How profiles and stage positions come together.

    `latency_s` is the time from an exposure to the arrival of its profile at the host that is taken off;
    `latency_uncertainty_s` by how much it may be wrong. Both matter when pairing by time only.
    """

    by: PairBy = PairBy.DEVICE
    latency_s: float = 0.0
    latency_uncertainty_s: float = 0.002


@dataclass(frozen=True, slots=True)
class RigDescription:
    """A rig: which scanner on which stage, mounted how, and what it can do.

    `scanner.kind` and `stage.kind` are names in the registries of `drivers.scanners` and `drivers.stages`.
    `mm_per_unit` turns the stage's own unit (mm of a linear axis, degrees of a turntable) into millimetres of travel.
    """

    name: str
    scanner: DeviceChoice
    stage: DeviceChoice
    limits: RigLimits
    pairing: Pairing = field(default_factory=Pairing)
    part_from_stage: Pose = field(default_factory=Pose.identity)
    stage_from_sensor: Pose = field(default_factory=Pose.identity)
    direction_stage: Float64Array = field(default_factory=lambda: np.array([0.0, 1.0, 0.0]))

    @property
    def geometry(self) -> SensorGeometry | None:
        """The scanner's optics where the description tells them."""
        return self.limits.geometry

    @property
    def mm_per_unit(self) -> float:
        """Millimetres of travel for one unit of the stage: 1 mm, or one degree at the turntable's radius."""
        if self.limits.axis is AxisKind.TURNTABLE:
            return math.radians(1.0) * self.limits.radius_mm
        return 1.0

    def rig(self) -> Rig:
        """Return what places profiles on the part."""
        if self.limits.axis is AxisKind.TURNTABLE:
            table = Turntable(self.direction_stage.copy(), self.limits.radius_mm)
            return Rig(self.part_from_stage, self.stage_from_sensor, turntable=table)
        return Rig(self.part_from_stage, self.stage_from_sensor, self.direction_stage.copy())
