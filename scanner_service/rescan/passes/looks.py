"""Where a pass has looked and nothing came back: space that would have returned light had there been surface.

A place behind known surface counts as hidden. Where a later, or an earlier, pass looked into it with laser and camera,
head-on enough, and its rays returned nothing, it is empty after all. Knows the poses of passes, no regions.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.passes.emptying import empty_places
from scanner_service.rescan.passes.motion import StraightMotion
from scanner_service.rescan.passes.optics import ScannerOptics

_RAYS_AROUND = 2
MAX_LOOKS = 64


@dataclass(frozen=True, slots=True)
class Look:
    """One straight pass as it was driven, and which of its rays came back.

    `returned` (lines, rays) is True where a point of the line and ray, or of a neighbour, was measured; line k was
    taken at `start_mm` + k `step_mm`.
    """

    motion: StraightMotion
    start_mm: float
    step_mm: float
    returned: BoolArray

    def __post_init__(self) -> None:
        read_only(self.returned)


def look_of(
    snapshot: MapSnapshot, pass_number: int, motion: StraightMotion, start_mm: float, end_mm: float, rays: int
) -> Look | None:
    """What came back of a pass of the map; None when none of its lines is there.

    Parameters
    ----------
    pass_number : as in the snapshot's lines.
    motion, start_mm, end_mm : how it was driven; positions are those of the lines.
    rays : of the scanner's fan; a point's `index` is its ray.
    """
    lines = snapshot.lines
    mine = np.flatnonzero((lines.pass_number == pass_number) & ~lines.stationary)
    if not len(mine):
        return None
    spacing = float(lines.line_spacing_mm[mine[0]])
    step = spacing if end_mm >= start_mm else -spacing
    count = int(abs(end_mm - start_mm) / spacing + 1e-9) + 1
    row_of = np.full(len(lines), -1, dtype=np.int64)
    row_of[mine] = np.rint((lines.position_mm[mine] - start_mm) / step).astype(np.int64)
    seen = np.zeros((count, rays), dtype=np.bool_)
    row, ray = row_of[snapshot.line], snapshot.index
    inside = (row >= 0) & (row < count) & (ray < rays)
    seen[row[inside], ray[inside]] = True
    missing = np.ones(count, dtype=np.bool_)  # a line that was lost says nothing
    there = row_of[mine]
    missing[there[(there >= 0) & (there < count)]] = False
    seen[missing] = True
    wide = seen.copy()
    for shift in range(1, _RAYS_AROUND + 1):
        wide[:, shift:] |= seen[:, :-shift]
        wide[:, :-shift] |= seen[:, shift:]
    wide[1:] |= seen[:-1]
    wide[:-1] |= seen[1:]
    return Look(motion, start_mm, step, wide)


def mark_empty(
    state: npt.NDArray[np.uint8],
    low_mm: Float64Array,
    cell_mm: float,
    looks: tuple[Look, ...],
    optics: ScannerOptics,
    frontier: npt.NDArray[np.int64],
    normals: Float64Array,
) -> int:
    """Free the hidden cells of `state` that the looks found empty; returns how many.

    `frontier` (f, 3) are the cells where hidden space begins, `normals` (f, 3) where they face.
    """
    entry = np.full(state.shape, -1, dtype=np.int32)
    entry[frontier[:, 0], frontier[:, 1], frontier[:, 2]] = np.arange(len(frontier))
    geometry = optics.geometry
    freed = 0
    for look in looks[-MAX_LOOKS:]:
        pose = look.motion.at_zero
        along = look.motion.travel @ pose.rotation
        freed += empty_places(
            state, low_mm, cell_mm, pose.rotation, pose.translation_mm, look.motion.travel, along, look.start_mm,
            look.step_mm, look.returned, geometry.laser_mm, geometry.camera_mm, *geometry.range_mm,
            optics.middle_mm, optics.field_of_view_mm, entry, normals, float(np.cos(optics.max_incidence_rad)),
        )  # fmt: skip
    return freed
