"""What a turning lidar sees of a part that passes under it at constant speed; knows no device and no wire.

The lidar looks down from `height_mm` above the part frame's x-y plane, its scan plane across the travel; straight ahead
is -z. The angle convention is that of `drivers.protocols.polar`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from drivers.scanline import Float64Array
from simulators.shapes import Surface

RangeScene: TypeAlias = Callable[[Float64Array, float], Float64Array]
"""Ranges in mm (n,) at angles in rad (n,), that long in seconds after measuring began; NaN = nothing comes back."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """A `RangeScene`: the part's y under the lidar is `start_mm + speed_mm_per_s * t`.

    `noise_mm` is one standard deviation along the ray, `reach_mm` the (nearest, farthest) distance that comes back.
    """

    surface: Surface
    height_mm: float
    start_mm: float
    speed_mm_per_s: float
    rng: np.random.Generator
    noise_mm: float = 0.0
    reach_mm: tuple[float, float] = (20.0, 4000.0)

    def __call__(self, angles_rad: Float64Array, elapsed_s: float) -> Float64Array:
        """Ranges (n,) in mm, NaN where nothing comes back."""
        n = len(angles_rad)
        origin = np.array([0.0, self.start_mm + self.speed_mm_per_s * elapsed_s, self.height_mm])
        rays = np.column_stack([np.sin(angles_rad), np.zeros(n), -np.cos(angles_rad)])
        distance, _ = self.surface.first_hit(np.broadcast_to(origin, (n, 3)), rays)
        measured = distance + self.noise_mm * self.rng.standard_normal(n)
        nearest, farthest = self.reach_mm
        seen = (measured >= nearest) & (measured <= farthest)
        return np.where(seen, measured, np.nan)
