"""The optics of a laser-line scanner: which points of a surface return light to the camera, and why the others do not.

Knows no device, no wire and no clock. In the sensor frame the laser plane is y = 0, x runs along the laser line and z
towards the sensor; chance comes in as `rng`.
"""

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array, Pose, SensorGeometry, read_only
from simulators.shapes import Surface

_LIFT_MM = 1e-3
"""How far the ray to the camera starts off the surface, so that the rounding of ray casting in single precision does
not hide a point behind itself; far below any noise."""


class Return(IntEnum):
    """What became of a laser ray."""

    SEEN = 0
    NO_SURFACE = 1  # the ray meets nothing
    CAMERA_SHADOW = 2  # lit, but hidden from the camera
    OUT_OF_RANGE = 3  # seen, but outside the measurement range
    DROPOUT = 4  # lost by chance, the likelier the more grazing the ray


@dataclass(frozen=True, slots=True)
class Exposure:
    """One exposure with its truth, sensor frame, one row a ray.

    `x_mm`, `z_mm` (n,) are what the scanner reports, noise included, NaN = no return; `outcome` (n,) says why.
    `truth_mm` (n, 3) is the lit point without noise (NaN: the ray meets nothing), `incidence_rad` (n,) the angle
    between its normal and the laser ray. A point in the laser's shadow has no row: the ray lit what hides it.
    """

    x_mm: Float64Array
    z_mm: Float64Array
    outcome: npt.NDArray[np.uint8]
    truth_mm: Float64Array
    incidence_rad: Float64Array

    def __post_init__(self) -> None:
        for array in (self.x_mm, self.z_mm, self.outcome, self.truth_mm, self.incidence_rad):
            read_only(array)


def dropout_probability(incidence_rad: Float64Array, exponent: float) -> Float64Array:
    """Chance that a ray gives no return: (1 - cos incidence)**exponent, 0 head-on and 1 at grazing.

    A model, not a law of nature: the light scattered back falls as the cosine (Lambert 1760), and the exponent says
    how sharply the detector fails once it is short of light. With exponent 4: 0.4 % at 45, 6 % at 60, 47 % at 80 deg.
    """
    lack: Float64Array = 1.0 - np.abs(np.cos(incidence_rad))
    return lack**exponent


