"""The types every floor speaks: profile, pose, scanline; knows no wire, no port and no analysis.

Lengths are millimetres, angles radians, coordinate frames right-handed. In the *sensor frame* the laser plane
is y = 0: x runs along the laser line, z towards the sensor. In the *part frame* z is height. NaN means "not
measured" everywhere, never zero. Arrays are read-only once they are inside one of these values.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float64Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


def read_only(array: npt.NDArray[np.generic]) -> None:
    """Forbid writing to `array`, so that it may be handed to another thread."""
    array.flags.writeable = False


@dataclass(frozen=True, slots=True)
class SensorGeometry:
    """What a scanner says of its optics, all in the sensor frame.

    `laser_mm` and `camera_mm` are (3,) positions of the fan's origin and of the camera's centre;
    `range_mm` is the (lowest, highest) usable z; `noise_mm` one standard deviation along z.
    """

    laser_mm: Float64Array
    camera_mm: Float64Array
    range_mm: tuple[float, float]
    noise_mm: float

    def __post_init__(self) -> None:
        read_only(self.laser_mm)
        read_only(self.camera_mm)


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Who answered: identity, firmware and calibration of a scanner, valid for one boot."""

    device_id: str
    model: str
    firmware: str
    calibration_id: str
    boot_id: int
    points_per_line: int
    geometry: SensorGeometry


@dataclass(frozen=True, slots=True)
class Profile:
    """One exposure in the sensor frame, before it is placed on the part.

    `x_mm` and `z_mm` have shape (n,), n the points of a whole line. NaN is a point without a return (dropout);
    where `missing` is True the chunk that carried the point never arrived. `line_index` and `pass_index` count
    within `boot_id`. `position_mm` is the stage's travel (NaN: unknown). `line_spacing_mm` is the pass's nominal
    spacing, `step_mm` the measured step to the line before (NaN: unknown; may be zero or negative).
    `laser_mm` (3,) is the fan's origin in the sensor frame.
    """

    device_id: str
    boot_id: int
    pass_index: int
    line_index: int
    device_time_s: float
    arrival_s: float
    x_mm: Float64Array
    z_mm: Float64Array
    missing: BoolArray
    laser_mm: Float64Array
    position_mm: float
    line_spacing_mm: float
    step_mm: float

    def __post_init__(self) -> None:
        if not self.x_mm.shape == self.z_mm.shape == self.missing.shape:
            shapes = f"{self.x_mm.shape}, {self.z_mm.shape}, {self.missing.shape}"
            raise ValueError(f"x_mm, z_mm and missing must have one shape, not {shapes}")
        for array in (self.x_mm, self.z_mm, self.missing, self.laser_mm):
            read_only(array)

    @property
    def is_whole(self) -> bool:
        """True when every chunk of the line arrived."""
        return not self.missing.any()


@dataclass(frozen=True, slots=True)
class Pose:
    """A rigid transform, named target_from_source: `target = rotation @ source + translation_mm`."""

    rotation: Float64Array
    translation_mm: Float64Array

    def __post_init__(self) -> None:
        if self.rotation.shape != (3, 3) or self.translation_mm.shape != (3,):
            raise ValueError("a pose is a (3, 3) rotation and a (3,) translation")
        defect = float(np.abs(self.rotation @ self.rotation.T - np.eye(3)).max())
        if not defect < 1e-6 or float(np.linalg.det(self.rotation)) < 0:
            raise ValueError(f"the rotation of a pose must be orthonormal and right-handed (defect {defect:.2g})")
        read_only(self.rotation)
        read_only(self.translation_mm)

    @classmethod
    def identity(cls) -> "Pose":
        """The pose that moves nothing."""
        return cls(np.eye(3), np.zeros(3))

    def apply(self, points_mm: Float64Array) -> Float64Array:
        """Points (n, 3) or (3,) of the source frame, in the target frame."""
        return points_mm @ self.rotation.T + self.translation_mm

    def rotate(self, directions: Float64Array) -> Float64Array:
        """Directions (n, 3) or (3,) of the source frame, in the target frame."""
        return directions @ self.rotation.T

    def __matmul__(self, other: "Pose") -> "Pose":
        """`a_from_b @ b_from_c` is `a_from_c`."""
        return Pose._of_checked(
            self.rotation @ other.rotation, self.rotation @ other.translation_mm + self.translation_mm
        )

    def inverse(self) -> "Pose":
        """`a_from_b.inverse()` is `b_from_a`."""
        return Pose._of_checked(self.rotation.T.copy(), -self.rotation.T @ self.translation_mm)

    def moved(self, by_mm: Float64Array) -> "Pose":
        """The same rotation, `by_mm` (3,) of the target frame farther."""
        return Pose._of_checked(self.rotation, self.translation_mm + by_mm)

    @classmethod
    def _of_checked(cls, rotation: Float64Array, translation_mm: Float64Array) -> "Pose":
        """A pose made from poses: what a check of it costs is more than what a scanline has time for."""
        pose = object.__new__(cls)
        object.__setattr__(pose, "rotation", rotation)
        object.__setattr__(pose, "translation_mm", translation_mm)
        read_only(rotation)
        read_only(translation_mm)
        return pose


@dataclass(frozen=True, slots=True)
class Scanline:
    """A profile placed in the part frame, with its laser position and line spacing.

    `points_mm` is (n, 3); a row of NaN is a point without a return, or one whose chunk is `missing` (n,).
    `laser_mm` (3,) is the fan's origin. `plane_normal` (3,) is the unit normal of the laser plane and `travel`
    (3,) the unit direction in which the planes follow each other, both NaN when unknown (hand-guided).
    `position_mm` is the place along the travel (NaN: unknown); the other fields are those of `Profile`.
    """

    device_id: str
    boot_id: int
    pass_index: int
    line_index: int
    device_time_s: float
    points_mm: Float64Array
    missing: BoolArray
    laser_mm: Float64Array
    plane_normal: Float64Array
    travel: Float64Array
    position_mm: float
    line_spacing_mm: float
    step_mm: float

    def __post_init__(self) -> None:
        if self.points_mm.ndim != 2 or self.points_mm.shape[1] != 3:
            raise ValueError(f"points_mm must have shape (n, 3), not {self.points_mm.shape}")
        if self.missing.shape != self.points_mm.shape[:1]:
            raise ValueError(f"missing must have shape ({len(self.points_mm)},), not {self.missing.shape}")
        for array in (self.points_mm, self.missing, self.laser_mm, self.plane_normal, self.travel):
            read_only(array)
