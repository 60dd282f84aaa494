"""A simulated scanner that can be held in any pose: scanlines of straight and turning passes, without a wire.

Knows optics and surfaces, no protocol and no clock. Poses are part_from_sensor.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from drivers.scanline import Float64Array, Pose, Scanline
from simulators.optics import LaserLineScanner
from simulators.shapes import Surface


@dataclass(slots=True)
class PosedScanner:
    """A scanner over a part; it numbers its passes and lines as a device does within one boot.

    `rng` is the chance of noise and dropouts.
    """

    scanner: LaserLineScanner
    surface: Surface
    rng: np.random.Generator
    device_id: str = "SIM-POSED"
    boot_id: int = 1
    pass_index: int = 0
    next_line: int = 0
    time_s: float = 0.0

    def scan(
        self,
        pose_at: Callable[[float], Pose],
        start_mm: float,
        end_mm: float,
        line_spacing_mm: float,
        line_rate_hz: float = 200.0,
    ) -> Iterator[Scanline]:
        """Scan one pass: lines every `line_spacing_mm` of the position from `start_mm` towards `end_mm`.

        Parameters
        ----------
        pose_at : part_from_sensor at each position.

        Raises
        ------
        ValueError : when the spacing is not greater than 0, or start, end or rate are no numbers.
        """
        if not (np.isfinite([start_mm, end_mm]).all() and line_spacing_mm > 0 and line_rate_hz > 0):
            raise ValueError(
                f"a pass needs finite ends and a spacing and rate above 0, not {start_mm} to {end_mm} mm, "
                f"{line_spacing_mm} mm, {line_rate_hz} Hz"
            )
        self.pass_index += 1
        count = int(abs(end_mm - start_mm) / line_spacing_mm + 1e-9) + 1
        step_mm = line_spacing_mm if end_mm >= start_mm else -line_spacing_mm
        for k in range(count):
            at_mm = start_mm + k * step_mm
            yield self._line(pose_at, at_mm, step_mm, line_spacing_mm, k == 0)
            self.time_s += 1.0 / line_rate_hz

    def _line(
        self, pose_at: Callable[[float], Pose], at_mm: float, step_mm: float, spacing_mm: float, is_first: bool
    ) -> Scanline:
        pose = pose_at(at_mm)
        x_mm, z_mm = self.scanner.expose(self.surface, pose, self.rng)
        points = pose.apply(np.stack([x_mm, np.zeros_like(x_mm), z_mm], axis=1))
        laser = pose.apply(self.scanner.laser_mm)
        travel = pose_at(at_mm + 0.5).apply(self.scanner.laser_mm) - pose_at(at_mm - 0.5).apply(self.scanner.laser_mm)
        length = float(np.linalg.norm(travel))
        normal: Float64Array = pose.rotation[:, 1].copy()
        if length > 0:
            travel = travel / length
            normal = -normal if float(normal @ travel) < 0 else normal
        else:  # the laser stands on the axis of a turn
            travel = normal.copy()
        self.next_line += 1
        return Scanline(
            device_id=self.device_id,
            boot_id=self.boot_id,
            pass_index=self.pass_index,
            line_index=self.next_line - 1,
            device_time_s=self.time_s,
            points_mm=points,
            missing=np.zeros(len(points), dtype=np.bool_),
            laser_mm=laser,
            plane_normal=normal,
            travel=travel,
            position_mm=at_mm,
            line_spacing_mm=spacing_mm,
            step_mm=np.nan if is_first else step_mm,
        )
