"""What a rig can do: the attitudes of its sensor to the part, how fast, and within which limits; knows no needs."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from drivers.rig import Rig
from drivers.rig_limits import AxisKind, RigLimits
from drivers.scanline import BoolArray, Float64Array, Pose, read_only
from scanner_service.rescan.passes.errors import PassOutOfReach, RigUnlimited
from scanner_service.rescan.passes.motion import Motion, StraightMotion, TurningMotion

_ROLLS = 8
_STEP_RAD = math.radians(12.0)
_PART_TURNS_DEG = (0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0)
_PART_TIPS_DEG = (0.0, 30.0, 50.0)


@dataclass(frozen=True, slots=True)
class PartTurn:
    """How the operator turns the part on a rig whose sensor cannot: about the vertical, then over towards +y.

    Angles by the right-hand rule, seen from the rig; the point `about_mm` (part frame) stays where it is, None in
    passes of a time when it was not kept.
    """

    about_vertical_rad: float
    tip_rad: float
    about_mm: tuple[float, float, float] | None = None

    @property
    def is_none(self) -> bool:
        """True when the part stays as it lies."""
        return self.about_vertical_rad == 0.0 and self.tip_rad == 0.0

    @property
    def rotation(self) -> Float64Array:
        """(3, 3) from the part as it lies to the part as it will lie."""
        return np.asarray(_about(0, -self.tip_rad) @ _about(2, self.about_vertical_rad), dtype=np.float64)

    def __str__(self) -> str:
        said = []
        if self.about_vertical_rad:
            said.append(f"turn the part by {math.degrees(self.about_vertical_rad):.0f}° (counter-clockwise from above)")
        if self.tip_rad:
            said.append(f"tip it over by {math.degrees(self.tip_rad):.0f}° towards the end of the travel")
        if not said:
            return "leave the part as it lies"
        stays = (
            ""
            if self.about_mm is None
            else "; the point {}, {}, {} mm stays in its place".format(*(round(at) for at in self.about_mm))
        )
        return ", then ".join(said) + stays


@dataclass(frozen=True, slots=True)
class Attitude:
    """One way of holding the sensor to the part: `rotation` (3, 3) from sensor to part frame.

    `motion` is complete where the rig leaves nothing to choose; None where the sensor may be shifted freely, and then
    goes along its own y. `turn` is what the operator does before.
    """

    rotation: Float64Array
    motion: Motion | None
    turn: PartTurn | None = None

    def __post_init__(self) -> None:
        read_only(self.rotation)


@dataclass(frozen=True, slots=True)
class Reach:
    """What a rig can do between two passes and during one.

    Parameters
    ----------
    limits : travel, speeds, rates and, for a free pose, the box of sensor positions.
    rig : where the sensor stands before the part; for a free pose only where it stands now.
    up : (3,) unit vector of the part frame; a free pose tilts from it by at most `max_tilt_rad`.
    part_may_turn : whether the operator can be asked to turn the part before a linear axis.
    line_spacing_mm : (finest, coarsest) spacing that is planned with.
    move_mm_per_s, turn_rad_per_s, settle_s : how fast the sensor is brought to another start; `turn_part_s` what
        turning the part by hand takes.

    Raises
    ------
    RigUnlimited : when a free pose has no box, or speeds and rates are not known.
    """

    limits: RigLimits
    rig: Rig = field(default_factory=Rig)
    up: Float64Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    max_tilt_rad: float = math.radians(70.0)
    part_may_turn: bool = True
    line_spacing_mm: tuple[float, float] = (0.05, 1.0)
    move_mm_per_s: float = 100.0
    turn_rad_per_s: float = math.radians(60.0)
    settle_s: float = 0.5
    turn_part_s: float = 30.0

    def __post_init__(self) -> None:
        limits = self.limits
        if limits.axis is AxisKind.FREE_POSE and limits.reach_mm is None:
            raise RigUnlimited(
                "a free pose needs a box of positions the sensor may take: state reach_low_mm and reach_high_mm"
            )
        if not (math.isfinite(limits.line_rate_hz[1]) and limits.line_rate_hz[1] > 0):
            raise RigUnlimited("no pass can be timed without the scanner's highest line rate: state line_rate_hz")
        if limits.axis is not AxisKind.FREE_POSE and not all(map(math.isfinite, limits.travel_mm)):
            raise RigUnlimited("the ends of the stage's travel are not known: state travel_mm of the rig")
        finest, coarsest = self.line_spacing_mm
        if not 0 < finest <= coarsest:
            raise RigUnlimited(f"line spacings must be (finest, coarsest) above 0, not ({finest}, {coarsest}) mm")

    def attitudes(self, middle_mm: Float64Array) -> tuple[Attitude, ...]:
        """All ways of holding the sensor to a part whose middle is at `middle_mm` (3,), coarsely sampled."""
        match self.limits.axis:
            case AxisKind.FREE_POSE:
                return tuple(Attitude(rotation, None) for rotation in self._free())
            case AxisKind.TURNTABLE:
                return (Attitude(self.rig.part_from_sensor(0.0).rotation.copy(), self._turning()),)
        return tuple(self._turned(middle_mm))

    def near(self, attitude: Attitude) -> tuple[Attitude, ...]:
        """Attitudes around a free one, to refine it; none where the rig leaves nothing to choose."""
        if attitude.motion is not None:
            return ()
        found = []
        for axis, angle_deg in ((0, 5.0), (0, -5.0), (1, 5.0), (1, -5.0), (2, 15.0), (2, -15.0)):
            rotation = attitude.rotation @ _about(axis, math.radians(angle_deg))
            if self.tilt_rad(rotation) <= self.max_tilt_rad + 1e-9:
                found.append(Attitude(rotation, None))
        return tuple(found)

    def may_light(self, directions: Float64Array, wider_rad: float = 0.0) -> BoolArray:
        """(d,) False for unit directions (d, 3), from the part, in which the sensor cannot stand however it tilts.

        `wider_rad` is added to the limit: for the camera, which looks from aside.
        """
        if self.limits.axis is not AxisKind.FREE_POSE:
            return np.ones(len(directions), dtype=np.bool_)
        found: BoolArray = directions @ self.up >= math.cos(min(self.max_tilt_rad + wider_rad, math.pi)) - 1e-9
        return found

    def tilt_rad(self, rotation: Float64Array) -> float:
        """Angle between the sensor's z and `up`."""
        return math.acos(max(-1.0, min(1.0, float(rotation[:, 2] @ self.up))))

    def seconds(self, length_mm: float, line_spacing_mm: float) -> float:
        """How long a pass takes, from its first line to its last."""
        return float(self.seconds_each(np.array([length_mm]), line_spacing_mm)[0])

    def seconds_each(self, length_mm: Float64Array, line_spacing_mm: float) -> Float64Array:
        """How long passes of lengths (n,) take: (n,)."""
        lines = np.floor(length_mm / line_spacing_mm + 1e-9) + 1.0
        return np.asarray(lines / self.line_rate_hz(line_spacing_mm), dtype=np.float64)

    def line_rate_hz(self, line_spacing_mm: float) -> float:
        """The fastest rate at which lines of a spacing can be taken."""
        return min(self.limits.line_rate_hz[1], self.limits.speed_mm_per_s[1] / line_spacing_mm)

    def seconds_between(self, standing: Pose | None, wanted: Pose, turn: PartTurn | None = None) -> float:
        """How long it takes to bring the sensor from one pose to another, and to turn the part."""
        by_hand = self.turn_part_s if turn is not None and not turn.is_none else 0.0
        if standing is None:
            return self.settle_s + by_hand
        way_mm = float(np.linalg.norm(wanted.translation_mm - standing.translation_mm))
        cosine = 0.5 * (float(np.trace(standing.rotation.T @ wanted.rotation)) - 1.0)
        angle_rad = math.acos(max(-1.0, min(1.0, cosine)))
        return self.settle_s + by_hand + max(way_mm / self.move_mm_per_s, angle_rad / self.turn_rad_per_s)

    def check(self, motion: Motion, start_mm: float, end_mm: float, line_spacing_mm: float) -> None:
        """Refuse a pass that would leave the limits; raises PassOutOfReach with the reason."""
        if self.limits.axis is AxisKind.FREE_POSE and isinstance(motion, StraightMotion):
            low, high = (np.array(corner) for corner in self.limits.reach_mm or ())
            for name, at_mm in (("start", start_mm), ("end", end_mm)):
                pose = motion.part_from_sensor(at_mm)
                where = pose.translation_mm
                if not ((where >= low - 1e-6) & (where <= high + 1e-6)).all():
                    raise PassOutOfReach(
                        f"the {name} of the pass would put the sensor at {np.round(where, 1).tolist()} mm, outside the "
                        f"box from {low.tolist()} to {high.tolist()} mm that the rig reaches"
                    )
            tilt = self.tilt_rad(motion.at_zero.rotation)
            if tilt > self.max_tilt_rad + 1e-6:
                raise PassOutOfReach(
                    f"the pass would tilt the sensor by {math.degrees(tilt):.0f}°, and the rig tilts by at most "
                    f"{math.degrees(self.max_tilt_rad):.0f}°"
                )
        else:
            why = self.limits.why_not(start_mm, end_mm)
            if why is not None:
                raise PassOutOfReach(why)
        finest, coarsest = self.line_spacing_mm
        if not finest - 1e-9 <= line_spacing_mm <= coarsest + 1e-9:
            raise PassOutOfReach(
                f"a line spacing of {line_spacing_mm:g} mm is outside the rig's {finest:g} to {coarsest:g} mm"
            )

    def _free(self) -> Iterator[Float64Array]:
        """Rotations that tilt z from `up` in rings a step apart, the last at the limit, each with turns about z."""
        base = _frame_of(self.up)
        rings = max(1, math.ceil(self.max_tilt_rad / _STEP_RAD - 1e-9))
        for ring in range(rings + 1):
            tilt = self.max_tilt_rad * ring / rings
            around = max(1, round(2.0 * math.pi * math.sin(tilt) / _STEP_RAD))
            for step in range(around):
                azimuth = 2.0 * math.pi * step / around
                for roll in range(_ROLLS):
                    turn = 2.0 * math.pi * roll / _ROLLS
                    yield base @ _about(2, azimuth) @ _about(1, tilt) @ _about(2, turn)

    def _turning(self) -> TurningMotion:
        table = self.rig.turntable
        if table is None:
            raise RigUnlimited("a turntable needs its axis: state the direction of the stage in the rig")
        if np.abs(self.rig.part_from_stage.translation_mm).max() > 1e-9:
            raise RigUnlimited("passes on a turntable are planned with the part frame's origin on its axis only")
        axis = self.rig.part_from_stage.rotate(table.axis_stage)
        return TurningMotion(self.rig.part_from_sensor(0.0), axis, table.radius_mm)

    def _turned(self, middle_mm: Float64Array) -> Iterator[Attitude]:
        """The linear axis as it is, and with the part turned before it."""
        at_zero = self.rig.part_from_sensor(0.0)
        travel = self.rig.part_from_stage.rotate(self.rig.travel_stage)
        middle_mm = np.round(middle_mm)  # so that it can be said
        x, y, z = (float(value) for value in middle_mm)
        turns = [PartTurn(0.0, 0.0)]
        if self.part_may_turn:
            turns += [
                PartTurn(math.radians(about), math.radians(tip), (x, y, z))
                for tip in _PART_TIPS_DEG
                for about in _PART_TURNS_DEG
                if (about, tip) != (0.0, 0.0)
            ]
        for turn in turns:
            back = turn.rotation.T  # what the part does forwards, the sensor does backwards, seen from the part
            pose = Pose(back @ at_zero.rotation, back @ (at_zero.translation_mm - middle_mm) + middle_mm)
            yield Attitude(pose.rotation.copy(), StraightMotion(pose, back @ travel), turn)


def _frame_of(up: Float64Array) -> Float64Array:
    """A right-handed frame (3, 3) whose third column is `up`."""
    other = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    y = np.cross(up, other)
    y /= np.linalg.norm(y)
    return np.column_stack([np.cross(y, up), y, up])


def _about(axis: int, angle_rad: float) -> Float64Array:
    """Rotation (3, 3) about one coordinate axis."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    rotation[a, a], rotation[a, b], rotation[b, a], rotation[b, b] = cosine, -sine, sine, cosine
    return rotation
