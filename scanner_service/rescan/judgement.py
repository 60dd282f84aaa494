"""The verdict on each settled point: good enough or not, and why not; knows no regions, areas or passes.

Two witnesses speak about density. The *count* is Np / (π r²), corrected for the border of the part. The *spacing* is
the width of the strips to the adjacent scanlines and the distance of the points along the line. A strip that is too
wide fails unless points of another pass fill it; a low count fails unless the spacing shows that the surface merely
ends on several sides (a thin rib, a corner).
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array, SensorGeometry, read_only
from scanner_service.analysis.snapshot import LineTable, MapSnapshot, UInt8Array
from scanner_service.rescan.border import LEAST_OFFSET, border_aware
from scanner_service.rescan.curvature import curvature_across_per_mm
from scanner_service.rescan.frames import Frames
from scanner_service.rescan.gaps import Fan, Mark, near_range_end
from scanner_service.rescan.noise import noise_along_lines
from scanner_service.rescan.requirement import Requirement
from scanner_service.rescan.stations import IntArray, Stations
from scanner_service.rescan.strips import Strips

_LOST_GAP = 1.5  # station gaps above this many Δs with missing indices are lost lines
_SPARSE_GAP = 1.25  # ... without missing indices: moved too fast
_SLACK = 1.05  # a strip may be this much wider than the required density allows
_ALIKE = float(np.cos(np.radians(30.0)))  # of normals of one surface
_DOUBT = 1.25  # times the required density above which a point is good whatever is around it
_STEEP_RAY = 0.5  # cosine of the incidence beyond which points are too far apart along the line


class Reason(IntEnum):
    """Why a point is worth another pass; NONE where it is good, or not judged."""

    NONE = 0
    STEEP = 1
    SPARSE = 2
    SHADOW = 3
    OUT_OF_RANGE = 4
    LOST_LINES = 5
    NOISY = 6
    ISOLATED = 7
    UNTOUCHED = 8  # said of regions of a reference surface only, never of a point

    @property
    def label(self) -> str:
        """The reason as clients see it, lower case."""
        return self.name.lower()


REMEDIES = {
    Reason.NONE: "none",
    Reason.STEEP: "another direction",
    Reason.SPARSE: "the same pass, finer line spacing",
    Reason.SHADOW: "another side",
    Reason.OUT_OF_RANGE: "another standoff",
    Reason.LOST_LINES: "the same pass again",
    Reason.NOISY: "slower, other exposure or other direction",
    Reason.ISOLATED: "none: flagged",
    Reason.UNTOUCHED: "a pass that sees it",
}


@dataclass(frozen=True, slots=True)
class Judgement:
    """Verdicts, arrays of n rows like the snapshot.

    `judged` is True for settled points that count and whose requirement is known; all others have Reason.NONE.
    `required_per_mm2` and `judged_per_mm2` are the two sides of the comparison of counts, `spacing_per_mm2` the
    density that the spacing on the surface gives, 1 / (Δs'·δp) with the widest strip (NaN: unknown). `width_mm` (n, 2)
    are the strips' widths on the point's own surface (NaN: the surface ends or is unknown there), `failing_strip`
    (n, 2) the strips that fail. `grazing` is True where the ray is known to graze the surface. `noise_mm` is the noise
    along the line (NaN: unknown or not asked for). `allowed_mm` is the largest strip width that the requirement allows.
    """

    judged: BoolArray
    reason: UInt8Array
    required_per_mm2: Float64Array
    judged_per_mm2: Float64Array
    spacing_per_mm2: Float64Array
    width_mm: Float64Array
    failing_strip: BoolArray
    grazing: BoolArray
    noise_mm: Float64Array
    allowed_mm: Float64Array

    def __post_init__(self) -> None:
        for name in self.__slots__:
            read_only(getattr(self, name))

    @property
    def fails(self) -> BoolArray:
        """(n,) True where the point is worth another pass."""
        failing: BoolArray = self.reason != Reason.NONE
        return failing


def judge(
    snapshot: MapSnapshot,
    requirement: Requirement,
    stations: Stations,
    frames: Frames,
    strips: Strips,
    fan: Fan,
    marks: UInt8Array,
    geometry: SensorGeometry | None = None,
    noise_mm: float | None = None,
    at_most_per_mm2: float = np.inf,
) -> Judgement:
    """Judge every settled point.

    Parameters
    ----------
    snapshot, stations, frames, strips, fan : the map and what was measured on it.
    marks : (n,) what the gaps say of each point, as `marks_of` has it.
    at_most_per_mm2 : by default no more than this is required, as `asked_of_the_first_pass` has it.
    geometry : the scanner's optics; without it no point is `out_of_range`.
    noise_mm : one standard deviation of the sensor along its ray; None: no point is `noisy`.
    """
    line, n = snapshot.line, len(snapshot)
    required = requirement.per_mm2(strips.line_spacing_mm, strips.nominal_point_spacing_mm)
    if requirement.density_per_mm2 is None:
        required = np.minimum(required, at_most_per_mm2)
    counted_density = border_aware(snapshot.side_density_per_mm2, snapshot.offset)
    counted_density = np.where(snapshot.isolated, snapshot.side_density_per_mm2, counted_density)  # no disc to speak of
    judged = snapshot.settled & (snapshot.neighbours > 0) & np.isfinite(required)
    if requirement.interest is not None:
        judged &= requirement.interest.holds(snapshot.points_mm)

    wall, flank = (marks & (Mark.SHADOW_HIGH | Mark.SHADOW_LOW)) > 0, (marks & Mark.FLANK) > 0
    width = _width_on_surface(snapshot, stations, strips, wall & ~flank)
    allowed = 1.0 / (required * strips.nominal_point_spacing_mm)
    stride, gap, missing = stations.stride_mm[line], stations.gap_mm[line], stations.missing[line]
    delta = strips.line_spacing_mm[:, None]
    lost = (missing > 0) & ~(gap <= _LOST_GAP * delta)
    fast = ~lost & (gap > _SPARSE_GAP * delta)
    by_rule = _allowed_by_rule(snapshot, requirement, strips, noise_mm, judged)
    too_wide = width > _SLACK * allowed[:, None]
    beyond_rule = width > _SLACK * by_rule[:, None]
    # beyond this a neighbourhood no longer reaches the next line: Δs'/Δs > sqrt(2) + c/Δs
    beyond = (width * delta > strips.reach_mm[:, None] * stride) & (stride > 0) & ~(lost | fast)
    one_sided = ~(snapshot.offset < LEAST_OFFSET)
    enough = (snapshot.side_density_per_mm2 >= required) & ~one_sided
    failing = ((too_wide & ~enough[:, None]) | beyond | beyond_rule) & judged[:, None]
    allowed = np.fmin(allowed, by_rule)
    filled = np.zeros_like(failing)
    if frames.several:
        filled = _filled(snapshot, strips, failing, np.fmin(allowed, strips.reach_mm))
    failing &= ~filled
    width = np.where(filled, np.fmin(width, delta), width)  # what lies further out is the other pass's surface

    with np.errstate(invalid="ignore", divide="ignore"):
        both = np.isfinite(width).sum(axis=1)
        mean_width = np.where(both > 0, np.nansum(width, axis=1) / np.maximum(both, 1), np.nan)
        by_spacing = 1.0 / (mean_width * strips.point_spacing_mm)
        worst = 1.0 / (np.fmax(width[:, 0], width[:, 1]) * strips.point_spacing_mm)
    too_few = _too_few(snapshot, judged, counted_density, by_spacing, required, strips)

    ray = snapshot.points_mm - snapshot.lines.laser_mm[line]
    incidence = np.abs(np.einsum("ij,ij->i", ray, snapshot.normals)) / np.linalg.norm(ray, axis=1)
    reason = np.zeros(n, dtype=np.uint8)
    reason[too_few] = Reason.SPARSE
    reason[too_few & snapshot.isolated] = Reason.ISOLATED
    grazing = incidence < _STEEP_RAY
    reason[too_few & (flank | grazing)] = Reason.STEEP
    coarse = delta > _SLACK * allowed[:, None]
    for mask, why in ((~coarse, Reason.STEEP), (coarse, Reason.SPARSE), (beyond, Reason.STEEP)):
        reason[(failing & mask).any(axis=1)] = why
    for mask, why in ((fast, Reason.SPARSE), (lost, Reason.LOST_LINES)):
        reason[(failing & mask).any(axis=1)] = why

    if requirement.incidence_rad is not None:
        turned = judged & (reason == Reason.NONE) & (incidence < np.cos(requirement.incidence_rad))
        reason[turned & ~_seen_better(snapshot, strips, turned, incidence >= np.cos(requirement.incidence_rad))] = (
            Reason.STEEP
        )
    noise = np.full(n, np.nan)
    limit = requirement.noise_limit_mm(noise_mm)
    if limit is not None:
        noise = noise_along_lines(snapshot, strips.order)
        noisy = judged & (reason == Reason.NONE) & (noise > limit) & (snapshot.residual_mm > limit)
        reason[noisy] = Reason.NOISY
    if geometry is not None:
        edge = ~np.isfinite(strips.width_mm).all(axis=1) | _line_ends(snapshot, strips)
        near = near_range_end(snapshot, strips, fan, geometry)
        reason[judged & edge & near] = Reason.OUT_OF_RANGE
    reason[(marks & Mark.OUT_OF_RANGE) > 0] = Reason.OUT_OF_RANGE
    reason[wall & ((reason == Reason.NONE) | (reason == Reason.ISOLATED))] = Reason.SHADOW
    # the few returns that a wall gives on its way down are part of it; a rib's top, never a lower end, is not
    below = ((marks & Mark.SHADOW_LOW) > 0) & (reason == Reason.SPARSE)
    reason[below & ~failing.any(axis=1)] = Reason.SHADOW
    reason[~judged] = Reason.NONE
    return Judgement(judged, reason, required, counted_density, worst, width, failing, grazing, noise, allowed)


def asked_of_the_first_pass(lines: LineTable, stations: Stations, frames: Frames, requirement: Requirement) -> float:
    """What the first pass was asked by default, per mm²; inf where there is no other.

    It bounds what is asked of later passes: a finer pass must be able to mend.
    """
    if not frames.several:
        return float("inf")
    number = int(stations.group[np.argmax(frames.in_force[stations.group])])
    first = np.flatnonzero(stations.group == number)[: frames.lines[number]]
    asked = requirement.per_mm2(lines.line_spacing_mm[first], stations.point_spacing_mm[first])
    known = asked[np.isfinite(asked)]
    return float(np.median(known)) if len(known) else float("inf")


def _allowed_by_rule(
    snapshot: MapSnapshot, requirement: Requirement, strips: Strips, noise_mm: float | None, judged: BoolArray
) -> Float64Array:
    """(n,) largest line spacing that line spacing and chord error allow, whatever the density; inf: any."""
    curvature = np.full(len(snapshot), np.nan)
    if requirement.chord_error_mm is not None:
        rows = np.flatnonzero(judged).astype(np.int64)
        curvature[rows] = curvature_across_per_mm(snapshot, rows, strips.reach_mm, noise_mm)
    return requirement.allowed_spacing_mm(curvature)


def _seen_better(snapshot: MapSnapshot, strips: Strips, rows: BoolArray, good: BoolArray) -> BoolArray:
    """(n,) True for the rows within whose radius another pass has a point that meets the incidence."""
    seen = np.zeros(len(snapshot), dtype=bool)
    good = good & (snapshot.neighbours > 0)
    for number in np.unique(strips.group[rows]):
        others = good & (strips.group != number)
        mine = np.flatnonzero(rows & (strips.group == number))
        if others.any():
            away = cKDTree(snapshot.points_mm[others]).query(snapshot.points_mm[mine])[0]
            seen[mine] = away <= strips.reach_mm[mine]
    return seen


def _width_on_surface(snapshot: MapSnapshot, stations: Stations, strips: Strips, wall: BoolArray) -> Float64Array:
    """(n, 2) strip widths as far as they belong to the point's own surface.

    A reliable normal tells the width by itself, Δs' = Δs·|t·m| / sqrt(1 - (n·m)²), free of noise; a measured width far
    beyond it is a jump to another surface, left to the gaps. Without a normal the measured distance stands, except
    at the ends of a wall.
    """
    lines, line = snapshot.lines, snapshot.line
    width = strips.width_mm.copy()
    m, t = lines.plane_normal[line], lines.travel[line]
    sine = np.sqrt(np.maximum(1.0 - np.einsum("ij,ij->i", snapshot.normals, m) ** 2, 1e-12))
    factor = np.abs(np.einsum("ij,ij->i", m, t)) / sine
    predicted = stations.stride_mm[line] * factor[:, None]
    known = np.isfinite(predicted) & np.isfinite(width)
    far = known & (width > np.maximum(1.5 * predicted, predicted + strips.reach_mm[:, None]))
    width = np.where(known, np.fmin(predicted, width * 1.02), width)
    width[far] = np.nan
    width[wall[:, None] & ~known & (width > strips.reach_mm[:, None])] = np.nan
    return width


def _filled(snapshot: MapSnapshot, strips: Strips, failing: BoolArray, allowed_mm: Float64Array) -> BoolArray:
    """(n, 2) True where points of other passes lie all along a failing strip, at most half the allowed width away."""
    filled = np.zeros_like(failing)
    rows, side = np.nonzero(failing & (strips.link >= 0))
    if not len(rows):
        return filled
    tree = cKDTree(snapshot.points_mm[snapshot.neighbours > 0])
    start, end = snapshot.points_mm[rows], snapshot.points_mm[strips.link[rows, side]]
    enough = np.ones(len(rows), dtype=bool)
    for share in (0.25, 0.5, 0.75):
        nearest = tree.query(start + share * (end - start))[0]
        enough &= nearest <= 0.5 * _SLACK * allowed_mm[rows]
    filled[rows, side] = enough
    return filled


def _too_few(
    snapshot: MapSnapshot,
    judged: BoolArray,
    counted_per_mm2: Float64Array,
    by_spacing_per_mm2: Float64Array,
    required: Float64Array,
    strips: Strips,
) -> BoolArray:
    """(n,) True where count and spacing are both too low, in the mean of the points around: one alone errs by chance.

    Around a point are the two before and the two after it in its own line, and in the lines beside the nearest and
    those next to it, as far as their normals are like its own: beyond an edge lies another surface. Points far better
    than required need no look at their neighbours.
    """
    doubtful = judged & (counted_per_mm2 < _DOUBT * required) & ~(by_spacing_per_mm2 >= _DOUBT * required)
    rows = np.flatnonzero(doubtful)
    around = [rows[:, None], strips.chain[rows]]
    around += [_next_to(strips, strips.chain[rows, side])[:, side, None] for side in (0, 1)]
    for side in (0, 1):
        beside = strips.link[rows, side]
        around += [beside[:, None], _next_to(strips, beside)]
    near = np.concatenate(around, axis=1)
    known = (near >= 0) & judged[near]
    known &= ~(np.einsum("kqj,kj->kq", snapshot.normals[near], snapshot.normals[rows]) < _ALIKE)
    known[:, 0] = True
    counted = np.where(known, counted_per_mm2[near], 0.0).sum(axis=1) / known.sum(axis=1)
    known &= np.isfinite(by_spacing_per_mm2[near])
    with np.errstate(invalid="ignore", divide="ignore"):
        area_mm2 = np.where(known, 1.0 / by_spacing_per_mm2[near], 0.0).sum(axis=1) / known.sum(axis=1)
        low = ~(1.0 / area_mm2 >= required[rows] / _SLACK) | np.isnan(by_spacing_per_mm2[rows])
    few = np.zeros_like(judged)
    few[rows] = (counted < required[rows]) & low
    return few


def _next_to(strips: Strips, rows: IntArray) -> IntArray:
    """(k, 2) points before and after some points in their lines; -1 where there is none, or the point is -1 itself."""
    return np.where((rows >= 0)[:, None], strips.chain[rows], -1)


def _line_ends(snapshot: MapSnapshot, strips: Strips) -> BoolArray:
    """(n,) True for the first and the last return of each scanline."""
    ends = np.zeros(len(snapshot), dtype=bool)
    border = np.flatnonzero(np.diff(snapshot.line[strips.order]))
    ends[strips.order[border]] = True
    ends[strips.order[border + 1]] = True
    ends[strips.order[[0, -1]] if len(strips.order) else []] = True
    return ends
