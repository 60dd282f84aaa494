"""Compiling the kernels before the first scanline, so that no scan ever waits for a compiler; knows no service."""

import threading

import numpy as np

from scanner_service.analysis.intake import StoredLine
from scanner_service.analysis.live_map import LiveMap, MapSettings
from scanner_service.analysis.radius import RadiusSettings

_LOCK = threading.Lock()
_READY = threading.Event()


def kernels_are_ready() -> bool:
    """True once every kernel of the live map is compiled in this process."""
    return _READY.is_set()


def warm_up() -> None:
    """Compile every kernel, or load it from the cache; returns at once when that was done before."""
    with _LOCK:
        if _READY.is_set():
            return
        for c_mm in (0.1, 50.0):  # narrow and wide integers
            live_map = LiveMap(MapSettings(radius=RadiusSettings(c_mm), max_points=4096))
            for number in range(4):
                live_map.add(_line(number))
                live_map.refresh()
            live_map.add(_line(1, line_index=9, position_mm=0.21))
            live_map.snapshot()
            live_map.close_all_passes()
            live_map.snapshot()
        _READY.set()


def _line(number: int, line_index: int | None = None, position_mm: float | None = None) -> StoredLine:
    position = 0.2 * number if position_mm is None else position_mm
    xyz_q = np.zeros((12, 3), dtype=np.int32)
    xyz_q[:, 0] = np.arange(12) * 1000
    xyz_q[:, 1] = round(position * 8192)
    return StoredLine(
        device_id="warm-up",
        boot_id=0,
        pass_index=0,
        line_index=number if line_index is None else line_index,
        device_time_s=0.0,
        xyz_q=xyz_q,
        index=np.arange(12, dtype=np.int32),
        point_count=12,
        laser_mm=np.array([0.0, position, 100.0]),
        plane_normal=np.array([0.0, 1.0, 0.0]),
        travel=np.array([0.0, 1.0, 0.0]),
        position_mm=position,
        line_spacing_mm=0.2,
        step_mm=0.2,
    )
