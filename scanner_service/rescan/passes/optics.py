"""What a laser-line scanner sees from where it stands: fan, range, incidence, ray spacing; knows no part and no rig."""

import math
from dataclasses import dataclass

import numpy as np

from drivers.scanline import BoolArray, Float64Array, SensorGeometry
from scanner_service.rescan.passes.errors import OpticsUnknown

MAX_INCIDENCE_RAD = math.radians(60.0)
"""Beyond this the incidence dominates the error of a laser-line scanner, and returns become rare."""


THIN_RAD = math.radians(15.0)
"""So much steeper may rays be that bring more points to where some are."""


@dataclass(frozen=True, slots=True)
class ScannerOptics:
    """A fan of `rays` that pass z = 0 at equal steps of x, over `field_of_view_mm` about x = `middle_mm`.

    `geometry` is what the scanner says of itself; `max_incidence_rad` the largest angle between a normal and the laser
    ray, and `max_camera_rad` the largest one to the camera's sight, at which a return is counted on.
    """

    geometry: SensorGeometry
    field_of_view_mm: float
    rays: int
    middle_mm: float = 0.0
    max_incidence_rad: float = MAX_INCIDENCE_RAD
    max_camera_rad: float = math.radians(80.0)

    def __post_init__(self) -> None:
        low, high = self.geometry.range_mm
        if not (math.isfinite(self.field_of_view_mm) and self.field_of_view_mm > 0 and self.rays >= 2):
            raise OpticsUnknown(
                f"a pass cannot be planned with a field of view of {self.field_of_view_mm} mm and {self.rays} rays: "
                "state the scanner's field of view and points per line"
            )
        if not (low < high < min(self.geometry.laser_mm[2], self.geometry.camera_mm[2])):
            raise OpticsUnknown(
                f"the measurement range ({low:g}, {high:g}) mm must be (lowest, highest) and end below laser and camera"
            )

    @property
    def standoff_mm(self) -> float:
        """Distance of the laser's origin from z = 0."""
        return float(self.geometry.laser_mm[2])

    @property
    def camera_aside_rad(self) -> float:
        """Angle at z = 0 between the ways to the laser and to the camera."""
        laser, camera = self.geometry.laser_mm, self.geometry.camera_mm
        cosine = float(laser @ camera) / float(np.linalg.norm(laser) * np.linalg.norm(camera))
        return math.acos(max(-1.0, min(1.0, cosine)))

    def limit_rad(self, thin: BoolArray) -> Float64Array:
        """(n,) largest incidence at which a place is looked at: a larger one where it is `thin` (n,), see `Needs`."""
        steeper = min(self.max_incidence_rad + THIN_RAD, self.max_camera_rad)
        return np.where(thin, max(steeper, self.max_incidence_rad), self.max_incidence_rad)

    def widening(self, z_mm: Float64Array) -> Float64Array:
        """How much wider than at z = 0 the fan is at z (n,)."""
        wide: Float64Array = (self.geometry.laser_mm[2] - z_mm) / self.geometry.laser_mm[2]
        return wide

    def across(self, local_mm: Float64Array) -> Float64Array:
        """Where the rays to places (n, 3) of the laser plane pass z = 0: -1 and 1 are the ends of the fan."""
        laser_x = float(self.geometry.laser_mm[0])
        at_zero = laser_x + (local_mm[:, 0] - laser_x) / np.maximum(self.widening(local_mm[:, 2]), 1e-9)
        share: Float64Array = (at_zero - self.middle_mm) / (0.5 * self.field_of_view_mm)
        return share

    def point_spacing_mm(self, z_mm: Float64Array) -> Float64Array:
        """Distance (n,) between neighbouring rays on a surface across the sensor's z axis, at z (n,)."""
        spacing: Float64Array = self.widening(z_mm) * (self.field_of_view_mm / (self.rays - 1))
        return spacing
