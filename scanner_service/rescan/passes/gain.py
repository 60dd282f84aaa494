"""What a pass would bring to each place: angle, density, and whether that is enough; knows no rig and no order."""

import math
from dataclasses import dataclass

import numpy as np

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.rescan.passes.again import looked_at_alike
from scanner_service.rescan.passes.known_surface import KnownSurface
from scanner_service.rescan.passes.motion import Motion
from scanner_service.rescan.passes.needs import Needs
from scanner_service.rescan.passes.optics import ScannerOptics
from scanner_service.rescan.passes.visibility import both_see

SLACK = 1.05
"""Lines are planned this much closer than they may be: normals are estimates."""
MARGIN = 1.25
"""The density aimed at is this much above the one required: normals are estimates, some rays are lost by chance, and
points do not lie evenly."""
SERVED = 1.1
"""What gets this much more than is required counts as served."""


@dataclass(frozen=True, slots=True)
class Prospect:
    """What a motion offers each place (n,): stage position, incidence, and the coarsest line spacing that is enough.

    `position_mm` NaN: the laser plane never meets the place. `coarsest_mm` is 0 where no line spacing helps,
    or an earlier pass has looked at the place from there.
    `per_line_mm` is the density (n,) times the line spacing: points for each mm along a line and mm of travel.
    `laser_blocked`, `camera_blocked`, `too_steep`, `out_of_range`, `out_of_fan` say why not.
    """

    position_mm: Float64Array
    incidence_rad: Float64Array
    coarsest_mm: Float64Array
    per_line_mm: Float64Array
    too_steep: BoolArray
    out_of_range: BoolArray
    out_of_fan: BoolArray
    laser_blocked: BoolArray
    camera_blocked: BoolArray

    def __post_init__(self) -> None:
        for name in self.__slots__:
            read_only(getattr(self, name))


def prospect_of(surface: KnownSurface, needs: Needs, motion: Motion, optics: ScannerOptics) -> Prospect:
    """What `motion` offers each of the needs.

    Notes
    -----
    A ray and a line stand for the area δp·Δs·|v| across the ray, which a surface of normal n spreads over that area
    times |d_z| / |n·d|, with d the ray's direction and d_z its part along the sensor's z; so
    ρ = |n·d| / (|d_z|·δp(z)·Δs·|v|), which is 1/(Δs'·δp') of section 1 of the method for a straight pass. There, too,
    the lines lie Δs' = Δs·|v| / sqrt(1 - (n·m)²) apart on the surface, with m the normal of the laser plane.
    """
    sights = motion.sights(needs.places_mm, optics)
    to_laser = sights.laser_mm - needs.places_mm
    distance = np.linalg.norm(to_laser, axis=1)
    to_camera = sights.camera_mm - needs.places_mm
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.einsum("ij,ij->i", needs.normals, to_laser) / distance
        camera = np.einsum("ij,ij->i", needs.normals, to_camera) / np.linalg.norm(to_camera, axis=1)
        upright = (optics.geometry.laser_mm[2] - sights.local_mm[:, 2]) / distance
        density = cosine / (upright * optics.point_spacing_mm(sights.local_mm[:, 2]) * sights.advance)
        sine = np.sqrt(np.maximum(1.0 - np.einsum("ij,ij->i", needs.normals, sights.plane) ** 2, 1e-12))
        by_lines = needs.spacing_mm * sine / (SLACK * sights.advance)
    low, high = optics.geometry.range_mm
    met = np.isfinite(sights.position_mm) & (density > 0)
    too_steep = ~(cosine >= np.cos(np.minimum(optics.limit_rad(needs.thin), needs.incidence_rad))) | ~(
        camera >= math.cos(optics.max_camera_rad)
    )
    out_of_range = ~((sights.local_mm[:, 2] >= low) & (sights.local_mm[:, 2] <= high))
    out_of_fan = ~(np.abs(optics.across(sights.local_mm)) <= 1.0)
    asked = met & ~(too_steep | out_of_range | out_of_fan)
    laser, both = both_see(surface, needs.places_mm, needs.normals, sights, asked)
    in_vain = looked_at_alike(surface, needs, motion, sights, optics)
    coarsest = np.where(both & ~in_vain, np.fmin(density / (MARGIN * needs.density_per_mm2), by_lines), 0.0)
    return Prospect(
        position_mm=sights.position_mm.copy(),
        incidence_rad=np.arccos(np.clip(cosine, -1.0, 1.0)),
        coarsest_mm=coarsest,
        per_line_mm=np.where(met, density, 0.0),
        too_steep=too_steep,
        out_of_range=out_of_range,
        out_of_fan=out_of_fan,
        laser_blocked=asked & ~laser,
        camera_blocked=asked & laser & ~both,
    )
