"""The live map's memory: one record of 64 bytes a point, what came in and what its neighbourhood said last."""

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from scanner_service.analysis.snapshot import Int32Array, Unreliable

POINT = np.dtype(
    [
        ("x", np.int32),  # stored coordinates in quanta from the origin
        ("y", np.int32),
        ("z", np.int32),
        ("other_side", np.int32),  # neighbours whose own ray comes from the other side of the plane
        ("radius_mm", np.float64),  # what the rule gave, before growing
        ("line", np.int32),  # row of its scanline
        ("neighbours", np.int32),  # Np, the point itself counted; 0: not counted
        ("nx", np.float32),  # unit normal towards the laser; NaN: unreliable
        ("ny", np.float32),
        ("nz", np.float32),
        ("middle_mm2", np.float32),  # lambda2 of the neighbourhood's moments
        ("smallest_mm2", np.float32),  # lambda3
        ("offset_sq", np.float32),  # (|centroid - p| / r)^2
        ("changed_at", np.int32),  # version at which the answer changed last
        ("rule", np.uint8),  # RadiusRule
        ("growth", np.uint8),  # how many steps the radius has grown
        ("unreliable", np.uint8),  # Unreliable
        ("open_passes", np.uint8),  # a bit for every open pass that reaches the point
    ]
)
assert POINT.itemsize == 64  # one cache line

PointArray = npt.NDArray[Any]

MAX_OPEN_PASSES = 7
_CACHE_LINE = 64

GROWTH = 1.25
"""A radius grows by this factor a step."""

GROWTH_REACH = 4.0
"""A radius grows to at most this many times what the rule gave; a block of cells is as wide as that."""


def reserve_points(max_points: int) -> PointArray:
    """Room for `max_points` points, each in a cache line of its own; memory comes into being as it is touched."""
    room = np.empty((max_points + 1) * _CACHE_LINE, dtype=np.uint8)
    skipped = -room.ctypes.data % _CACHE_LINE
    return room[skipped : skipped + max_points * _CACHE_LINE].view(POINT)


def used_radius_mm(points: PointArray, max_radius_mm: float) -> npt.NDArray[np.float64]:
    """(n,) radius that each point's answer was computed with, after growing; the kernel's own arithmetic."""
    base = np.ascontiguousarray(points["radius_mm"])
    limit = np.maximum(base, np.minimum(max_radius_mm, GROWTH_REACH * base))
    grown: npt.NDArray[np.float64] = np.minimum(base * GROWTH ** points["growth"].astype(np.float64), limit)
    return grown


@njit(cache=True)
def write_points(
    points: PointArray,
    first: int,
    xyz_q: Int32Array,
    line: int,
    radius_mm: npt.NDArray[np.float64],
    rule: int,
    unreliable: int,
    box_q: Int32Array,
) -> None:
    """Write what came in with a scanline, and what is said of a point before it was ever evaluated.

    `radius_mm` (k,) or (1,), one for all. The lowest and highest coordinates go to `box_q` (2, 3).
    """
    nothing = np.float32(np.nan)
    box_q[0] = 2**31 - 1
    box_q[1] = -(2**31)
    for i in range(len(xyz_q)):
        point = points[first + i]
        point.x, point.y, point.z = xyz_q[i, 0], xyz_q[i, 1], xyz_q[i, 2]
        point.other_side = 0
        point.line = line
        point.radius_mm = radius_mm[i] if len(radius_mm) > 1 else radius_mm[0]
        point.neighbours = 0
        point.nx, point.ny, point.nz = nothing, nothing, nothing
        point.middle_mm2, point.smallest_mm2, point.offset_sq = nothing, nothing, nothing
        point.changed_at = 0
        point.rule, point.growth, point.unreliable, point.open_passes = rule, 0, unreliable, 0
        for axis in range(3):
            box_q[0, axis] = min(box_q[0, axis], xyz_q[i, axis])
            box_q[1, axis] = max(box_q[1, axis], xyz_q[i, axis])


@njit(cache=True, nogil=True)
def gather_points(
    points: PointArray, place: Int32Array, rows: Int32Array, taken: PointArray, taken_place: Int32Array
) -> None:
    """Copy the rows (m,) of the table, and their places in their scanlines."""
    for i in range(len(rows)):
        taken[i] = points[rows[i]]
        taken_place[i] = place[rows[i]]


NOT_COUNTED = int(Unreliable.NOT_COUNTED)
