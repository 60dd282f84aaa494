"""What the oriented points of a component say of its outside: how open it is, and what it encloses; decides nothing."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.graphs.kd_tree import Int32Array
from scanner_service.analysis.graphs.spanning import Float32Array

CONTAINERS = 8
"""Only the largest components are asked whether others lie inside them."""

_SAMPLE = 4096


@dataclass(frozen=True, slots=True)
class Evidence:
    """Per component (C,): number of points, openness and fullness as in `ComponentTable`."""

    points: npt.NDArray[np.int64]
    openness: Float64Array
    fullness: Float64Array


def weigh_components(
    xyz: Float64Array, normals: Float32Array, area: Float64Array, component: Int32Array, count: int
) -> Evidence:
    """Sums over each component of points (n, 3) with oriented unit normals (n, 3), standing for `area` (n,) mm².

    Of a closed surface the sum of A n vanishes, and by the divergence theorem the sum of A n·p is three times the
    volume inside, positive when normals point outwards.
    """
    points = np.bincount(component, minlength=count)
    per_point = 1.0 / np.maximum(points, 1)
    total = np.maximum(np.bincount(component, area, count), np.finfo(np.float64).tiny)
    vector_sq = np.zeros(count)
    flux = np.zeros(count)
    spread_sq = np.zeros(count)
    for axis in range(3):
        middle = np.bincount(component, xyz[:, axis], count) * per_point
        offset = xyz[:, axis] - middle[component]
        part = area * normals[:, axis]
        vector_sq += np.bincount(component, part, count) ** 2
        spread_sq += np.bincount(component, offset * offset, count) * per_point
        part *= offset
        flux += np.bincount(component, part, count)
    scale = np.maximum(total * np.sqrt(spread_sq), np.finfo(np.float64).tiny)
    return Evidence(points, np.sqrt(vector_sq) / total, flux / scale)


def enclosed(
    xyz: Float64Array, normals: Float32Array, area: Float64Array, component: Int32Array, closed: BoolArray
) -> BoolArray:
    """Which components (C,) lie inside one of the largest `closed` ones, which are numbered by falling size.

    By the winding number of a sample of the container's points p around a point q of the other component: the sum of
    A n·(p - q) / |p - q|^3 is 4 pi inside and 0 outside. A component is only looked at where its box lies within the
    container's.
    """
    count = len(closed)
    inside = np.zeros(count, dtype=np.bool_)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    probe = np.zeros((count, 3))
    _measure(xyz, component, low, high, probe)
    for container in np.flatnonzero(closed)[:CONTAINERS]:
        within = ((low > low[container]) & (high < high[container])).all(axis=1)
        if not within.any():
            continue
        own = np.flatnonzero(component == container)
        stride = max(1, len(own) // _SAMPLE)
        own = own[::stride]
        winding = np.empty(int(within.sum()))
        _wind(xyz[own], normals[own], stride * area[own], probe[within], winding)
        inside[within] |= np.abs(winding) > 0.5
    return inside


@njit(cache=True, nogil=True)
def _measure(
    xyz: Float64Array, component: Int32Array, low: Float64Array, high: Float64Array, probe: Float64Array
) -> None:
    for i in range(len(xyz)):
        of = component[i]
        for axis in range(3):
            low[of, axis] = min(low[of, axis], xyz[i, axis])
            high[of, axis] = max(high[of, axis], xyz[i, axis])
            probe[of, axis] = xyz[i, axis]


@njit(cache=True, nogil=True)
def _wind(
    xyz: Float64Array, normals: Float32Array, area: Float64Array, probe: Float64Array, winding: Float64Array
) -> None:
    for at in range(len(probe)):
        total = 0.0
        for i in range(len(xyz)):
            flux, square = 0.0, 0.0
            for axis in range(3):
                offset = xyz[i, axis] - probe[at, axis]
                flux += offset * normals[i, axis]
                square += offset * offset
            if square > 0.0:
                total += area[i] * flux / (square * math.sqrt(square))
        winding[at] = total / (4.0 * math.pi)
