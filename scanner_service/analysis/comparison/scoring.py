"""How far estimated normals are from known ones: angles, regardless of sign; knows no method."""

import math
from dataclasses import dataclass

import numpy as np

from drivers.scanline import Float64Array


@dataclass(frozen=True, slots=True)
class Score:
    """Angular errors in radians over the points that have a normal; shares of all points; NaN when none has."""

    rms_rad: float
    median_rad: float
    within_5_deg: float
    within_10_deg: float
    missing: int


def angles_rad(estimated: Float64Array, known: Float64Array) -> Float64Array:
    """Angle (n,) between the lines of unit vectors (n, 3), from 0 to π/2; NaN where one is NaN.

    From sine and cosine, so that small angles keep their digits.
    """
    sine = np.linalg.norm(np.cross(estimated, known), axis=1)
    return np.asarray(np.arctan2(sine, np.abs((estimated * known).sum(axis=1))))


def score(estimated: Float64Array, known: Float64Array) -> Score:
    """The score of normals (n, 3) against known ones; a point without a normal is missing, and within no angle."""
    angle = angles_rad(estimated, known)
    has = np.isfinite(angle)
    if not has.any():
        return Score(math.nan, math.nan, 0.0, 0.0, len(angle))
    found = angle[has]
    return Score(
        rms_rad=float(np.sqrt(np.mean(found * found))),
        median_rad=float(np.median(found)),
        within_5_deg=float((found <= math.radians(5.0)).sum() / len(angle)),
        within_10_deg=float((found <= math.radians(10.0)).sum() / len(angle)),
        missing=int((~has).sum()),
    )
