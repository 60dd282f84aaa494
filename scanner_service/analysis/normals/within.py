"""Planes through everything within a radius, without a list of neighbours: one walk over the boxes a point."""

import numpy as np
import numpy.typing as npt
from numba import njit

from drivers.scanline import Float64Array
from scanner_service.analysis.graphs.kd_tree import Int32Array, KdTree, box_distance_sq, build_kd_tree, node_start
from scanner_service.analysis.graphs.slices import in_slices
from scanner_service.analysis.normals.field import Int64Array, NormalField, NormalOptions, Tell
from scanner_service.analysis.normals.fitting import Weighting, judge_planes, per_square_of, plane_of_sums, weight_of
from scanner_service.analysis.normals.neighbourhoods import PROBE, refuse_crowds


def fit_within(
    method: str,
    points_mm: Float64Array,
    radius_mm: Float64Array,
    options: NormalOptions,
    tell: Tell,
    *,
    weighting: Weighting = Weighting.EQUAL,
    notes: tuple[str, ...] = (),
    extra: dict[str, Float64Array] | None = None,
) -> NormalField:
    """Planes of least squared orthogonal distance through all that lies within each point's radius (n,).

    As `fit_all`, but it holds no neighbours: memory grows with the points alone.

    Raises
    ------
    MethodRefused : the radius reaches so many points that the work would not end.
    """
    n = len(points_mm)
    tree = build_kd_tree(points_mm)
    refuse_crowds(_mean_count(tree, radius_mm), radius_mm)
    normals = np.empty((n, 3))
    reason = np.empty(n, dtype=np.uint8)
    error = np.empty(n)
    counts = np.empty(n, dtype=np.int64)
    done = [0]

    def work(start: int, stop: int) -> None:
        row = tree.row[start:stop]
        axes, moments, effective, count = _fits(tree, radius_mm[row], weighting, start, stop)
        normals[row], reason[row], error[row] = judge_planes(axes, moments, effective, count, options.max_error_rad)
        counts[row] = count
        done[0] += stop - start
        tell(min(done[0] / n, 1.0))

    in_slices(work, n, options.threads)
    return NormalField(method, normals, reason, error, radius_mm.copy(), counts, notes, extra or {})


def _mean_count(tree: KdTree, radius_mm: Float64Array) -> float:
    """How many points the radii (n,) hold on average, by a sample."""
    probe = np.unique(np.linspace(0, len(tree) - 1, PROBE).astype(np.int64))
    count = np.empty(len(probe), dtype=np.int64)
    reach = radius_mm[tree.row[probe]]
    _count(tree.xyz, tree.box, tree.levels, probe, reach * reach, count)
    return float(count.mean())


def _fits(
    tree: KdTree, radius_mm: Float64Array, weighting: Weighting, start: int, stop: int
) -> tuple[Float64Array, Float64Array, Float64Array, Int64Array]:
    """Axes (m, 3), moments (m, 3), effective and plain counts (m,) at the positions `start` to `stop` - 1."""
    m = stop - start
    axes, moments, effective, count = np.empty((m, 3)), np.empty((m, 3)), np.empty(m), np.empty(m, dtype=np.int64)
    _fit(
        tree.xyz,
        tree.box,
        tree.levels,
        start,
        radius_mm * radius_mm,
        int(weighting),
        per_square_of(radius_mm, weighting),
        axes,
        moments,
        effective,
        count,
    )
    return axes, moments, effective, count


@njit(cache=True, nogil=True)
def _count(
    xyz: Float64Array, box: Float64Array, levels: int, at: Int64Array, square: Float64Array, count: Int64Array
) -> None:
    leaf = np.empty(2 << levels, dtype=np.int32)
    waiting = np.empty(levels + 2, dtype=np.int64)
    for i in range(len(at)):
        count[i] = 0
        x, y, z = xyz[at[i], 0], xyz[at[i], 1], xyz[at[i], 2]
        for place in range(_leaves_within(box, levels, x, y, z, square[i], waiting, leaf)):
            for j in range(node_start(leaf[place], levels, len(xyz)), node_start(leaf[place] + 1, levels, len(xyz))):
                dx, dy, dz = xyz[j, 0] - x, xyz[j, 1] - y, xyz[j, 2] - z
                if dx * dx + dy * dy + dz * dz <= square[i]:
                    count[i] += 1


@njit(cache=True, nogil=True)
def _leaves_within(
    box: Float64Array,
    levels: int,
    x: float,
    y: float,
    z: float,
    square: float,
    waiting: npt.NDArray[np.int64],
    leaf: Int32Array,
) -> int:
    """Put the leaves whose boxes come within the radius into `leaf`; how many there are."""
    leaves = 1 << levels
    found = 0
    waiting[0] = 1
    held = 1
    while held > 0:
        held -= 1
        node = waiting[held]
        if box_distance_sq(box, node, x, y, z) > square:
            continue
        if node >= leaves:
            leaf[found] = node
            found += 1
            continue
        waiting[held], waiting[held + 1] = 2 * node + 1, 2 * node
        held += 2
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _fit(
    points: Float64Array,
    box: Float64Array,
    levels: int,
    start: int,
    square: Float64Array,
    weighting: int,
    per_square: Float64Array,
    axes: Float64Array,
    moments: Float64Array,
    effective: Float64Array,
    count: Int64Array,
) -> None:
    """Moments of offsets from the point itself, centred on their weighted mean; nothing is checked."""
    n = len(points)
    leaf = np.empty(2 << levels, dtype=np.int32)
    waiting = np.empty(levels + 2, dtype=np.int64)
    for i in range(len(square)):
        px, py, pz = points[start + i, 0], points[start + i, 1], points[start + i, 2]
        w = w2 = x = y = z = xx = xy = xz = yy = yz = zz = 0.0
        within = 0
        for place in range(_leaves_within(box, levels, px, py, pz, square[i], waiting, leaf)):
            for j in range(node_start(leaf[place], levels, n), node_start(leaf[place] + 1, levels, n)):
                dx, dy, dz = points[j, 0] - px, points[j, 1] - py, points[j, 2] - pz
                d = dx * dx + dy * dy + dz * dz
                if d > square[i]:
                    continue
                within += 1
                g = weight_of(weighting, d, per_square[i])
                w += g
                w2 += g * g
                x, y, z = x + g * dx, y + g * dy, z + g * dz
                xx, xy, xz = xx + g * dx * dx, xy + g * dx * dy, xz + g * dx * dz
                yy, yz, zz = yy + g * dy * dy, yz + g * dy * dz, zz + g * dz * dz
        count[i] = within
        axes[i], moments[i], effective[i] = plane_of_sums(w, w2, x, y, z, xx, xy, xz, yy, yz, zz)
