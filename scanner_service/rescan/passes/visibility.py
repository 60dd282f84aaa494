"""What a place on the part can see, laser and camera alike, against all that is solid or hidden; knows no density."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.rescan.passes.known_surface import KnownSurface
from scanner_service.rescan.passes.motion import Sights
from scanner_service.rescan.passes.sights import clear_sights, clear_ways

DIRECTIONS = 900  # about 7 degrees apart
APART_RAD = math.radians(8.0)
"""No direction is further than this from the nearest one that is listed."""


def directions_everywhere(count: int = DIRECTIONS) -> Float64Array:
    """Unit vectors (count, 3) spread evenly over the sphere (Fibonacci lattice, Gonzalez 2010)."""
    turn = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    flat = np.sqrt(1.0 - z * z)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])


@dataclass(frozen=True, slots=True)
class OpenSky:
    """For each place (n,) which of `directions` (d, 3) lead out of the part unhindered: `open` (n, d)."""

    directions: Float64Array
    open: BoolArray

    def __post_init__(self) -> None:
        read_only(self.directions)
        read_only(self.open)

    def along(self, direction: Float64Array) -> BoolArray:
        """(n,) whether the sky is open in the listed direction that is nearest to `direction` (3,)."""
        column: BoolArray = self.open[:, int(np.argmax(self.directions @ direction))]
        return column


def look_around(
    surface: KnownSurface,
    places_mm: Float64Array,
    normals: Float64Array,
    largest_angle_rad: float,
    asked: Callable[[Float64Array], BoolArray] | None = None,
) -> OpenSky:
    """The open sky of places (n, 3), up to an angle from their normals (n, 3).

    Only directions in which `asked` says that laser or camera may stand are looked along; the others count as closed.
    """
    directions = directions_everywhere()
    sky = np.zeros((len(places_mm), len(directions)), dtype=np.bool_)
    which = np.ones(len(directions), dtype=np.bool_) if asked is None else asked(directions)
    found = np.zeros((len(places_mm), int(which.sum())), dtype=np.bool_)
    least = math.cos(min(largest_angle_rad + math.radians(5.0), math.pi / 2))
    clear_ways(*_in_the_way(surface), places_mm, normals, directions[which], least, found)
    sky[:, which] = found
    return OpenSky(directions, sky)


def both_see(
    surface: KnownSurface, places_mm: Float64Array, normals: Float64Array, sights: Sights, asked: BoolArray
) -> tuple[BoolArray, BoolArray]:
    """(n,) whether the laser reaches each place, and whether the camera sees it; False where not `asked`."""
    laser, camera = np.zeros(len(places_mm), dtype=np.bool_), np.zeros(len(places_mm), dtype=np.bool_)
    grid = _in_the_way(surface)
    clear_sights(*grid, places_mm, normals, sights.laser_mm, asked, laser)
    clear_sights(*grid, places_mm, normals, sights.camera_mm, asked & laser, camera)
    return laser, camera


def _in_the_way(
    surface: KnownSurface,
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int32], Float64Array, Float64Array, Float64Array, float]:
    """What the kernels of `sights` ask for: a wall that was seen from both sides has no side to pass on."""
    facing = np.where(surface.two_sided[:, None], 0.0, surface.normals)
    return surface.state, surface.row, surface.points_mm, facing, surface.low_mm, surface.cell_mm
