"""How a sensor moves during a pass, and how a place on the part looks from it at the moment it is lit; knows no rig."""

import math
from dataclasses import dataclass

import numpy as np

from drivers.scanline import Float64Array, Pose, read_only
from scanner_service.rescan.passes.optics import ScannerOptics


@dataclass(frozen=True, slots=True)
class Sights:
    """Places (n, 3) as a moving sensor sees them, each at the moment when the laser plane goes through it.

    `position_mm` (n,) is the stage position then (NaN: never), `local_mm` (n, 3) the place in the sensor frame,
    `laser_mm` and `camera_mm` (n, 3) stand in the part frame, and so does `plane` (n, 3), the unit normal of the laser
    plane; `advance` (n,) is how far that goes at the place for a millimetre of stage position.
    """

    position_mm: Float64Array
    local_mm: Float64Array
    laser_mm: Float64Array
    camera_mm: Float64Array
    plane: Float64Array
    advance: Float64Array


@dataclass(frozen=True, slots=True)
class StraightMotion:
    """The sensor goes straight: at position s it stands at `at_zero` moved by s along `travel` (3,), part frame."""

    at_zero: Pose
    travel: Float64Array

    def __post_init__(self) -> None:
        read_only(self.travel)

    def part_from_sensor(self, position_mm: float) -> Pose:
        """The sensor's pose at a position."""
        return Pose(self.at_zero.rotation.copy(), self.at_zero.translation_mm + position_mm * self.travel)

    def sights(self, places_mm: Float64Array, optics: ScannerOptics) -> Sights:
        """How places (n, 3) of the part look when they are lit."""
        rotation = self.at_zero.rotation
        local = (places_mm - self.at_zero.translation_mm) @ rotation
        along = self.travel @ rotation
        if abs(along[1]) < 1e-9:  # the plane would slide within itself
            never = np.full(len(places_mm), np.nan)
            nowhere = np.full_like(places_mm, np.nan)
            return Sights(never, local, nowhere, nowhere, nowhere, never)
        position = local[:, 1] / along[1]
        shift = position[:, None] * self.travel
        laser = self.at_zero.apply(optics.geometry.laser_mm) + shift
        camera = self.at_zero.apply(optics.geometry.camera_mm) + shift
        local = local - position[:, None] * along
        plane = np.broadcast_to(rotation[:, 1], places_mm.shape)
        return Sights(position, local, laser, camera, plane, np.full(len(places_mm), abs(float(along[1]))))


@dataclass(frozen=True, slots=True)
class TurningMotion:
    """The part turns before the sensor about an axis `axis` (3,) through the origin of the part frame.

    Seen from the part the sensor, at `at_zero` when the position is 0, goes around by position / `radius_mm`.
    """

    at_zero: Pose
    axis: Float64Array
    radius_mm: float

    def __post_init__(self) -> None:
        read_only(self.axis)

    def turn(self, angle_rad: float) -> Pose:
        """The rotation about the axis (Rodrigues' formula)."""
        x, y, z = self.axis
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        rotation = np.eye(3) + math.sin(angle_rad) * cross + (1.0 - math.cos(angle_rad)) * (cross @ cross)
        return Pose(rotation, np.zeros(3))

    def part_from_sensor(self, position_mm: float) -> Pose:
        """The sensor's pose at a position."""
        return self.turn(position_mm / self.radius_mm) @ self.at_zero

    def sights(self, places_mm: Float64Array, optics: ScannerOptics) -> Sights:
        """How places (n, 3) look when the plane meets them on the laser's side of the axis, the nearer of two ways."""
        normal = self.at_zero.rotation[:, 1]
        height = places_mm @ self.axis
        across = places_mm - height[:, None] * self.axis
        sideways = np.cross(self.axis, across)
        # the place turned back by a lies in the plane: cos a (across.m) - sin a (sideways.m) = (t - height axis).m
        cosine, sine = across @ normal, -(sideways @ normal)
        wanted = float(self.at_zero.translation_mm @ normal) - height * float(self.axis @ normal)
        size = np.hypot(cosine, sine)
        with np.errstate(invalid="ignore", divide="ignore"):
            half = np.arccos(wanted / size)
        middle = np.arctan2(sine, cosine)
        best: Sights | None = None
        for angle in (middle + half, middle - half):
            found = self._at(np.remainder(angle, 2.0 * np.pi), across, sideways, height, optics)
            if best is None:
                best = found
            else:  # the way on which the place is nearer to the laser
                nearer = found.local_mm[:, 2] > best.local_mm[:, 2]
                best = Sights(
                    *(
                        np.where(nearer if now.ndim == 1 else nearer[:, None], now, before)
                        for now, before in (
                            (found.position_mm, best.position_mm),
                            (found.local_mm, best.local_mm),
                            (found.laser_mm, best.laser_mm),
                            (found.camera_mm, best.camera_mm),
                            (found.plane, best.plane),
                            (found.advance, best.advance),
                        )
                    )
                )
        if best is None:
            raise AssertionError("two ways were tried")
        return best

    def _at(
        self,
        angle: Float64Array,
        across: Float64Array,
        sideways: Float64Array,
        height: Float64Array,
        optics: ScannerOptics,
    ) -> Sights:
        cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
        place = cosine * across - sine * sideways + height[:, None] * self.axis  # turned back by the angle
        local = (place - self.at_zero.translation_mm) @ self.at_zero.rotation
        advance = np.abs(np.cross(self.axis, place) @ self.at_zero.rotation[:, 1]) / self.radius_mm
        laser, camera = (
            self._turned(angle, self.at_zero.apply(where))
            for where in (optics.geometry.laser_mm, optics.geometry.camera_mm)
        )
        plane = self._turned(angle, self.at_zero.rotation[:, 1])
        return Sights(angle * self.radius_mm, local, laser, camera, plane, advance)

    def _turned(self, angle: Float64Array, where_mm: Float64Array) -> Float64Array:
        """One place of the stage frame (3,) turned by each angle (n,): (n, 3)."""
        along = self.axis * float(where_mm @ self.axis)
        across = where_mm - along
        sideways = np.cross(self.axis, across)
        turned: Float64Array = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * sideways + along
        return turned


Motion = StraightMotion | TurningMotion
