"""Jumps in depth as rungs of a ladder: which jump stands beside which; knows gaps only, judges nothing.

A *rung* is the straight line from the upper to the lower end of a jump; jumps that hang below each other, with a
return between them that has no neighbour in the lanes beside, are one rung. A *lane* is what the rung was found in: a
scanline for jumps along the line, a ray of the fan for jumps across the lines. Rungs of neighbouring lanes that stand
beside each other follow one another in a *chain*. Lanes of one family never meet, so the rungs of a chain do not cross.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.gaps import GapKind, Gaps, gap_lengths_mm
from scanner_service.rescan.stations import IntArray
from scanner_service.rescan.strips import Strips, in_a_row

_NEAREST = 9
_FEW = 12  # chains of fewer rungs are of the kind of a larger one beside them
_LANES = 3  # a chain may miss two lanes (dropouts)
_SLANT = 2.0  # ends this many lane widths apart still follow each other: a rim at 30° to its lanes
_ALIKE = 0.5  # the shorter of two rungs beside each other has at least this share of the longer
_SLIP = 1.0 / 3.0  # ... and the ends that are further apart are so by at most this share of it
_SHORT = 6.0  # radii: longer gaps are never of the surface that leads into them
_SAME_WAY = np.cos(np.radians(45.0))


@dataclass(frozen=True, slots=True)
class Rungs:
    """The rungs of a map, one row each.

    `top`, `bottom` (m,) are rows of the snapshot, `top_mm`, `bottom_mm` (m, 3) where they are. `lane` (m,) counts
    within `family` (m,), which is one number for each pass and direction. `width_mm` (m,) is the distance between
    lanes, `grain_mm` (m,) that of the points within a lane. `ray` (m, 3) is the unit laser ray at the top, `aside`
    (m, 3) the unit direction from that ray to the lower end, `open_side` (m, 3) that to where the part ends, NaN where
    it is not known. `of_gap` (g,) is the rung of each of the gaps asked for, `gaps` (g,) their rows.
    """

    top: IntArray
    bottom: IntArray
    top_mm: Float64Array
    bottom_mm: Float64Array
    lane: IntArray
    family: IntArray
    width_mm: Float64Array
    grain_mm: Float64Array
    ray: Float64Array
    aside: Float64Array
    open_side: Float64Array
    of_gap: IntArray
    gaps: IntArray

    def __len__(self) -> int:
        return len(self.top)

    @property
    def length_mm(self) -> Float64Array:
        """(m,) from top to bottom."""
        length: Float64Array = np.linalg.norm(self.bottom_mm - self.top_mm, axis=1)
        return length


def rungs_of(snapshot: MapSnapshot, strips: Strips, gaps: Gaps, rows: IntArray) -> Rungs:
    """The rungs that the gaps `rows` form."""
    high, low = gaps.high[rows], gaps.low[rows]
    if not len(rows):
        nowhere = np.zeros((0, 3))
        return Rungs(
            rows, rows, nowhere, nowhere, rows, rows, np.zeros(0), np.zeros(0), nowhere, nowhere, nowhere, rows, rows
        )
    family = 2 * gaps.group[rows] + gaps.across[rows]
    # a gap whose upper end is the lower end of another in the same lane hangs below it
    lanes = gaps.lane[rows] - gaps.lane[rows].min()
    lane = np.unique(family * (int(lanes.max()) + 1) + lanes, return_inverse=True)[1].reshape(-1).astype(np.int64)
    base = len(snapshot) + 1
    by_top = np.argsort(lane * base + high, kind="stable")
    tops = (lane * base + high)[by_top]
    at = np.minimum(np.searchsorted(tops, lane * base + low), len(rows) - 1)
    hangs = np.flatnonzero((tops[at] == lane * base + low) & ~in_a_row(snapshot, strips, low, gaps.across[rows]))
    graph = coo_matrix((np.ones(len(hangs)), (hangs, by_top[at[hangs]])), shape=(len(rows), len(rows)))
    of_gap = np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
    count = int(of_gap.max(initial=-1)) + 1
    above, below = (
        np.linalg.norm(snapshot.points_mm[ends] - snapshot.lines.laser_mm[gaps.line[rows]], axis=1)
        for ends in (high, low)
    )
    nearest_first = np.argsort(above, kind="stable")
    farthest_first = np.argsort(-below, kind="stable")
    top_gap, bottom_gap = np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
    top_gap[of_gap[nearest_first[::-1]]] = nearest_first[::-1]  # the last one written stays
    bottom_gap[of_gap[farthest_first[::-1]]] = farthest_first[::-1]
    top, bottom = high[top_gap], low[bottom_gap]
    across = gaps.across[rows][top_gap]
    width = gaps.width_mm[rows][top_gap]
    ray = snapshot.points_mm[top] - snapshot.lines.laser_mm[gaps.line[rows][top_gap]]
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-12)
    aside = snapshot.points_mm[bottom] - snapshot.points_mm[top]
    aside -= ray * np.einsum("ij,ij->i", aside, ray)[:, None]
    return Rungs(
        top=top,
        bottom=bottom,
        top_mm=snapshot.points_mm[top],
        bottom_mm=snapshot.points_mm[bottom],
        lane=gaps.lane[rows][top_gap],
        family=family[top_gap],
        width_mm=np.where(np.isfinite(width), width, strips.line_spacing_mm[top]),
        grain_mm=np.where(across, strips.line_spacing_mm[top], strips.nominal_point_spacing_mm[top]),
        ray=ray,
        aside=aside / np.maximum(np.linalg.norm(aside, axis=1, keepdims=True), 1e-12),
        open_side=gaps.open_side[rows][top_gap],
        of_gap=of_gap,
        gaps=rows,
    )


def beside(rungs: Rungs, first: IntArray, second: IntArray, within_mm: Float64Array) -> BoolArray:
    """Whether rungs stand beside each other: one pair of ends within reach, the same way down, of like length."""
    top = np.linalg.norm(rungs.top_mm[first] - rungs.top_mm[second], axis=1)
    bottom = np.linalg.norm(rungs.bottom_mm[first] - rungs.bottom_mm[second], axis=1)
    length = rungs.length_mm
    one, other = rungs.bottom_mm[first] - rungs.top_mm[first], rungs.bottom_mm[second] - rungs.top_mm[second]
    short, long = np.fmin(length[first], length[second]), np.fmax(length[first], length[second])
    near: BoolArray = (np.fmin(top, bottom) <= within_mm) & (short >= _ALIKE * long)
    near &= np.fmax(top, bottom) <= np.fmax(within_mm, _SLIP * long)
    near &= np.einsum("ij,ij->i", one, other) >= _SAME_WAY * length[first] * length[second]
    return near


def chains_of(rungs: Rungs) -> list[IntArray]:
    """Rungs (rows) that follow one another lane by lane; every rung is in one chain, most in one of their own kind."""
    if len(rungs) == 0:
        return []
    reach = _SLANT * rungs.width_mm + rungs.grain_mm
    pair = _nearest_pairs(rungs)
    step = rungs.lane[pair[:, 1]] - rungs.lane[pair[:, 0]]
    pair = np.where((step < 0)[:, None], pair[:, ::-1], pair)
    step = np.abs(step)
    first, second = pair[:, 0], pair[:, 1]
    good = (step >= 1) & (step <= _LANES)
    good &= np.einsum("ij,ij->i", rungs.aside[first], rungs.aside[second]) > 0  # not the two sides of a rib
    good[good] = beside(rungs, first[good], second[good], step[good] * np.fmax(reach[first[good]], reach[second[good]]))
    first, second, step = first[good], second[good], step[good]
    apart = np.linalg.norm(rungs.top_mm[first] - rungs.top_mm[second], axis=1)
    apart += np.linalg.norm(rungs.bottom_mm[first] - rungs.bottom_mm[second], axis=1)
    after, before = np.full(len(rungs), -1, dtype=np.int64), np.full(len(rungs), -1, dtype=np.int64)
    for at in np.lexsort((second, first, apart, step)).tolist():
        if after[first[at]] < 0 and before[second[at]] < 0:
            after[first[at]], before[second[at]] = second[at], first[at]
    return walks(after, before)


def _nearest_pairs(rungs: Rungs) -> IntArray:
    """(p, 2) rungs of one family whose upper or lower ends are among each other's nearest."""
    pairs = [np.zeros((0, 2), dtype=np.int64)]
    for family in np.unique(rungs.family):
        mine = np.flatnonzero(rungs.family == family)
        for ends in (rungs.top_mm[mine], rungs.bottom_mm[mine]):
            near = np.asarray(cKDTree(ends).query(ends, k=min(_NEAREST, len(mine)))[1], dtype=np.int64)
            near = near.reshape(len(mine), -1)
            pairs.append(np.column_stack([np.repeat(mine, near.shape[1]), mine[near.reshape(-1)]]))
    both = np.concatenate(pairs)
    both = np.sort(both[both[:, 0] != both[:, 1]], axis=1)
    once = np.unique(both[:, 0] * len(rungs) + both[:, 1])  # unique rows would keep other threads from their turn
    return np.column_stack(np.divmod(once, len(rungs)))


