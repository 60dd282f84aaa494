"""Surface that no ray reached, as ribbons stretched between the ends of jumps; knows rungs only, judges nothing.

The upper ends of the rungs of a chain form a rim, the lower ends the foot of the shadow. Between neighbouring rungs
lies a quadrangle; the ribbon is all of them, its area theirs in space, its outline rim and foot. What
the hidden surface does in between (down the wall, then along the floor) nobody saw: the ribbon is straight.

A rim that runs askew is met by rungs along the lines and by rungs across them. They show one surface, which is not to
be counted twice: the chain with the larger area stands for it, and rungs beside it are covered by it. Where a rim
curves from one direction into the other, the chains that stand for its parts are joined end to end.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.gaps import GapKind, Gaps
from scanner_service.rescan.requirement import Requirement
from scanner_service.rescan.rungs import Rungs, beside, chains_of, rungs_of
from scanner_service.rescan.stations import IntArray
from scanner_service.rescan.strips import Strips

_WINDOW = 6  # rungs on either side that tell which way a rim runs
_SMOOTHED = 3  # quadrangles on either side over which an area vector is smoothed
_COVERED = 3.0  # rungs within this many lane widths of a ribbon's rim show the same surface
_SAME_SIDE = 0.05  # cosine between a wall's normal and the way its other rungs go down
_ALONG = (0.25, 0.5, 0.75)  # of a rung: where it is asked whether it lies on a ribbon
_BULGE = 0.25  # of a rung's length: so far apart ribbons of two passes over one hidden surface may lie
_BESIDE = 2.0  # ... and, along the rim, so many lanes
_SAME_OPEN = 0.6  # cosine: ... and they are open to one side
_JOINED = 3.0  # ends of chains within this many lane widths belong together


@dataclass(frozen=True, slots=True)
class Ribbon:
    """One hidden surface: rows `gaps` (k,) of the gaps that show it, closed loops of (k, 3) points around it.

    `normals` (m, 3) are those of the wall, perpendicular to rim and ray, towards its lower side, one a rung;
    `overhang_mm` is how far from the rays through the rim the foot lies (median). `centroid_mm` (3,) is the middle by
    area.
    """

    gaps: IntArray
    loops: tuple[Float64Array, ...]
    area_mm2: float
    centroid_mm: Float64Array
    normals: Float64Array
    overhang_mm: float


def shadow_ribbons(snapshot: MapSnapshot, requirement: Requirement, strips: Strips, gaps: Gaps) -> list[Ribbon]:
    """The ribbons of all shadow gaps; walls that turn by more than the region angle are ribbons of their own."""
    rungs = rungs_of(snapshot, strips, gaps, gaps.of_kind(GapKind.SHADOW).astype(np.int64))
    if not len(rungs):
        return []
    chains = [part for chain in chains_of(rungs) for part in _cut_at_corners(rungs, chain, requirement)]
    pieces, stands_for = _greedy_cover(rungs, chains)
    strands = _join_ends(rungs, pieces, requirement)
    number = np.full(len(rungs), -1, dtype=np.int64)
    for at, (strand, _) in enumerate(strands):
        number[strand] = at
    of_rung = number[stands_for]
    rows_by_strand = np.argsort(of_rung[rungs.of_gap], kind="stable")
    borders = np.searchsorted(of_rung[rungs.of_gap][rows_by_strand], np.arange(len(strands) + 1))
    return [
        _ribbon(rungs, strand, closed, rungs.gaps[rows_by_strand[borders[at] : borders[at + 1]]])
        for at, (strand, closed) in enumerate(strands)
    ]


def _rim_normals(rungs: Rungs, chain: IntArray, before: int, after: int) -> Float64Array:
    """(k, 3) unit normals of the wall, from the rim `before` rungs back to `after` rungs on.

    Where there is no rim (a rung of its own) the way to the lower end stands for it.
    """
    at = np.arange(len(chain))
    start = rungs.top_mm[chain[np.maximum(at - before, 0)]]
    end = rungs.top_mm[chain[np.minimum(at + after, len(chain) - 1)]]
    normal = np.cross(end - start, rungs.ray[chain])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    sign = np.sign(np.einsum("ij,ij->i", normal, rungs.bottom_mm[chain] - rungs.top_mm[chain]))
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = normal / length * np.where(sign == 0, 1.0, sign)[:, None]
    return np.where(length > 0, normal, rungs.aside[chain])


def _cut_at_corners(rungs: Rungs, chain: IntArray, requirement: Requirement) -> list[IntArray]:
    """The chain cut where its rim turns by more than the region angle, in a corner and not along an arc.

    A corner turns as much within half a window as within a whole one, an arc half as much.
    """
    if len(chain) < _WINDOW:
        return [chain]
    angle = np.radians(requirement.region_angle_deg)
    turn, close = (
        np.einsum("ij,ij->i", _rim_normals(rungs, chain, window, 0), _rim_normals(rungs, chain, 0, window))
        for window in (_WINDOW, _WINDOW // 2)
    )
    turn[:2], turn[-2:] = 1.0, 1.0
    turn[close > np.cos(0.75 * angle)] = 1.0
    cuts: list[int] = []
    for at in np.argsort(turn, kind="stable").tolist():
        if not turn[at] < np.cos(angle):
            break
        if all(abs(at - cut) > _WINDOW for cut in cuts):
            cuts.append(at)
    return np.split(chain, np.sort(np.array(cuts, dtype=np.int64)))


def _greedy_cover(rungs: Rungs, chains: list[IntArray]) -> tuple[list[IntArray], IntArray]:
    """Chains that show each surface once, largest first; and for each rung a rung of theirs that stands for it."""
    stands_for = np.full(len(rungs), -1, dtype=np.int64)
    facing = np.zeros((len(rungs), 3))
    tree = cKDTree(rungs.top_mm)
    pieces = []
    for chain in sorted(chains, key=lambda chain: -_area(rungs, chain)):
        free = stands_for[chain] < 0
        for piece in _runs(chain, free):
            stands_for[piece] = piece
            pieces.append(piece)
            reach = _COVERED * rungs.width_mm[piece] + rungs.grain_mm[piece]
            near = tree.query_ball_point(rungs.top_mm[piece], reach)
            first = np.repeat(piece, [len(rows) for rows in near])
            second = np.concatenate([np.array(rows, dtype=np.int64) for rows in near])
            open_ = stands_for[second] < 0
            first, second = first[open_], second[open_]
            facing[piece] = _rim_normals(rungs, piece, _WINDOW, _WINDOW)
            good = beside(rungs, first, second, np.full(len(first), np.inf))
            good &= ~(np.einsum("ij,ij->i", facing[first], rungs.aside[second]) < _SAME_SIDE)
            good &= ~_beyond_an_end(rungs, piece, second)
            stands_for[second[good]] = first[good]
            others, own = _over_the_same(rungs, piece, facing, np.flatnonzero(stands_for < 0))
            stands_for[others] = own
    return pieces, stands_for


def _over_the_same(rungs: Rungs, piece: IntArray, facing: Float64Array, others: IntArray) -> tuple[IntArray, IntArray]:
    """Rungs of other passes that for the most part lie where a piece does, and the rung of it that each lies on."""
    others = others[rungs.family[others] // 2 != rungs.family[piece[0]] // 2]
    if not len(others):
        return others, others
    length = rungs.length_mm
    low = np.minimum(rungs.top_mm[piece], rungs.bottom_mm[piece]).min(axis=0)
    high = np.maximum(rungs.top_mm[piece], rungs.bottom_mm[piece]).max(axis=0)
    wide = float(length[piece].max())
    middle = 0.5 * (rungs.top_mm[others] + rungs.bottom_mm[others])
    others = others[((middle >= low - wide) & (middle <= high + wide)).all(axis=1)]
    if not len(others):
        return others, others
    count = np.maximum(2, np.ceil(length[piece] / (rungs.width_mm[piece] + rungs.grain_mm[piece]))).astype(np.int64)
    of_place = np.repeat(piece, count)
    share = (np.arange(len(of_place)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / np.repeat(count, count)
    places = rungs.top_mm[of_place] + share[:, None] * (rungs.bottom_mm - rungs.top_mm)[of_place]
    tree = cKDTree(places)
    found = np.zeros(len(others), dtype=np.int64)
    own = np.zeros(len(others), dtype=np.int64)
    for at in _ALONG:
        asked = rungs.top_mm[others] + at * (rungs.bottom_mm - rungs.top_mm)[others]
        away, near = tree.query(asked)
        rung = of_place[near]
        lane = rungs.width_mm[rung] + rungs.grain_mm[rung]
        along = np.einsum("ij,ij->i", asked - places[near], np.cross(rungs.ray[rung], facing[rung]))
        on = (away <= lane + _BULGE * np.fmin(length[rung], length[others])) & (np.abs(along) <= _BESIDE * lane)
        on &= ~(np.einsum("ij,ij->i", rungs.open_side[rung], rungs.open_side[others]) < _SAME_OPEN)
        found += on
        own = np.where(on, rung, own)
    most = 2 * found > len(_ALONG)
    return others[most], own[most]


def _beyond_an_end(rungs: Rungs, piece: IntArray, others: IntArray) -> BoolArray:
    """Whether rungs near an end of a piece stand further on than half a lane: the rim goes on there without it."""
    beyond = np.zeros(len(others), dtype=bool)
    if len(piece) > 1:
        for end, inner in (
            (piece[0], piece[min(_WINDOW, len(piece) - 1)]),
            (piece[-1], piece[-min(_WINDOW, len(piece))]),
        ):
            onward = rungs.top_mm[end] - rungs.top_mm[inner]
            onward = onward / max(float(np.linalg.norm(onward)), 1e-12)
            away = rungs.top_mm[others] - rungs.top_mm[end]
            near = np.linalg.norm(away, axis=1) <= 2.0 * _COVERED * rungs.width_mm[end]
            beyond |= near & (away @ onward > 0.5 * rungs.width_mm[end])
    return beyond


def _runs(chain: IntArray, free: BoolArray) -> list[IntArray]:
    """Unbroken stretches of a chain where `free`."""
    parts = np.split(chain, np.flatnonzero(np.diff(free)) + 1)
    starts = np.cumsum([0, *[len(part) for part in parts[:-1]]])
    return [part for part, start in zip(parts, starts, strict=True) if free[start]]


def _join_ends(rungs: Rungs, pieces: list[IntArray], requirement: Requirement) -> list[tuple[IntArray, bool]]:
    """Chains joined where an end of one stands beside an end of another and faces the same way; and which are rings."""
    ends = np.array([[piece[0], piece[-1]] for piece in pieces], dtype=np.int64)
    flat = ends.reshape(-1)
    near = np.asarray(cKDTree(rungs.top_mm[flat]).query(rungs.top_mm[flat], k=min(8, len(flat)))[1], dtype=np.int64)
    near = near.reshape(len(flat), -1)
    first = np.repeat(np.arange(len(flat)), near.shape[1])
    second = near.reshape(-1)
    wide = np.fmax(rungs.width_mm + rungs.grain_mm, 0.0)
    within = _JOINED * np.fmax(wide[flat[first]], wide[flat[second]])
    good = (first < second) & ((first // 2 != second // 2) | _long(pieces, first))
    good &= beside(rungs, flat[first], flat[second], within)
    apart = np.linalg.norm(rungs.top_mm[flat[first]] - rungs.top_mm[flat[second]], axis=1)
    good &= apart <= within
    # a rim that curves turns by much between the middles of two windows, a corner turns in any
    cosine = np.full(len(first), -1.0)
    for window in (_WINDOW, _WINDOW // 2):
        facing = np.zeros((len(rungs), 3))
        for piece in pieces:
            facing[piece] = _rim_normals(rungs, piece, window, window)
        cosine = np.fmax(cosine, np.einsum("ij,ij->i", facing[flat[first]], facing[flat[second]]))
    good &= cosine >= np.cos(np.radians(requirement.region_angle_deg))
    first, second, apart = first[good], second[good], apart[good]
    partner = np.full(len(flat), -1, dtype=np.int64)
    for at in np.lexsort((second, first, apart)).tolist():
        if partner[first[at]] < 0 and partner[second[at]] < 0:
            partner[first[at]], partner[second[at]] = second[at], first[at]
    return _strands(pieces, partner)


def _long(pieces: list[IntArray], end: IntArray) -> BoolArray:
    """Whether the piece of an end is long enough to close on itself."""
    lengths = np.array([len(piece) for piece in pieces])
    enough: BoolArray = lengths[end // 2] > 2 * _WINDOW
    return enough


def _strands(pieces: list[IntArray], partner: IntArray) -> list[tuple[IntArray, bool]]:
    """Pieces laid end to end along their partners; end 2k is the first rung of piece k, 2k + 1 its last."""
    used = np.zeros(len(pieces), dtype=bool)
    strands = []
    loose = [end for end in range(len(partner)) if partner[end] < 0]
    for start in [*loose, *range(0, len(partner), 2)]:
        if used[start // 2]:
            continue
        parts, end = [], start
        while True:
            piece = end // 2
            used[piece] = True
            parts.append(pieces[piece] if end % 2 == 0 else pieces[piece][::-1])
            end = int(partner[end ^ 1])
            if end < 0 or used[end // 2]:
                break
        strands.append((np.concatenate(parts), end == start))
    return strands


def _area(rungs: Rungs, chain: IntArray) -> float:
    """Area of the ribbon along a chain; a rung of its own stands for a strip of its lane's width."""
    return float(_quadrangles(rungs, chain)[0].sum())


