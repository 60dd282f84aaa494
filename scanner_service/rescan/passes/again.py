"""Which places a pass would look at as an earlier one did, and see no more of them; knows no gain and no rig."""

import math

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array
from scanner_service.rescan.passes.known_surface import KnownSurface
from scanner_service.rescan.passes.looks import MAX_LOOKS, Look
from scanner_service.rescan.passes.motion import Motion, Sights, StraightMotion
from scanner_service.rescan.passes.needs import Evidence, Needs
from scanner_service.rescan.passes.optics import ScannerOptics

_ALIKE = math.cos(math.radians(3.0))
"""Laser and camera stand where they stood when the way to each turned by no more: a shadow 10 mm deep moves by half a
millimetre then, about a cell."""
_TURNED = math.radians(20.0)  # sensors turned further against each other share no way to both, anywhere in the fan


def looked_at_alike(
    surface: KnownSurface, needs: Needs, motion: Motion, sights: Sights, optics: ScannerOptics
) -> BoolArray:
    """(n,) True for places that a pass would meet in vain, since an earlier one met them from the same side.

    A place that is guessed would have points if laser and camera saw it from there. A place whose points fail for the
    shadow beside them fails again. What lacks density, line spacing or quiet points is another matter.

    Parameters
    ----------
    motion, sights : the pass, and how it sees the needs.
    """
    alike = np.zeros(len(needs), dtype=np.bool_)
    if not (isinstance(motion, StraightMotion) and surface.looks and len(needs)):
        return alike
    row = surface.row.reshape(-1)[surface.keys(needs.places_mm)]
    rows = np.flatnonzero((needs.evidence != Evidence.MEASURED) | ((row >= 0) & surface.by_shadow[row]))
    for look in surface.looks[-MAX_LOOKS:]:
        if _angle_rad(look.motion.at_zero.rotation, motion.at_zero.rotation) <= _TURNED:
            alike[rows] |= _met(look, needs.places_mm[rows], sights, rows, optics)
    return alike


def _met(
    look: Look, places_mm: Float64Array, sights: Sights, rows: npt.NDArray[np.intp], optics: ScannerOptics
) -> BoolArray:
    """(k,) whether a look had lines over places (k, 3), and its laser and camera where `sights` has them."""
    then = look.motion.sights(places_mm, optics)
    low, high = optics.geometry.range_mm
    line = np.nan_to_num((then.position_mm - look.start_mm) / look.step_mm, nan=-1.0)
    met = (line >= 0.0) & (line <= len(look.returned) - 1) & (np.abs(optics.across(then.local_mm)) <= 1.0)
    met &= (then.local_mm[:, 2] >= low) & (then.local_mm[:, 2] <= high)
    for now_mm, then_mm in ((sights.laser_mm, then.laser_mm), (sights.camera_mm, then.camera_mm)):
        one, other = now_mm[rows] - places_mm, then_mm - places_mm
        size = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
        met &= np.einsum("ij,ij->i", one, other) >= _ALIKE * size
    lost: BoolArray = np.asarray(look.returned.all(axis=1))  # a line that was lost says nothing
    met[met] = ~lost[np.rint(line[met]).astype(np.int64)]
    return met


def _angle_rad(one: Float64Array, other: Float64Array) -> float:
    """By how much one rotation (3, 3) is turned against another."""
    return math.acos(max(-1.0, min(1.0, 0.5 * (float(np.trace(one.T @ other)) - 1.0))))