@dataclass(frozen=True, slots=True)
class LaserLineScanner:
    """A laser fan and a camera that watches it from the side.

    `laser_mm` and `camera_mm` (3,) are the fan's origin (y = 0) and the camera's centre in the sensor frame.
    `field_of_view_mm` is the width of the fan at z = 0; it narrows towards the sensor and widens away from it. Its
    `points_per_line` rays pass z = 0 at equal steps of x. `range_mm` is the (lowest, highest) z that is reported,
    `noise_mm` one standard deviation along the laser ray, `dropout_exponent` as in `dropout_probability` (inf: none).
    """

    laser_mm: Float64Array
    camera_mm: Float64Array
    field_of_view_mm: float
    range_mm: tuple[float, float]
    points_per_line: int
    noise_mm: float
    dropout_exponent: float = 4.0
    _rays: Float64Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        low, high = self.range_mm
        if self.laser_mm[1] != 0.0:
            raise ValueError(f"the laser must lie in its own plane, y = 0, not y = {self.laser_mm[1]}")
        if not low < 0.0 < high < min(self.laser_mm[2], self.camera_mm[2]):
            raise ValueError(f"the measurement range {self.range_mm} must hold z = 0 and end below laser and camera")
        if self.points_per_line < 2 or not self.field_of_view_mm > 0 or not self.noise_mm >= 0:
            raise ValueError("a scanner needs two points a line or more, a field of view, and noise of 0 mm or more")
        x_mm = np.linspace(-0.5, 0.5, self.points_per_line) * self.field_of_view_mm
        rays = np.column_stack([x_mm, np.zeros_like(x_mm), np.zeros_like(x_mm)]) - self.laser_mm
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        object.__setattr__(self, "_rays", rays)
        for array in (self.laser_mm, self.camera_mm, rays):
            read_only(array)

    @property
    def point_spacing_mm(self) -> float:
        """Distance between neighbouring rays at z = 0."""
        return self.field_of_view_mm / (self.points_per_line - 1)

    @property
    def camera_angle_rad(self) -> float:
        """Triangulation angle at the origin, between the laser's and the camera's line of sight."""
        cosine = self.laser_mm @ self.camera_mm / (np.linalg.norm(self.laser_mm) * np.linalg.norm(self.camera_mm))
        return float(np.arccos(cosine))

    def geometry(self) -> SensorGeometry:
        """What the scanner says of itself to a driver."""
        return SensorGeometry(self.laser_mm.copy(), self.camera_mm.copy(), self.range_mm, self.noise_mm)

    def expose(
        self, surface: Surface, part_from_sensor: Pose, rng: np.random.Generator
    ) -> tuple[Float64Array, Float64Array]:
        """One exposure as the scanner reports it: x_mm, z_mm (n,) in the sensor frame, NaN = no return."""
        exposure = self.trace(surface, part_from_sensor, rng)
        return exposure.x_mm, exposure.z_mm

    def trace(self, surface: Surface, part_from_sensor: Pose, rng: np.random.Generator) -> Exposure:
        """One exposure of `surface` (part frame) with the truth about every ray."""
        n = self.points_per_line
        laser, camera = part_from_sensor.apply(np.stack([self.laser_mm, self.camera_mm]))
        rays = part_from_sensor.rotate(self._rays)
        distance, normals = surface.first_hit(np.broadcast_to(laser, (n, 3)), rays)
        lit = np.flatnonzero(np.isfinite(distance))

        outcome = np.full(n, Return.NO_SURFACE, dtype=np.uint8)
        points = laser + distance[lit, None] * rays[lit]
        outcome[lit] = np.where(_is_seen(surface, points, normals[lit], laser, camera), 0, Return.CAMERA_SHADOW)

        incidence = np.full(n, np.nan)
        cosine = np.abs(np.einsum("ij,ij->i", normals[lit], rays[lit]))
        incidence[lit] = np.arccos(np.minimum(cosine, 1.0))
        # Every line draws the same number of chances, so that a line's noise does not depend on what it saw.
        noise, luck = rng.standard_normal(n) * self.noise_mm, rng.random(n)
        lost = np.zeros(n, dtype=np.bool_)
        lost[lit] = luck[lit] < dropout_probability(incidence[lit], self.dropout_exponent)
        outcome[lost & (outcome == Return.SEEN)] = Return.DROPOUT

        truth = np.full((n, 3), np.nan)
        truth[lit] = self.laser_mm + distance[lit, None] * self._rays[lit]
        measured = np.full((n, 3), np.nan)
        measured[lit] = truth[lit] + noise[lit, None] * self._rays[lit]
        low, high = self.range_mm
        # The range is a limit of the camera's rows, so it holds for what is measured and not for the truth.
        outside = ~((measured[:, 2] >= low) & (measured[:, 2] <= high))
        outcome[outside & np.isin(outcome, (Return.SEEN, Return.DROPOUT))] = Return.OUT_OF_RANGE
        measured[outcome != Return.SEEN] = np.nan
        return Exposure(measured[:, 0].copy(), measured[:, 2].copy(), outcome, truth, incidence)


def _is_seen(
    surface: Surface, points_mm: Float64Array, normals: Float64Array, laser_mm: Float64Array, camera_mm: Float64Array
) -> npt.NDArray[np.bool_]:
    """Whether the camera sees each lit point (n, 3): its lit side is turned to the camera and nothing is in between."""
    to_camera = camera_mm - points_mm
    gap = np.linalg.norm(to_camera, axis=1)
    sight = to_camera / gap[:, None]
    facing = np.einsum("ij,ij->i", normals, sight) * np.einsum("ij,ij->i", normals, laser_mm - points_mm) > 0
    seen: npt.NDArray[np.bool_] = facing.copy()
    starts = points_mm[facing] + _LIFT_MM * sight[facing]
    obstacle, _ = surface.first_hit(starts, sight[facing])
    seen[facing] = obstacle > gap[facing]
    return seen


def demo_scanner() -> LaserLineScanner:
    """The scanner of the demo: standoff 150 mm, camera 27 degrees aside at +y, 400 points over 50 mm, noise 10 um."""
    standoff_mm = 150.0
    camera = np.array([0.0, standoff_mm * np.tan(np.radians(27.0)), standoff_mm])
    return LaserLineScanner(
        laser_mm=np.array([0.0, 0.0, standoff_mm]),
        camera_mm=camera,
        field_of_view_mm=50.0,
        range_mm=(-30.0, 30.0),
        points_per_line=400,
        noise_mm=0.01,
    )
