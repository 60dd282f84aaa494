"""What a link of the Riemannian graph says of the two normals at its ends, and how far it can be trusted.

Two rules tell whether normals n, m of points with the unit direction e between them lie on one side of the surface:

- *parallel* (Hoppe et al. 1992): n·m > 0. It fails where the surface folds by a right angle or more;
- *mirror*: n·m - 2 (e·n)(e·m) > 0: the first normal, mirrored at the plane half-way, against the second. On a circular
  arc it is exactly 1, however far the ends are apart, and across a sharp edge it still tells.

Where both agree the link runs along the surface. Where they differ it leaps from one sheet to another.
"""

import math
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from numba import njit

from drivers.scanline import Float64Array
from scanner_service.analysis.graphs.kd_tree import Int32Array, distance_sq
from scanner_service.analysis.graphs.slices import in_slices
from scanner_service.analysis.graphs.spanning import Float32Array

Int8Array = npt.NDArray[np.int8]

CLEAR = 0.5
"""A rule is clear when its product is at least cos 60 degrees, either way."""


MIRRORED = 0.9
"""On a doubtful link the mirror rule decides when its product is that large: two sheets that face each other."""


class LinkKind(IntEnum):
    """What a link is; the lower, the sooner orientation runs along it."""

    SURFACE = 0  # both rules are clear and agree
    CREASE = 1  # only the mirror rule is clear: a sharp edge
    DOUBTFUL = 2  # the rules contradict each other, or neither is clear
    GAP = 3  # far longer than the neighbourhood of one of its ends: it joins nothing


_SURFACE, _CREASE, _DOUBTFUL, _GAP = (np.uint8(kind) for kind in LinkKind)


def judge_links(
    xyz: Float64Array,
    normals: Float32Array,
    links: Int32Array,
    reach_sq: Float64Array,
    gap_factor: float,
    plain: bool,
    threads: int = 1,
) -> tuple[Float32Array, npt.NDArray[np.uint8], Int8Array]:
    """Weight, kind and sign of every link (m, 2) between points (n, 3) with unit normals (n, 3).

    A link longer than `gap_factor` times the smaller reach of its ends is a gap; `reach_sq` (n,) are squared. The sign
    is 1 where the normals lie on one side as they are, -1 where one must be flipped. Weights within a kind are
    1 - |n·m|, of creases 1 minus the mirror rule's product; kinds follow each other. With `plain` the weight is
    1 - |n·m| of all links and the sign that of n·m, as Hoppe has it; kinds are told all the same.
    """
    weight = np.empty(len(links), dtype=np.float32)
    kind = np.empty(len(links), dtype=np.uint8)
    sign = np.empty(len(links), dtype=np.int8)
    gap_sq = gap_factor * gap_factor

    def judge(start: int, stop: int) -> None:
        some = slice(start, stop)
        _judge(xyz, normals, links[some], reach_sq, gap_sq, plain, weight[some], kind[some], sign[some])

    in_slices(judge, len(links), threads)
    return weight, kind, sign


@njit(cache=True, nogil=True)
def _judge(
    xyz: Float64Array,
    normals: Float32Array,
    links: Int32Array,
    reach_sq: Float64Array,
    gap_sq: float,
    plain: bool,
    weight: Float32Array,
    kind: npt.NDArray[np.uint8],
    sign: Int8Array,
) -> None:
    for at in range(len(links)):
        i, j = links[at, 0], links[at, 1]
        length_sq = distance_sq(xyz, i, j)
        parallel = 0.0
        one = 0.0
        other = 0.0
        apart = 0.0
        opposed = 0.0
        for axis in range(3):
            a, b = float(normals[i, axis]), float(normals[j, axis])
            along = xyz[j, axis] - xyz[i, axis]
            parallel += a * b
            one += along * a
            other += along * b
            apart += (a - b) * (a - b)
            opposed += (a + b) * (a + b)
        mirror = parallel - 2.0 * one * other / length_sq
        cost = 0.5 * min(apart, opposed)  # 1 - |n·m| without cancellation
        if length_sq > gap_sq * min(reach_sq[i], reach_sq[j]):
            kind[at] = _GAP
        elif abs(parallel) >= CLEAR and abs(mirror) >= CLEAR and parallel * mirror > 0.0:
            kind[at] = _SURFACE
        elif abs(parallel) < CLEAR and abs(mirror) >= CLEAR:
            kind[at] = _CREASE
        else:
            kind[at] = _DOUBTFUL
        if plain:
            weight[at] = cost
            sign[at] = 1 if parallel > 0.0 else -1
        else:
            weight[at] = 2.0 * kind[at] + (math.fabs(1.0 - math.fabs(mirror)) if kind[at] == _CREASE else cost)
            rule = mirror if abs(mirror) >= MIRRORED or abs(parallel) < CLEAR else parallel
            sign[at] = 1 if rule > 0.0 else -1
