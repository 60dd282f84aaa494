"""Types of Hokuyo lidars, and a scan of one as the characters of its data lines; knows no request and no time."""

from dataclasses import dataclass

import numpy as np

from drivers.protocols.scip import SINGLES, STREAMS, IntArray, encode_value
from drivers.protocols.scip_echoes import ECHO_SINGLES, ECHO_STREAMS, echo_characters
from drivers.scanline import Float64Array


@dataclass(frozen=True, slots=True)
class Model:
    """What a type of lidar says in PP; a turn is `steps_per_turn` steps, `front` looks ahead."""

    name: str
    min_mm: int
    max_mm: int
    steps_per_turn: int
    first: int
    last: int
    front: int
    rpm: int
    tells_echoes: bool = False

    def angles_rad(self, start: int, end: int) -> Float64Array:
        """Angles (n,) of the steps from `start` to `end`, 0 ahead, counter-clockwise."""
        steps = np.arange(start, end + 1, dtype=np.float64)
        return np.asarray((steps - self.front) * (2 * np.pi / self.steps_per_turn))


URG_04LX = Model("URG-04LX(Hokuyo Automatic Co.,Ltd.)", 20, 5600, 1024, 44, 725, 384, 600)
UTM_30LX = Model("UTM-30LX[Serial No]", 23, 60_000, 1440, 0, 1080, 540, 2400)
UTM_30LX_EW = Model("UTM-30LX-EW", 23, 60_000, 1440, 0, 1080, 540, 2400, tells_echoes=True)
_FIRST_LIGHT, _FURTHER_LIGHT = 1000, 2500
"""Intensities: what the beam goes through gives back less than what it ends on."""


def scan_characters(
    model: Model, command: str, cluster: int, ranges_mm: Float64Array, further_mm: Float64Array
) -> bytes:
    """Return what a lidar says of the ranges (n,) and, with echoes, of what lies behind them; NaN = nothing there."""
    values = _nearest(model, ranges_mm, cluster)
    echo_width = (ECHO_STREAMS | ECHO_SINGLES).get(command)
    if echo_width is not None:
        each = np.stack([values, _nearest(model, further_mm, cluster)], axis=1).tolist()
        lights = (_FIRST_LIGHT, _FURTHER_LIGHT)
        echoes = [[(mm, light) for mm, light in zip(step, lights, strict=True) if mm] or [(0, 0)] for step in each]
        return echo_characters([[echo[: echo_width // 3] for echo in step] for step in echoes])
    width = (STREAMS | SINGLES)[command]
    if width == 2:
        values = np.where(values < 1 << 12, values, 0)
    if width == 6:
        return b"".join(encode_value(value, 3) + encode_value(1000 if value else 0, 3) for value in values)
    return b"".join(encode_value(int(value), width) for value in values)


def _nearest(model: Model, ranges_mm: Float64Array, cluster: int) -> IntArray:
    """The smallest distance of each cluster in whole mm, 0 where there is none."""
    rounded = np.rint(ranges_mm)
    valid = (rounded >= model.min_mm) & (rounded <= model.max_mm)
    padded = np.full(-(-len(rounded) // cluster) * cluster, np.inf)
    padded[: len(rounded)] = np.where(valid, rounded, np.inf)
    nearest = padded.reshape(-1, cluster).min(axis=1)
    return np.where(np.isfinite(nearest), nearest, 0).astype(np.int64)
