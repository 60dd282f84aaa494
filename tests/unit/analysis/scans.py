"""Small scans of analytic surfaces, as stored lines."""

import numpy as np

from drivers.scanline import Scanline
from scanner_service.analysis.intake import quantise

UNKNOWN = np.full(3, np.nan)


def scanline(points_mm, line_index=0, **changes):
    """A scanline along x at travel position y, laser 150 mm above; any field may be changed."""
    points_mm = np.asarray(points_mm, dtype=np.float64).reshape(-1, 3)
    position = changes.get("position_mm", float(points_mm[:, 1].mean()) if len(points_mm) else 0.0)
    fields = {
        "device_id": "A",
        "boot_id": 1,
        "pass_index": 0,
        "line_index": line_index,
        "device_time_s": 0.01 * line_index,
        "points_mm": points_mm,
        "missing": np.zeros(len(points_mm), bool),
        "laser_mm": np.array([0.0, position, 150.0]),
        "plane_normal": np.array([0.0, 1.0, 0.0]),
        "travel": np.array([0.0, 1.0, 0.0]),
        "position_mm": position,
        "line_spacing_mm": 0.2,
        "step_mm": 0.2,
    }
    return Scanline(**(fields | changes))


def stored(points_mm, line_index=0, origin_mm=(0.0, 0.0, 0.0), **changes):
    return quantise(scanline(points_mm, line_index, **changes), np.asarray(origin_mm, dtype=np.float64))


def surface_scan(
    height, lines=12, points=30, spacing=0.2, along=0.15, rng=None, noise_mm=0.0, laser_z=150.0, **changes
):
    """Lines over z = height(x, y), with noise on all coordinates."""
    x = (np.arange(points) - points / 2) * along
    result = []
    for i in range(lines):
        y = np.full(points, i * spacing)
        p = np.column_stack([x, y, height(x, y)])
        if noise_mm:
            p = p + rng.normal(0.0, noise_mm, p.shape)
        at = {"position_mm": i * spacing, "laser_mm": np.array([0.0, i * spacing, laser_z])}
        result.append(stored(p, i, line_spacing_mm=spacing, step_mm=spacing, **at, **changes))
    return result
