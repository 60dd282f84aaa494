"""Where the laser stood at each line, from a position given once (pure); knows no file."""

from math import isfinite

import numpy as np

from drivers.scanline import Float64Array
from scanner_service.storage.formats.errors import OptionRefused
from scanner_service.storage.formats.parallel_lines import ParallelLines

_AXES = "xyz"


def laser_of_lines(
    laser_mm: tuple[float, float, float], fit: ParallelLines | None, lines: int, name: str
) -> Float64Array:
    """The laser position of every line (L, 3); a coordinate that is NaN becomes the line's own place.

    Raises
    ------
    OptionRefused : a coordinate is left open that is not the one along which the lines follow each other.
    """
    positions = np.tile(np.array(laser_mm), (lines, 1))
    for axis in np.flatnonzero(~np.isfinite(laser_mm)):
        if fit is None or abs(fit.normal[axis]) != 1.0:
            raise OptionRefused(
                f"the laser's {_AXES[axis]} may be left open only when the lines of {name} follow each other along "
                f"{_AXES[axis]}; give it in millimetres"
            )
        positions[:, axis] = fit.position_mm * fit.normal[axis]
    return positions


def shown_laser(laser_mm: tuple[float, float, float]) -> str:
    """The position as a note says it."""
    return "(" + ", ".join(f"{value:g}" if isfinite(value) else "place of the line" for value in laser_mm) + ") mm"
