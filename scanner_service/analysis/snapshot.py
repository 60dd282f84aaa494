"""What a reader of the live map gets: frozen arrays, one row a point or one row a scanline; computes nothing."""

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array, read_only

Int32Array = npt.NDArray[np.int32]
UInt8Array = npt.NDArray[np.uint8]


class Unreliable(IntEnum):
    """Why a point's normal is not given; RELIABLE when it is."""

    RELIABLE = 0
    TOO_FEW = 1  # Np < 6, the point itself counted
    SINGLE_LINE = 2  # the plane fitted would be the laser plane
    ILL_DETERMINED = 3  # predicted normal error above the limit
    NOT_COUNTED = 4  # stationary line or over-dense cell: kept in the record, left out of the map


class RadiusRule(IntEnum):
    """Which rule gave a point its radius."""

    LINE_SPACING = 0  # sqrt(2) * line spacing + c (Eq. 6.3)
    POINT_SPACING = 1  # sqrt(2) * point spacing + c, the points being further apart than the lines
    FIXED = 2  # one radius given for the whole cloud
    FLEXIBLE = 3  # grown until 20 points are covered
    GLOBAL = 4  # median radius of a 1 % sample
    GROWN = 5  # grown where the rule left the neighbourhood unreliable


@dataclass(frozen=True, slots=True)
class LineTable:
    """The scanlines of a map, one row each, in the order they were accepted.

    `device` and `pass_number` (L,) number devices and passes within the session (`device_ids` names the former).
    `plane_normal`, `travel` (L, 3) are NaN when unknown, `position_mm` (L,) too. `point_spacing_mm` (L,) is the median
    distance of consecutive points of the line (NaN with fewer than two points). `point_count` (L,) are the places of
    the line, returns or not. `stationary` lines are kept, but their points are not counted.
    """

    device_ids: tuple[str, ...]
    device: Int32Array
    boot_id: npt.NDArray[np.int64]
    pass_number: Int32Array
    line_index: npt.NDArray[np.int64]
    point_count: Int32Array
    laser_mm: Float64Array
    plane_normal: Float64Array
    travel: Float64Array
    position_mm: Float64Array
    line_spacing_mm: Float64Array
    step_mm: Float64Array
    point_spacing_mm: Float64Array
    stationary: BoolArray

    def __len__(self) -> int:
        return len(self.device)


@dataclass(frozen=True, slots=True)
class MapSnapshot:
    """Every point of the live map at one version; arrays of n rows, part frame, millimetres.

    `line` is the row of the point's scanline in `lines`, `index` its place in that line. `neighbours` is Np of
    Eq. 6.4, the point itself counted; 0 for points that are not counted. `same_side` leaves out those whose own ray
    comes from the other side of the plane (a thin wall's back; equal to `neighbours` where no plane is known).
    `density_per_mm2` = Np / (pi r^2).
    `normals` (n, 3) are unit, turned to the scanline's own laser position, NaN where `unreliable` is not 0.
    `offset` is |centroid - p| / r of the neighbourhood, 0 in the middle of a surface, about 0.42 at a straight border.
    `residual_mm` is sqrt(lambda3 / (Np - 3)), NaN below 4 points; `normal_error_rad` the predicted error or NaN.
    """

    version: int
    origin_mm: Float64Array
    points_mm: Float64Array
    line: Int32Array
    index: Int32Array
    radius_mm: Float64Array
    radius_rule: UInt8Array
    neighbours: Int32Array
    same_side: Int32Array
    density_per_mm2: Float64Array
    normals: Float64Array
    unreliable: UInt8Array
    settled: BoolArray
    isolated: BoolArray
    offset: Float64Array
    residual_mm: Float64Array
    normal_error_rad: Float64Array
    lines: LineTable

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                read_only(value)

    def __len__(self) -> int:
        return len(self.points_mm)

    @property
    def side_density_per_mm2(self) -> Float64Array:
        """(n,) density of the point's own side of a thin wall; what verdicts go by."""
        density: Float64Array = self.same_side / (np.pi * self.radius_mm * self.radius_mm)
        return density

    @property
    def unbiased_density_per_mm2(self) -> Float64Array:
        """(n,) (Np - 1) / (pi r^2): under the flexible rule the 20th point set r, so it must not count."""
        density: Float64Array = np.maximum(self.neighbours - 1, 0) / (np.pi * self.radius_mm * self.radius_mm)
        return density

    @property
    def reliable(self) -> BoolArray:
        """True where the normal is given."""
        reliable: BoolArray = self.unreliable == Unreliable.RELIABLE
        return reliable
