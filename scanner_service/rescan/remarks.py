"""What somebody should be told of a requirement once there is a scan: what it cannot give, and what lies beside it.

Refuses nothing: what contradicts itself is refused where it is asked for (`requirement`).
"""

import numpy as np

from drivers.scanline import BoolArray
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.requirement import Requirement

_LEAST_POINTS = 200  # fewer say nothing of where a scan lies
_DENSEST = 0.05  # of the lines: few are denser along the line than this share of them


def remarks_on(requirement: Requirement, snapshot: MapSnapshot) -> tuple[str, ...]:
    """Sentences, the most urgent first; none while all is well, or there are too few points."""
    counted = snapshot.neighbours > 0
    if np.count_nonzero(counted) < _LEAST_POINTS:
        return ()
    said = (_of_interest(requirement, snapshot, counted), _of_density(requirement, snapshot))
    return tuple(sentence for sentence in said if sentence is not None)


def _of_interest(requirement: Requirement, snapshot: MapSnapshot, counted: BoolArray) -> str | None:
    """A region of interest in which nothing was scanned, once a pass is over: until then the scan may come to it."""
    if requirement.interest is None or not snapshot.settled[counted].all():
        return None
    points_mm = snapshot.points_mm[counted]
    if requirement.interest.holds(points_mm).any():
        return None
    spans = (
        f"{axis} {low:.1f} to {high:.1f}"
        for axis, low, high in zip("xyz", points_mm.min(axis=0), points_mm.max(axis=0), strict=True)
    )
    return (
        f"no point of the scan lies in the region of interest, so nothing is judged: points are at {', '.join(spans)} "
        "mm; correct the region of interest, or scan there"
    )


def _of_density(requirement: Requirement, snapshot: MapSnapshot) -> str | None:
    """A density that no single pass can give, by the spacing of its points and the finest of lines."""
    known_mm = snapshot.lines.point_spacing_mm[np.isfinite(snapshot.lines.point_spacing_mm)]
    if requirement.density_per_mm2 is None or not len(known_mm):
        return None
    point_mm, line_mm = float(np.quantile(known_mm, _DENSEST)), requirement.finest_line_spacing_mm
    most_per_mm2 = 1.0 / (point_mm * line_mm)
    if requirement.density_per_mm2 <= most_per_mm2:
        return None
    return (
        f"a density of {_told(requirement.density_per_mm2)} points/mm² is more than a pass of this scanner gives: "
        f"points {point_mm:.2g} mm apart on lines {line_mm:g} mm apart are {_told(most_per_mm2)} points/mm²; ask for "
        "less"
    )


def _told(density_per_mm2: float) -> str:
    """To three digits where it is small: what is less than one is not nothing."""
    return f"{density_per_mm2:,.0f}" if density_per_mm2 >= 100.0 else f"{density_per_mm2:.3g}"
