"""Lines for the record's tests: any content under any key, told apart bit for bit."""

import struct
from dataclasses import fields

import numpy as np

from scanner_service.analysis.intake import StoredLine


def line_of(line_index: int, seed: int = 0, device_id: str = "s1", boot_id: int = 1, points: int = 40) -> StoredLine:
    """A line whose content follows from its key and `seed`."""
    rng = np.random.default_rng([line_index, seed, boot_id])
    index = np.flatnonzero(rng.random(points) < 0.9).astype(np.int32)
    return StoredLine(
        device_id=device_id,
        boot_id=boot_id,
        pass_index=line_index // 100,
        line_index=line_index,
        device_time_s=line_index * 1e-3,
        xyz_q=rng.integers(-(2**31), 2**31, (len(index), 3)).astype(np.int32),
        index=index,
        point_count=points,
        laser_mm=rng.normal(size=3),
        plane_normal=np.full(3, np.nan),
        travel=np.array([0.0, 1.0, 0.0]),
        position_mm=float("nan"),
        line_spacing_mm=0.2,
        step_mm=0.2,
        dropped={"dropout": points - len(index)} if len(index) < points else {},
    )


def bits(line: StoredLine) -> tuple[object, ...]:
    """All that a line is, NaN payloads included."""
    return tuple(_bits(getattr(line, field.name)) for field in fields(StoredLine))


def _bits(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, dict):
        return tuple(value.items())
    return struct.pack("<d", value) if isinstance(value, float) else value
