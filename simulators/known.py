"""The devices that can be simulated by name, each over a part that is scanned by it: names, rates, what they see.

Scanners without a stage of their own see the part pass by at constant speed, beginning with its first edge when they
are told to measure.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.scanline import Float64Array, Pose
from simulators.devices.lms import LmsDevice
from simulators.devices.ls100 import Ls100Device
from simulators.devices.rplidar import A1, RplidarDevice
from simulators.devices.scip import ScipDevice
from simulators.optics import LaserLineScanner
from simulators.parts import Part
from simulators.pty_port import SerialDevice
from simulators.sweep import Sweep

LIDAR_HEIGHT_MM = 150.0
LIDAR_NOISE_MM = 1.0
DEFAULT_SPEED_MM_PER_S = 5.0
_LS100_POINTS = 832


@dataclass(frozen=True, slots=True)
class PassingPart:
    """A part that passes a sensor: `start_mm` is the part's y under it when measuring begins."""

    part: Part
    speed_mm_per_s: float
    rng: np.random.Generator

    @property
    def start_mm(self) -> float:
        """The first edge."""
        return self.part.travel_mm[0]

    def sweep(self) -> Sweep:
        """What a lidar sees that looks down on it."""
        return Sweep(self.part.surface, LIDAR_HEIGHT_MM, self.start_mm, self.speed_mm_per_s, self.rng, LIDAR_NOISE_MM)

    def line(self) -> Callable[[float], tuple[Float64Array, Float64Array]]:
        """What a small laser-line sensor sees of it."""
        optics = LaserLineScanner(
            laser_mm=np.array([0.0, 0.0, 100.0]),
            camera_mm=np.array([0.0, 50.0, 100.0]),
            field_of_view_mm=30.0,
            range_mm=(-20.0, 25.0),
            points_per_line=_LS100_POINTS,
            noise_mm=0.01,
        )

        def seen(elapsed_s: float) -> tuple[Float64Array, Float64Array]:
            at_mm = np.array([0.0, self.start_mm + self.speed_mm_per_s * elapsed_s, 0.0])
            return optics.expose(self.part.surface, Pose(np.eye(3), at_mm), self.rng)

        return seen


@dataclass(frozen=True, slots=True)
class KnownDevice:
    """A kind of device: the rate its wire begins at, and how it is made."""

    name: str
    title: str
    baud_rate: int
    makes: Callable[[PassingPart], SerialDevice]


KNOWN_DEVICES: dict[str, KnownDevice] = {
    known.name: known
    for known in (
        KnownDevice("scip", "Hokuyo URG-04LX", 19_200, lambda passing: ScipDevice(passing.sweep())),
        KnownDevice("lms200", "SICK LMS200", 9_600, lambda passing: LmsDevice(passing.sweep(), rng=passing.rng)),
        KnownDevice("rplidar", "Slamtec RPLIDAR A1", A1.baud_rate, lambda passing: RplidarDevice(passing.sweep(), A1)),
        KnownDevice(
            "ls100", "Optex FASTUS LS-100", 921_600, lambda passing: Ls100Device(passing.line(), baud_rate=921_600)
        ),
    )
}
"""Besides `native`, which has a stage of its own and is made by `process.simulated_device`."""
