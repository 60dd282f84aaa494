"""A scanner's field of view and ray spacing from what it measured itself; guesses nothing it has not seen."""

import numpy as np

from drivers.scanline import SensorGeometry
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.errors import OpticsUnknown
from scanner_service.rescan.passes.motion import Motion
from scanner_service.rescan.passes.optics import ScannerOptics

_LEAST_POINTS = 50


def measured_optics(snapshot: MapSnapshot, geometry: SensorGeometry, motion: Motion, rays: int) -> ScannerOptics:
    """The optics of a scanner whose rays pass z = 0 at equal steps, from points of a pass that was driven by `motion`.

    The place at which a point's ray passes z = 0 is a straight line over its number in the scanline.

    Raises
    ------
    OpticsUnknown : too few points, or they do not lie on such rays.
    """
    whole = ScannerOptics(geometry, 1.0, rays)
    use = np.flatnonzero((snapshot.neighbours > 0) & (snapshot.lines.pass_number[snapshot.line] == 0))[::7]
    if len(use) < _LEAST_POINTS:
        raise OpticsUnknown("the scan has too few points yet to tell the scanner's field of view: scan a pass first")
    at_zero = 0.5 * whole.across(motion.sights(snapshot.points_mm[use], whole).local_mm)
    index = snapshot.index[use].astype(np.float64)
    slope, start = np.polyfit(index, at_zero, 1)
    off = np.median(np.abs(at_zero - start - slope * index))
    if not (np.isfinite(slope) and abs(slope) > 0 and off < 0.5 * abs(slope)):
        raise OpticsUnknown("the points do not lie on rays at equal steps: state the scanner's field of view")
    width = abs(float(slope)) * (rays - 1)
    return ScannerOptics(geometry, width, rays, float(start + 0.5 * slope * (rays - 1)))
