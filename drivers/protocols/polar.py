"""Distances over angles become x and z in the sensor frame, codes become reasons; knows no protocol.

The convention of all scanners that turn: angle 0 is straight ahead, and straight ahead is -z, as a line scanner looks
down on its part. Angles grow counter-clockwise for whoever looks at the scanner from above; seen along the travel (+y)
that is from ahead to the right: x = r sin(angle), z = -r cos(angle), and the top of the housing looks along -y.
"""

import numpy as np

from drivers.scanline import BoolArray, Float64Array


def sensor_from_polar(range_mm: Float64Array, angle_rad: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return x and z (n,) of ranges (n,) over angles (n,); NaN where the range is NaN."""
    return range_mm * np.sin(angle_rad), -range_mm * np.cos(angle_rad)


def reasons_of(range_mm: Float64Array, reasons: dict[str, BoolArray]) -> dict[str, int]:
    """Set ranges (n,) to NaN where a reason (n,) holds, in place; return how many points each reason took."""
    counts = {}
    for reason, holds in reasons.items():
        takes = holds & ~np.isnan(range_mm)
        range_mm[takes] = np.nan
        if n := int(takes.sum()):
            counts[reason] = n
    return counts
