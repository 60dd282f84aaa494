"""Which shadow gaps belong to one hidden surface, its area and the side it faces; knows gaps only, judges nothing.

The upper ends of the gaps form a rim. The hidden surface hangs on it, perpendicular to the rim and to the laser ray,
open towards the lower ends. Gaps across and along the scanlines see the same wall, each as often as the rim crosses
their direction: a rim of length L and horizontal wall normal n is met by L·|n·t| / δx gaps across (travel t) and by
L·|n·e| / Δs gaps along the line (direction e). Weighted by |n·t| and |n·e|, with squares adding up to 1, the sum

    area = Σ across |AB|·δx·|n·t| + Σ along |AB|·Δs·|n·e|

is L·|AB| for a straight rim at any angle to the scanlines.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.gaps import GapKind, Gaps
from scanner_service.rescan.requirement import Requirement
from scanner_service.rescan.stations import IntArray
from scanner_service.rescan.strips import Strips

_RIM_POINTS = 16
_BENT = 0.3  # a rim whose second extent is above this share of the first turns a corner here


@dataclass(frozen=True, slots=True)
class ShadowGroup:
    """One hidden surface: rows `gaps` (k,) of the gaps around it, `normals` (k, 3) of the wall (NaN at corners)."""

    gaps: IntArray
    normals: Float64Array
    area_mm2: float


def shadow_groups(snapshot: MapSnapshot, requirement: Requirement, strips: Strips, gaps: Gaps) -> list[ShadowGroup]:
    """Group the shadow gaps whose rims are connected and whose walls face within the region angle of each other."""
    rows = gaps.of_kind(GapKind.SHADOW).astype(np.int64)
    if len(rows) < 2:
        return []
    high, low = snapshot.points_mm[gaps.high[rows]], snapshot.points_mm[gaps.low[rows]]
    ray = high - snapshot.lines.laser_mm[snapshot.line[gaps.high[rows]]]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    spacing = np.fmax(strips.line_spacing_mm[gaps.high[rows]], strips.reach_mm[gaps.high[rows]])
    tree = cKDTree(high)
    found = tree.query(high, k=min(_RIM_POINTS, len(rows)))
    distance, near = np.asarray(found[0]), np.asarray(found[1], dtype=np.int64)
    aside = (low - high) - ray * np.einsum("ij,ij->i", low - high, ray)[:, None]
    # the two rims of a thin rib are close, but their walls face away from each other
    same_side = np.einsum("ij,ikj->ik", aside, aside[near]) >= 0
    normal, straight = _wall_normals(high, low, ray, near, same_side & (distance <= 3.0 * spacing[:, None]))
    first = np.repeat(np.arange(len(rows)), near.shape[1])
    second = near.reshape(-1)
    cosine = np.einsum("ij,ij->i", normal[first], normal[second])
    bound = (distance.reshape(-1) <= 1.5 * np.maximum(spacing[first], spacing[second])) & straight[first]
    bound &= straight[second] & (cosine >= np.cos(np.radians(requirement.region_angle_deg)))
    above, below = _stacked(gaps, rows)
    pair = np.column_stack([np.concatenate([first[bound], above]), np.concatenate([second[bound], below])])
    graph = coo_matrix((np.ones(len(pair)), (pair[:, 0], pair[:, 1])), shape=(len(rows), len(rows)))
    label = np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
    label = _corners_join(label, high, straight, 3.0 * spacing)
    area = _area_elements(snapshot, gaps, strips, rows, high, low, normal)
    groups = []
    for number in np.unique(label):
        mine = label == number
        groups.append(ShadowGroup(rows[mine], normal[mine & straight], float(area[mine].sum())))
    return groups


def _wall_normals(
    high: Float64Array, low: Float64Array, ray: Float64Array, near: IntArray, close: BoolArray
) -> tuple[Float64Array, BoolArray]:
    """Unit normals of the wall, perpendicular to rim and ray, towards the lower side; and where the rim is straight."""
    weight = close[:, :, None].astype(np.float64)
    count = weight.sum(axis=1)
    centred = (high[near] - (high[near] * weight).sum(axis=1, keepdims=True) / count[:, None, :]) * weight
    value, vector = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    tangent = vector[:, :, 2]
    straight = (count[:, 0] >= 3) & (value[:, 1] <= _BENT**2 * value[:, 2])
    normal = np.cross(tangent, ray)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.maximum(length, 1e-12)
    sign = np.sign(np.einsum("ij,ij->i", normal, low - high))
    return normal * np.where(sign == 0, 1.0, sign)[:, None], straight & (length[:, 0] > 0.3)


def _stacked(gaps: Gaps, rows: IntArray) -> tuple[IntArray, IntArray]:
    """Gaps that hang below each other on one wall, a return on the wall between them: places in `rows`."""
    place = np.full(int(gaps.high.max()) + 1, -1, dtype=np.int64)
    place[gaps.high[rows]] = np.arange(len(rows))
    low = gaps.low[rows]
    inside = np.flatnonzero(low < len(place))
    below = place[low[inside]]
    return inside[below >= 0], below[below >= 0]


def _corners_join(label: IntArray, high: Float64Array, straight: BoolArray, within_mm: Float64Array) -> IntArray:
    """Gaps at a corner of the rim take the label of the nearest straight one; they never bridge two walls."""
    joined = label.copy()
    bent = np.flatnonzero(~straight)
    if len(bent) and straight.any():
        rows = np.flatnonzero(straight)
        distance, nearest = (np.asarray(part) for part in cKDTree(high[rows]).query(high[bent]))
        close = distance <= within_mm[bent]
        joined[bent[close]] = label[rows[nearest[close]]]
    return joined


def _area_elements(
    snapshot: MapSnapshot,
    gaps: Gaps,
    strips: Strips,
    rows: IntArray,
    high: Float64Array,
    low: Float64Array,
    normal: Float64Array,
) -> Float64Array:
    """What each gap adds to the area of the hidden surface (see the module's formula)."""
    line = snapshot.line[gaps.high[rows]]
    travel = snapshot.lines.travel[line]
    vector = low - high
    along = np.abs(np.einsum("ij,ij->i", normal, strips.along[strips.group[gaps.high[rows]]]))
    forward = np.abs(np.einsum("ij,ij->i", normal, travel))
    forward = np.where(np.isfinite(forward), forward, np.sqrt(np.maximum(1.0 - along**2, 0.0)))
    element: Float64Array = (
        np.linalg.norm(vector, axis=1) * gaps.width_mm[rows] * np.where(gaps.across[rows], forward, along)
    )
    return element