def _quadrangles(rungs: Rungs, chain: IntArray) -> tuple[Float64Array, Float64Array]:
    """Areas (t,) and middles (t, 3) of the quadrangles between neighbouring rungs.

    Ends stand where a scanline happened to pass, so that a ribbon askew to the lines is corrugated, and larger than the
    surface it stands for. Corrugation cancels in the mean of the area vectors of a few neighbours.
    """
    a, b = rungs.top_mm[chain], rungs.bottom_mm[chain]
    if len(chain) == 1:
        return np.linalg.norm(b - a, axis=1) * rungs.width_mm[chain], 0.5 * (a + b)
    vector = 0.5 * np.cross(b[1:] - a[:-1], a[1:] - b[:-1])
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(vector, axis=0)])
    at = np.arange(len(vector))
    start, end = np.maximum(at - _SMOOTHED, 0), np.minimum(at + _SMOOTHED + 1, len(vector))
    areas = np.linalg.norm(total[end] - total[start], axis=1) / (end - start)
    return areas, 0.25 * (a[:-1] + a[1:] + b[:-1] + b[1:])


def _ribbon(rungs: Rungs, strand: IntArray, closed: bool, gaps: IntArray) -> Ribbon:
    """A strand of rungs as one surface."""
    around = np.append(strand, strand[0]) if closed else strand
    areas, middles = _quadrangles(rungs, around)
    total = float(areas.sum())
    top, bottom = rungs.top_mm[strand], rungs.bottom_mm[strand]
    if closed:
        loops: tuple[Float64Array, ...] = (top.copy(), bottom[::-1].copy())
    elif len(strand) == 1:
        aside = np.cross(rungs.ray[strand], bottom - top)
        aside *= 0.5 * rungs.width_mm[strand[0]] / max(float(np.linalg.norm(aside)), 1e-12)
        loops = (np.concatenate([top - aside, top + aside, bottom + aside, bottom - aside]),)
    else:
        loops = (np.concatenate([top, bottom[::-1]]),)
    middle = (areas[:, None] * middles).sum(axis=0) / total if total > 0 else middles.mean(axis=0)
    overhang = np.linalg.norm(np.cross(bottom - top, rungs.ray[strand]), axis=1)
    normals = _rim_normals(rungs, strand, _WINDOW, _WINDOW)
    return Ribbon(gaps, loops, total, middle, normals, float(np.median(overhang)))