def walks(after: IntArray, before: IntArray) -> list[IntArray]:
    """Rows in the order of their links; a row that none comes before starts a walk."""
    following = after.tolist()
    found = []
    for start in np.flatnonzero(before < 0).tolist():
        walk, here = [start], following[start]
        while here >= 0:
            walk.append(here)
            here = following[here]
        found.append(np.array(walk, dtype=np.int64))
    return found


def settled_kinds(snapshot: MapSnapshot, strips: Strips, gaps: Gaps) -> Gaps:
    """The gaps with one kind for each wall: a wall that most lanes see returns on is a flank, else a shadow.

    A wall under a grazing ray gives few returns, here three and there none; it is one wall for all that.
    """
    rows = np.flatnonzero((gaps.kind == GapKind.SHADOW) | (gaps.kind == GapKind.FLANK)).astype(np.int64)
    rungs = rungs_of(snapshot, strips, gaps, rows)
    length = gap_lengths_mm(snapshot, gaps, rows)
    of_flank = np.bincount(rungs.of_gap, weights=length * (gaps.kind[rows] == GapKind.FLANK), minlength=len(rungs))
    flank = 4.0 * of_flank >= np.bincount(rungs.of_gap, weights=length, minlength=len(rungs))
    chains = chains_of(rungs)
    for chain in chains:
        flank[chain] = 2 * flank[chain].sum() > len(chain)
    few = [chain for chain in chains if len(chain) < _FEW]
    many = [chain for chain in chains if len(chain) >= _FEW]
    if few and many:
        # a few lanes at the end of a wall, cut off from it since their rungs are much shorter or longer
        short, long = np.concatenate(few), np.concatenate(many)
        distance, near = (np.asarray(part) for part in cKDTree(rungs.top_mm[long]).query(rungs.top_mm[short]))
        other = long[near]
        joined = (rungs.family[short] == rungs.family[other]) & (distance <= _LANES * rungs.width_mm[short])
        joined &= np.einsum("ij,ij->i", rungs.aside[short], rungs.aside[other]) > 0
        flank[short[joined]] = flank[other[joined]]
    # what leaves a rim along the plane of one of its ends is surface that gave no return, not yet what the rim hides
    near = (gaps.kind[rows] == GapKind.FLANK) & _leads_on(snapshot, strips, gaps, rows, length)
    kind = gaps.kind.copy()
    kind[rows] = np.where(flank[rungs.of_gap] | near, GapKind.FLANK, GapKind.SHADOW)
    return replace(gaps, kind=kind)


def _leads_on(snapshot: MapSnapshot, strips: Strips, gaps: Gaps, rows: IntArray, length_mm: Float64Array) -> BoolArray:
    """(k,) True for short gaps one of whose ends has a plane that leads to the other end."""
    high, low = gaps.high[rows], gaps.low[rows]
    vector = snapshot.points_mm[low] - snapshot.points_mm[high]
    off = np.fmin(
        np.abs(np.einsum("ij,ij->i", vector, snapshot.normals[high])),
        np.abs(np.einsum("ij,ij->i", vector, snapshot.normals[low])),
    )
    reach = np.maximum(strips.reach_mm[high], strips.reach_mm[low])
    leads: BoolArray = (off <= np.maximum(0.5 * reach, 0.2 * length_mm)) & (length_mm <= _SHORT * reach)
    return leads
