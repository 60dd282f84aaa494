"""How to guide a hand along a recommended pass: how far, which way, how fast; knows no device and no clock."""

import math
from dataclasses import dataclass

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.rescan.passes.recommendation import RecommendedPass

_NEAR_MM = 3.0
_MOST_LINES = 0.8  # of a pass that was carried out: some are lost on the wire, and a hand is a little too fast
_ANGLE_RAD = math.radians(8.0)


@dataclass(frozen=True, slots=True)
class Guidance:
    """Where the hand is beside a pass; NaN: not known.

    `along_mm` is what is still to go along the pass (more than its length before the start), `aside_mm` how far the
    laser is from the line it should follow, `angle_rad` between the laser plane and the wanted one,
    `speed_mm_per_s` now, `wanted_mm_per_s` at most; `say` is one sentence.
    """

    along_mm: float
    aside_mm: float
    angle_rad: float
    speed_mm_per_s: float
    wanted_mm_per_s: float
    say: str


def guide(
    wanted: RecommendedPass,
    laser_sensor_mm: Float64Array,
    laser_mm: Float64Array,
    plane_normal: Float64Array,
    speed_mm_per_s: float,
) -> Guidance:
    """Compare the laser's place (3,) and plane (3,) now, part frame, with where the pass wants them."""
    start, end = wanted.start_pose.apply(laser_sensor_mm), wanted.end_pose.apply(laser_sensor_mm)
    way = end - start
    length = float(np.linalg.norm(way))
    ahead = way / max(length, 1e-9)
    gone = float((laser_mm - start) @ ahead)
    off = laser_mm - start - gone * ahead
    aside = float(np.linalg.norm(off))
    normal = wanted.start_pose.rotation[:, 1]
    angle = math.acos(min(1.0, abs(float(plane_normal @ normal)))) if np.isfinite(plane_normal).all() else math.nan
    fast = wanted.line_rate_hz * wanted.line_spacing_mm
    return Guidance(
        length - gone, aside, angle, speed_mm_per_s, fast, _say(gone, length, off, aside, angle, speed_mm_per_s, fast)
    )


def reaches_end(wanted: RecommendedPass, laser_sensor_mm: Float64Array, laser_mm: Float64Array) -> bool:
    """True when a pass was carried out to its end: most of its lines came, and a late one lies where it ends.

    Parameters
    ----------
    laser_sensor_mm : (3,) the laser in the sensor frame.
    laser_mm : (n, 3) the laser at each scanline that came, part frame, in the order of the lines.
    """
    if len(laser_mm) < max(1.0, _MOST_LINES * wanted.line_count):
        return False
    end = wanted.end_pose.apply(laser_sensor_mm)
    before_end_mm = wanted.end_mm - math.copysign(wanted.line_spacing_mm, wanted.end_mm - wanted.start_mm)
    step_mm = np.linalg.norm(wanted.motion.part_from_sensor(before_end_mm).apply(laser_sensor_mm) - end)
    late = laser_mm[len(laser_mm) // 2 :]  # the last line may lie up to a step before the end: far, around a turntable
    return bool((np.linalg.norm(late - end, axis=1) <= _NEAR_MM + step_mm).any())


def _say(gone: float, length: float, off: Float64Array, aside: float, angle: float, speed: float, fast: float) -> str:
    if aside > _NEAR_MM:
        axis = int(np.argmax(np.abs(off)))
        return f"move {aside:.0f} mm aside, mostly towards {'-' if off[axis] > 0 else '+'}{'xyz'[axis]}"
    if angle > _ANGLE_RAD:
        return f"turn the scanner by {math.degrees(angle):.0f}° until its laser line lies as wanted"
    if gone < -_NEAR_MM:
        return f"go on {-gone:.0f} mm to the start of the pass"
    if gone > length:
        return "the pass is done"
    if speed > 1.15 * fast:
        return f"slower: {speed:.0f} mm/s now, at most {fast:.0f} mm/s wanted; {length - gone:.0f} mm to go"
    return f"good; {length - gone:.0f} mm to go"
