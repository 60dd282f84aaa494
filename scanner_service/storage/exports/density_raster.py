"""Points of a map seen along a direction, as a raster of densities (pure numpy); knows no colour and no region.

The viewer sees the surface that is nearest to the eye and turned to it. A pixel shows the mean density of the judged
points within it; between the points, where a pixel is finer than they are, the nearest point's, up to a bounded reach.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.snapshot import MapSnapshot

_DEPTH_CELLS = 2.0  # the depth of the front surface is taken in cells of so many spacings
_FRONT_CELLS = 3.0  # and is so many of those cells thick, since a flank falls within one
_REACH = 0.8  # of the larger spacing: half the diagonal of the gap between four points, and a little


@dataclass(frozen=True, slots=True)
class View:
    """How the part is looked at: unit vectors in the part frame, right-handed, `back` towards the eye."""

    right: Float64Array
    up: Float64Array
    back: Float64Array


@dataclass(frozen=True, slots=True)
class DensityRaster:
    """What is seen: `density_per_mm2` (rows, columns), row 0 at the bottom, NaN where `seen` shows no judged point.

    `left_mm`, `bottom_mm` are the lower left corner along right and up; `reach_mm` is how far a pixel may lie from the
    point that it shows.
    """

    density_per_mm2: Float64Array
    seen: BoolArray
    left_mm: float
    bottom_mm: float
    pixel_mm: float
    reach_mm: float

    @property
    def extent_mm(self) -> tuple[float, float, float, float]:
        """Left, right, bottom, top."""
        rows, columns = self.seen.shape
        return (
            self.left_mm,
            self.left_mm + columns * self.pixel_mm,
            self.bottom_mm,
            self.bottom_mm + rows * self.pixel_mm,
        )


def view_along(direction: Float64Array) -> View:
    """Look along `direction` (3,) with z up; straight down or up, with y up.

    Raises
    ------
    ValueError : the direction has no length.
    """
    length = float(np.linalg.norm(direction))
    if not (np.isfinite(length) and length > 0):
        raise ValueError(f"a view needs a direction, not {np.asarray(direction).tolist()}")
    back = -np.asarray(direction, dtype=np.float64) / length
    upright = np.array([0.0, 0.0, 1.0]) if abs(back[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    up = upright - (upright @ back) * back
    up /= np.linalg.norm(up)
    return View(np.cross(up, back), up, back)


def judged(snapshot: MapSnapshot) -> BoolArray:
    """True for the points whose density says something: settled and reliable."""
    return np.asarray(snapshot.settled & snapshot.reliable)


def rasterise(snapshot: MapSnapshot, view: View, pixels: int) -> DensityRaster:
    """Draw a snapshot of at least one point into at most `pixels` pixels along the longer side."""
    across = snapshot.points_mm @ view.right
    upward = snapshot.points_mm @ view.up
    spacing = _spacing(snapshot)
    left, bottom = float(across.min()) - spacing, float(upward.min()) - spacing
    width = max(float(across.max()) - left, float(upward.max()) - bottom) + spacing
    pixel = width / pixels
    reach = max(_REACH * spacing, pixel)
    shape = (int((upward.max() + spacing - bottom) / pixel) + 1, int((across.max() + spacing - left) / pixel) + 1)
    front = _front(snapshot, view, across - left, upward - bottom, _DEPTH_CELLS * max(spacing, pixel))
    row = ((upward[front] - bottom) / pixel).astype(np.int64)
    column = ((across[front] - left) / pixel).astype(np.int64)
    cell = row * shape[1] + column
    cells = shape[0] * shape[1]
    seen = np.bincount(cell, minlength=cells).reshape(shape) > 0
    good = judged(snapshot)[front]
    count = np.bincount(cell[good], minlength=cells)
    total = np.bincount(cell[good], snapshot.density_per_mm2[front][good], minlength=cells)
    density = np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(shape)
    distance, (nearest_row, nearest_column) = distance_transform_edt(~seen, return_indices=True)
    near: npt.NDArray[np.bool_] = distance * pixel <= reach
    density = np.where(near, density[nearest_row, nearest_column], np.nan)
    return DensityRaster(density, near, left, bottom, pixel, reach)


def _spacing(snapshot: MapSnapshot) -> float:
    """The larger of line and point spacing, as a typical line has it; 1 mm where neither is known.

    A plain cloud is one line with no other beside it: there a typical point tells, by how many share its neighbourhood.
    """
    lines = snapshot.lines
    if len(lines) == 1:
        told = (snapshot.radius_mm > 0) & (snapshot.neighbours > 1)
        if told.any():
            return float(np.median(snapshot.radius_mm[told] * np.sqrt(np.pi / snapshot.neighbours[told])))
        per_line = lines.point_spacing_mm
    else:
        per_line = np.fmax(lines.line_spacing_mm, lines.point_spacing_mm)
    per_line = per_line[np.isfinite(per_line) & (per_line > 0)]
    return float(np.median(per_line)) if len(per_line) else 1.0


def _front(
    snapshot: MapSnapshot, view: View, across: Float64Array, upward: Float64Array, cell_mm: float
) -> npt.NDArray[np.int64]:
    """Rows of the points that the eye sees: turned to it where any are, and not far behind the nearest one."""
    columns = int(across.max() / cell_mm) + 1
    cell = (upward / cell_mm).astype(np.int64) * columns + (across / cell_mm).astype(np.int64)
    _, cell = np.unique(cell, return_inverse=True)
    cells = int(cell.max()) + 1
    turned = ~(snapshot.normals @ view.back < 0)  # an unknown normal may face either way
    visible = turned | ~(np.bincount(cell[turned], minlength=cells) > 0)[cell]
    rows = np.flatnonzero(visible)
    height = snapshot.points_mm[rows] @ view.back
    top = np.full(cells, -np.inf)
    np.maximum.at(top, cell[rows], height)
    return rows[height >= top[cell[rows]] - _FRONT_CELLS * cell_mm]
