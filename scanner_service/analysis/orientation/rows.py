"""Single passes over places, links and rows of a cloud that is being oriented; each holds no more than it returns."""

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.graphs.kd_tree import Int32Array
from scanner_service.analysis.graphs.spanning import Float32Array
from scanner_service.analysis.orientation.links import Int8Array, LinkKind

Int64Array = npt.NDArray[np.int64]

_CREASE = np.uint8(LinkKind.CREASE)


def unit_rows(normals: Float64Array, row: Int32Array) -> Float32Array:
    """The normals (n, 3) of the rows (m,) at length 1; float32 is enough to tell a side."""
    unit = np.empty((len(row), 3), dtype=np.float32)
    _unit(normals, row, unit)
    return unit


@njit(cache=True, nogil=True)
def _length(x: float, y: float, z: float) -> tuple[float, float]:
    """What to divide by: first the largest part, so that no square overflows, then the length of the rest."""
    largest = max(abs(x), abs(y), abs(z))
    x, y, z = x / largest, y / largest, z / largest
    return largest, math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True)
def _unit(normals: Float64Array, row: Int32Array, unit: Float32Array) -> None:
    for i in range(len(row)):
        x, y, z = normals[row[i]]
        largest, length = _length(x, y, z)
        unit[i, 0], unit[i, 1], unit[i, 2] = x / largest / length, y / largest / length, z / largest / length


def turn_rows(normals: Float64Array, sign: Int8Array) -> Float64Array:
    """Unit normals (n, 3), turned by `sign` (n,), 1 or -1; NaN where it is 0."""
    turned = np.empty(normals.shape)
    _turn(normals, sign, turned)
    return turned


@njit(cache=True, nogil=True)
def _turn(normals: Float64Array, sign: Int8Array, turned: Float64Array) -> None:
    for i in range(len(sign)):
        if sign[i] == 0:
            turned[i] = np.nan
            continue
        x, y, z = normals[i]
        largest, length = _length(x, y, z)
        per = sign[i] / length
        turned[i, 0], turned[i, 1], turned[i, 2] = x / largest * per, y / largest * per, z / largest * per


def first_places(
    group: Int32Array, patch: Int32Array, z_mm: Float64Array, row: Int32Array
) -> tuple[Int32Array, Int32Array]:
    """The largest patch of each group, and the start in it: its point of the largest z, of equal ones the earliest row.

    `group` and `patch` (n,) bear the number of their first place. Both answers (n,) are told at the group's number and
    are -1 elsewhere. Of patches that are equally large the one with the smaller number counts.
    """
    largest = np.full(len(group), -1, dtype=np.int32)
    start = np.full(len(group), -1, dtype=np.int32)
    _first(group, patch, z_mm, row, largest, start)
    return largest, start


@njit(cache=True, nogil=True)
def _first(
    group: Int32Array, patch: Int32Array, z_mm: Float64Array, row: Int32Array, largest: Int32Array, start: Int32Array
) -> None:
    n = len(group)
    held = np.zeros(n, dtype=np.int32)
    for i in range(n):
        held[patch[i]] += 1
    for i in range(n):
        of = group[i]
        if held[i] > 0 and (largest[of] < 0 or held[i] > held[largest[of]]):
            largest[of] = i
    for i in range(n):
        of = group[i]
        if patch[i] != largest[of]:
            continue
        best = start[of]
        if best < 0 or z_mm[i] > z_mm[best] or (z_mm[i] == z_mm[best] and row[i] < row[best]):
            start[of] = i


def weigh_links(
    links: Int32Array,
    kind: npt.NDArray[np.uint8],
    sign: Int8Array,
    side: Int8Array,
    component: Int32Array,
    count: int,
    sure: BoolArray,
) -> tuple[Int64Array, Int64Array]:
    """What the links say of the sides (n,) found: per component (`count`,) those along the surface, and those of them
    whose ends lie on different sides.

    Taken out of `sure` (n,) are the ends of links that differ, and points of which too few links tell anything: those
    over the surface count two, creases one, and together they must reach the number of all links of the point.
    """
    told, differing = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    support = np.zeros(len(side), dtype=np.int32)
    _weigh(links, kind, sign, side, component, told, differing, support, sure)
    sure &= support >= 0
    return told, differing


@njit(cache=True, nogil=True)
def _weigh(
    links: Int32Array,
    kind: npt.NDArray[np.uint8],
    sign: Int8Array,
    side: Int8Array,
    component: Int32Array,
    told: Int64Array,
    differing: Int64Array,
    support: Int32Array,
    sure: BoolArray,
) -> None:
    for at in range(len(links)):
        i, j = links[at, 0], links[at, 1]
        weight = -1
        if kind[at] <= _CREASE:
            told[component[i]] += 1
            if side[i] * side[j] == sign[at]:
                weight = 1 - np.int32(kind[at])
            else:
                differing[component[i]] += 1
                sure[i] = sure[j] = False
        support[i] += weight
        support[j] += weight
