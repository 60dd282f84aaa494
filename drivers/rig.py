"""Where scanner, stage and part stand to each other: profiles and stage positions become scanlines; knows no device."""

import math
from dataclasses import dataclass, field

import numpy as np

from drivers.errors import PositionUnknown
from drivers.scanline import Float64Array, Pose, Profile, Scanline, read_only


def _along_y() -> Float64Array:
    return np.array([0.0, 1.0, 0.0])


def _check_unit_vector(name: str, vector: Float64Array) -> None:
    if vector.shape != (3,) or not abs(float(np.linalg.norm(vector)) - 1) < 1e-6:
        raise ValueError(f"{name} must be a unit vector (3,), not {np.asarray(vector).tolist()}")


@dataclass(frozen=True, slots=True)
class Turntable:
    """An axis of rotation through the origin of the stage frame.

    `axis_stage` (3,) is a unit vector: seen from the part, the sensor goes around it by the right-hand rule as the
    position grows. `radius_mm` is where line spacings are stated: a position is the arc there, angle times radius.
    """

    axis_stage: Float64Array
    radius_mm: float

    def __post_init__(self) -> None:
        _check_unit_vector("axis_stage", self.axis_stage)
        if not (math.isfinite(self.radius_mm) and self.radius_mm > 0):
            raise ValueError(f"the radius of a turntable must be greater than 0 mm, not {self.radius_mm}")
        read_only(self.axis_stage)

    def turn(self, position_mm: float) -> Pose:
        """Return the rotation about the axis at a position (Rodrigues' formula)."""
        x, y, z = self.axis_stage
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        angle_rad = position_mm / self.radius_mm
        rotation = np.eye(3) + math.sin(angle_rad) * cross + (1.0 - math.cos(angle_rad)) * (cross @ cross)
        return Pose(rotation, np.zeros(3))

    def tangent(self, at_stage_mm: Float64Array, otherwise: Float64Array) -> Float64Array:
        """Return the unit direction (3,) in which a place of the stage frame goes around; on the axis `otherwise`."""
        across = np.cross(self.axis_stage, at_stage_mm)
        length = float(np.linalg.norm(across))
        return across / length if length > 1e-6 else otherwise


@dataclass(frozen=True, slots=True)
class Rig:
    """A sensor on a stage before a part; the default mounts everything alike, so that part = (x, position, z).

    At stage position s the sensor stands at `part_from_stage @ shift(s * travel_stage) @ stage_from_sensor`.
    `travel_stage` (3,) is a unit vector in the stage frame: where the sensor goes, seen from the part, as s grows. A
    rig whose part moves instead has the opposite vector. With a `turntable` the shift is its turn, and `travel_stage`
    has no meaning.
    """

    part_from_stage: Pose = field(default_factory=Pose.identity)
    stage_from_sensor: Pose = field(default_factory=Pose.identity)
    travel_stage: Float64Array = field(default_factory=_along_y)
    turntable: Turntable | None = None

    def __post_init__(self) -> None:
        _check_unit_vector("travel_stage", self.travel_stage)
        read_only(self.travel_stage)

    def part_from_sensor(self, position_mm: float) -> Pose:
        """Return the sensor's pose at a stage position."""
        if self.turntable is not None:
            return self.part_from_stage @ self.turntable.turn(position_mm) @ self.stage_from_sensor
        return self.part_from_stage @ self.stage_from_sensor.moved(position_mm * self.travel_stage)

    def _travel(self, position_mm: float, laser_sensor_mm: Float64Array) -> Float64Array:
        """Return the unit direction of travel in the part frame; of a turntable the tangent at the laser."""
        if self.turntable is None:
            return self.part_from_stage.rotate(self.travel_stage)
        normal_stage = self.stage_from_sensor.rotate(np.array([0.0, 1.0, 0.0]))
        tangent = self.turntable.tangent(self.stage_from_sensor.apply(laser_sensor_mm), normal_stage)
        return (self.part_from_stage @ self.turntable.turn(position_mm)).rotate(tangent)

    def place(self, profile: Profile, position_mm: float | None = None) -> Scanline:
        """Return the profile in the part frame.

        Parameters
        ----------
        profile : in the sensor frame, where the laser plane is y = 0.
        position_mm : stage position, if it is not to be the profile's own.

        Notes
        -----
        The normal of the laser plane is the sensor's y axis, turned so that it agrees with the travel. The travel is
        the direction in which the positions grow; a pass that runs backwards has negative steps.

        Raises
        ------
        PositionUnknown : when neither the profile nor the caller knows the stage position.
        """
        at_mm = profile.position_mm if position_mm is None else position_mm
        if not np.isfinite(at_mm):
            raise PositionUnknown(
                f"line {profile.line_index} of {profile.device_id} has no stage position; connect the encoder to the "
                "scanner, or give a position for each line"
            )
        part_from_sensor = self.part_from_sensor(at_mm)
        # y is 0 in the laser plane; a NaN of x or z makes all three coordinates NaN.
        in_plane_mm = np.stack([profile.x_mm, profile.z_mm], axis=1)
        points_mm = in_plane_mm @ part_from_sensor.rotation.T[::2] + part_from_sensor.translation_mm
        travel = self._travel(float(at_mm), profile.laser_mm)
        normal = part_from_sensor.rotate(np.array([0.0, 1.0, 0.0]))
        return Scanline(
            device_id=profile.device_id,
            boot_id=profile.boot_id,
            pass_index=profile.pass_index,
            line_index=profile.line_index,
            device_time_s=profile.device_time_s,
            points_mm=points_mm,
            missing=profile.missing,
            laser_mm=part_from_sensor.apply(profile.laser_mm),
            plane_normal=-normal if float(normal @ travel) < 0 else normal,
            travel=travel,
            position_mm=float(at_mm),
            line_spacing_mm=profile.line_spacing_mm,
            step_mm=profile.step_mm,
        )
