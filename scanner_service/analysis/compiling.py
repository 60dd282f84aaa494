"""Compiling the kernels of the live map on a few points, before the first scanline; knows no service."""

from dataclasses import replace

import numpy as np

from drivers.scanline import Scanline
from scanner_service.analysis.intake import StoredLine, quantise
from scanner_service.analysis.live_map import LiveMap
from scanner_service.analysis.map_settings import MapSettings
from scanner_service.analysis.radius import LiveRule, RadiusSettings
from scanner_service.analysis.snapshot import MapSnapshot

_PLACES = 600  # enough points for the first estimate of the global radius


def compile_kernels() -> MapSnapshot:
    """Compile every kernel, or load it from the cache; returns a small map for whoever has kernels of their own."""
    quantise(_scanline(), np.zeros(3))
    rules: tuple[LiveRule, ...] = ("global", "flexible", "line")
    for rule in rules:
        live_map = LiveMap(MapSettings(radius=RadiusSettings(rule=rule), max_points=4096))
        for number in range(4):
            live_map.add(_line(number))
            live_map.refresh()
        live_map.add(_line(1, line_index=9, position_mm=-0.5))  # a stage that turns back
        live_map.add(replace(_line(5), pass_index=1))
        live_map.withdraw_pass(("warm-up", 0, 1))
        live_map.snapshot()
        live_map.brief(np.arange(2, dtype=np.int32))
        live_map.close_all_passes()
    return live_map.snapshot()


def _scanline() -> Scanline:
    nowhere = np.zeros(3)
    return Scanline(
        device_id="warm-up",
        boot_id=0,
        pass_index=0,
        line_index=0,
        device_time_s=0.0,
        points_mm=np.zeros((2, 3)),
        missing=np.zeros(2, dtype=np.bool_),
        laser_mm=nowhere,
        plane_normal=nowhere,
        travel=nowhere,
        position_mm=0.0,
        line_spacing_mm=0.2,
        step_mm=0.2,
    )


def _line(number: int, line_index: int | None = None, position_mm: float | None = None) -> StoredLine:
    position = 0.2 * number if position_mm is None else position_mm
    xyz_q = np.zeros((_PLACES, 3), dtype=np.int32)
    xyz_q[:, 0] = np.arange(_PLACES) * 1000
    xyz_q[:, 1] = round(position * 8192)
    return StoredLine(
        device_id="warm-up",
        boot_id=0,
        pass_index=0,
        line_index=number if line_index is None else line_index,
        device_time_s=0.0,
        xyz_q=xyz_q,
        index=np.arange(_PLACES, dtype=np.int32),
        point_count=_PLACES,
        laser_mm=np.array([0.0, position, 100.0]),
        plane_normal=np.array([0.0, 1.0, 0.0]),
        travel=np.array([0.0, 1.0, 0.0]),
        position_mm=position,
        line_spacing_mm=0.2,
        step_mm=0.2,
    )
