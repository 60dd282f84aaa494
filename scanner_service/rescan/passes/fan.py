"""A scanner's field of view and ray spacing from what it measured itself; guesses nothing it has not seen."""

import numpy as np
import numpy.typing as npt

from drivers.scanline import Float64Array, SensorGeometry
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.errors import OpticsUnknown
from scanner_service.rescan.passes.motion import Motion
from scanner_service.rescan.passes.optics import ScannerOptics

_LEAST_POINTS, _MOST_POINTS = 50, 20_000
Int64Array = npt.NDArray[np.int64]


def measured_optics(snapshot: MapSnapshot, geometry: SensorGeometry, motion: Motion, rays: int) -> ScannerOptics:
    """The optics of a scanner whose rays pass z = 0 at equal steps, from points of a pass that was driven by `motion`.

    The place at which a point's ray passes z = 0 is a straight line over its number in the scanline.

    Raises
    ------
    OpticsUnknown : too few points, or they do not lie on such rays.
    """
    whole = ScannerOptics(geometry, 1.0, rays)
    is_first = (snapshot.lines.pass_number == 0) & np.isfinite(snapshot.lines.position_mm)
    use = np.flatnonzero((snapshot.neighbours > 0) & is_first[snapshot.line])
    use = use[:: max(7, len(use) // _MOST_POINTS)]
    if len(use) < _LEAST_POINTS:
        raise OpticsUnknown("the scan has too few points yet to tell the scanner's field of view: scan a pass first")
    at_zero = 0.5 * whole.across(_in_sensor(snapshot, use, motion))
    index = snapshot.index[use].astype(np.float64)
    slope, start = np.polyfit(index, at_zero, 1)
    off = np.median(np.abs(at_zero - start - slope * index))
    if not (np.isfinite(slope) and abs(slope) > 0 and off < 0.5 * abs(slope)):
        raise OpticsUnknown("the points do not lie on rays at equal steps: state the scanner's field of view")
    width = abs(float(slope)) * (rays - 1)
    return ScannerOptics(geometry, width, rays, float(start + 0.5 * slope * (rays - 1)))


def _in_sensor(snapshot: MapSnapshot, use: Int64Array, motion: Motion) -> Float64Array:
    """Points (k, 3) in the sensor frame of the moment when they were measured: on a turntable two moments may do."""
    lines, which = np.unique(snapshot.line[use], return_inverse=True)
    poses = [motion.part_from_sensor(float(at_mm)) for at_mm in snapshot.lines.position_mm[lines]]
    rotations = np.array([pose.rotation for pose in poses])[which]
    origins = np.array([pose.translation_mm for pose in poses])[which]
    return np.asarray(np.einsum("ki,kij->kj", snapshot.points_mm[use] - origins, rotations))
