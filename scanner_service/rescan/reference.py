"""The nominal part that a scan is measured against: what of its surface was touched, is good, or was never seen.

The surface is cut into pieces of about one neighbourhood. A piece is *touched* when a counted point lies within reach
of its middle and does not look the other way, and *good* when such a point meets the requirement. Coverage is the share
of the pieces' area that is good; untouched pieces that hang together are regions `untouched`. Knows no file.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.snapshot import MapSnapshot
from scanner_service.rescan.judgement import REMEDIES, Reason
from scanner_service.rescan.outline import patch_of
from scanner_service.rescan.region import RescanRegion, mean_normal, priority_of
from scanner_service.rescan.regions import RegionReport
from scanner_service.rescan.requirement import Interest, Requirement
from scanner_service.rescan.stations import IntArray

_MOST_PIECES = 400_000
_LEAST_POINTS = 200  # of a scan before it can tell whether the mesh lies where the part lies
_SAMPLE = 4000
_SAME_WAY = 0.0  # cosine between normals below which a point lies on the other side of a wall
_BESIDE = 1.8  # pieces within this many piece sizes of each other hang together
_FAR_RADII = 10.0
_FAR_SHARE = 0.02  # ... or this share of the mesh's diagonal: what registration may be off by


class ReferenceUnusable(ValueError):
    """A mesh that no scan can be measured against; the message says why, and what to do.

    ReferenceUnusable
    +-- ReferenceOpen     not watertight
    +-- ReferenceApart    far from the scan
    +-- ReferenceUnits    of another length unit than it was said to be
    """


class ReferenceOpen(ReferenceUnusable):
    """Some edge does not have exactly two triangles, wound against each other."""


class ReferenceApart(ReferenceUnusable):
    """The scan does not lie on the mesh."""


class ReferenceUnits(ReferenceUnusable):
    """Mesh and scan differ in size by the factor between two length units."""


@dataclass(frozen=True, slots=True)
class ReferenceSurface:
    """A watertight mesh in the part frame: corners (t, 3, 3) mm, wound counter-clockwise seen from outside."""

    corners_mm: Float64Array

    def __post_init__(self) -> None:
        read_only(self.corners_mm)

    @classmethod
    def of(cls, corners_mm: Float64Array) -> "ReferenceSurface":
        """A mesh that was checked, turned inside in if it is inside out; triangles without area are left out.

        Raises
        ------
        ReferenceUnusable : nothing in it has an area.
        ReferenceOpen : it is not watertight.
        """
        area = 0.5 * np.linalg.norm(
            np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0]), axis=1
        )
        if not (area > 0).any():
            raise ReferenceUnusable("the reference mesh has no triangle with an area: is it a point cloud?")
        _check_closed(corners_mm)
        a, b, c = corners_mm[:, 0], corners_mm[:, 1], corners_mm[:, 2]
        middle = a.mean(axis=0)
        volume = float(np.einsum("ij,ij->", a - middle, np.cross(b - middle, c - middle)))
        solid = corners_mm[area > 0]
        return cls(np.ascontiguousarray(solid if volume >= 0 else solid[:, ::-1]))

    @property
    def area_mm2(self) -> float:
        """Area of the whole surface."""
        a, b, c = self.corners_mm[:, 0], self.corners_mm[:, 1], self.corners_mm[:, 2]
        return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    @property
    def diagonal_mm(self) -> float:
        """Diagonal of the box around it."""
        corners = self.corners_mm.reshape(-1, 3)
        return float(np.linalg.norm(corners.max(axis=0) - corners.min(axis=0)))

    def pieces(self, size_mm: float) -> "Pieces":
        """Cut the surface into pieces of about a size, or as fine as there is room for."""
        size = max(size_mm, sqrt(self.area_mm2 / _MOST_PIECES))
        middles, normals, areas = [], [], []
        a, b, c = self.corners_mm[:, 0], self.corners_mm[:, 1], self.corners_mm[:, 2]
        longest = np.max(
            [np.linalg.norm(b - a, axis=1), np.linalg.norm(c - b, axis=1), np.linalg.norm(a - c, axis=1)], axis=0
        )
        cross = np.cross(b - a, c - a)
        twice = np.linalg.norm(cross, axis=1)
        cuts = np.ceil(longest / size).astype(np.int64)
        # a needle is cut as often along its short side as along its long one: bounded by its area
        cuts = np.minimum(cuts, np.maximum(1, np.ceil(4.0 * np.sqrt(twice) / size))).astype(np.int64)
        for k in np.unique(cuts).tolist():
            mine = np.flatnonzero(cuts == k)
            u, v = _middles(k)
            at = a[mine][:, None] + u[:, None] * (b - a)[mine][:, None] + v[:, None] * (c - a)[mine][:, None]
            middles.append(at.reshape(-1, 3))
            normals.append(np.repeat(cross[mine] / twice[mine][:, None], k * k, axis=0))
            areas.append(np.repeat(0.5 * twice[mine] / (k * k), k * k))
        return Pieces(np.concatenate(middles), np.concatenate(normals), np.concatenate(areas), size)


@dataclass(frozen=True, slots=True)
class Pieces:
    """A surface in pieces: middles and outward unit normals (k, 3), areas (k,), and how large they are about."""

    points_mm: Float64Array
    normals: Float64Array
    area_mm2: Float64Array
    size_mm: float


@dataclass(frozen=True, slots=True)
class ReferenceCoverage:
    """How much of the nominal part is scanned well enough; mm² of its surface.

    `share` = good_mm2 / area_mm2, `touched_share` = touched_mm2 / area_mm2. `untouched` are the patches that no point
    has touched, as regions without a number, the largest first; `untouched_rows` which of the `pieces` (k) make up
    each. `touched` (k,) are the pieces that a point has touched.
    """

    area_mm2: float
    touched_mm2: float
    good_mm2: float
    untouched: tuple[RescanRegion, ...]
    untouched_rows: tuple[IntArray, ...]
    pieces: "Pieces"
    touched: BoolArray

    @property
    def share(self) -> float:
        """Share of the area that is good; NaN where the region of interest holds none of it."""
        return self.good_mm2 / self.area_mm2 if self.area_mm2 > 0 else float("nan")

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        share = self.share
        return {
            "kind": "reference",
            "share": None if np.isnan(share) else share,
            "area_mm2": self.area_mm2,
            "touched_mm2": self.touched_mm2,
            "untouched_mm2": self.area_mm2 - self.touched_mm2,
            "good_mm2": self.good_mm2,
        }


def check_place(reference: ReferenceSurface, snapshot: MapSnapshot) -> bool:
    """Whether the scan has enough points to tell that it lies on the mesh; False: too few yet.

    Raises
    ------
    ReferenceUnits : sizes differ by the factor between millimetres and metres or inches.
    ReferenceApart : most points are far from the mesh.
    """
    counted = np.flatnonzero(snapshot.neighbours > 0)
    if len(counted) < _LEAST_POINTS:
        return False
    points = snapshot.points_mm[counted[:: max(1, len(counted) // _SAMPLE)]]
    radius = float(np.median(snapshot.radius_mm[counted]))
    far_mm = max(min(_FAR_RADII * radius, 0.1 * reference.diagonal_mm), _FAR_SHARE * reference.diagonal_mm)
    size = max(radius, reference.diagonal_mm / 400.0)
    away = float(np.median(cKDTree(reference.pieces(size).points_mm).query(points)[0]))
    if away <= far_mm + min(size, far_mm):
        return True
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    for unit, factor in (("metres", 1000.0), ("inches", 25.4)):
        for share, seems in ((1.0 / factor, f"in {unit}"), (factor, f"in millimetres and taken for {unit}")):
            if 0.3 < extent * share / reference.diagonal_mm < 1.2:
                raise ReferenceUnits(
                    f"the reference mesh is {reference.diagonal_mm:.3g} mm across and the scan {extent:.3g} mm: it "
                    f"seems to be {seems}; state the unit of the mesh"
                )
    raise ReferenceApart(
        f"half of the scan's points lie more than {away:.3g} mm from the reference mesh (at most {far_mm:.3g} mm is "
        "taken for deviation): register the mesh to the part frame first"
    )


def reference_coverage(
    reference: ReferenceSurface, snapshot: MapSnapshot, report: RegionReport, requirement: Requirement
) -> ReferenceCoverage:
    """Measure a scan, judged in `report`, against the nominal part; within the region of interest if there is one."""
    counted = snapshot.neighbours > 0
    radius = float(np.median(snapshot.radius_mm[counted])) if counted.any() else 1.0
    pieces = _inside(reference.pieces(radius), requirement.interest)
    good_point = report.judgement.judged & np.isin(report.reason, (Reason.NONE, Reason.SHADOW))
    reach = max(0.6 * pieces.size_mm, float(np.quantile(report.spacings.reach_mm, 0.9)) if len(snapshot) else 0.0)
    touched = _reached(pieces, snapshot, counted, reach)
    good = touched & _reached(pieces, snapshot, good_point, reach)
    untouched = _untouched(pieces, ~touched, requirement, radius)
    return ReferenceCoverage(
        area_mm2=float(pieces.area_mm2.sum()),
        touched_mm2=float(pieces.area_mm2[touched].sum()),
        good_mm2=float(pieces.area_mm2[good].sum()),
        untouched=tuple(region for region, _ in untouched),
        untouched_rows=tuple(rows for _, rows in untouched),
        pieces=pieces,
        touched=touched,
    )


def _inside(pieces: Pieces, interest: Interest | None) -> Pieces:
    if interest is None:
        return pieces
    held = interest.holds(pieces.points_mm)
    return Pieces(pieces.points_mm[held], pieces.normals[held], pieces.area_mm2[held], pieces.size_mm)


def _reached(pieces: Pieces, snapshot: MapSnapshot, wanted: BoolArray, reach_mm: float) -> BoolArray:
    """(k,) pieces with a wanted point within reach whose ray does not come from the other side."""
    reached = np.zeros(len(pieces.points_mm), dtype=bool)
    rows = np.flatnonzero(wanted)
    if not len(rows) or not len(reached):
        return reached
    tree = cKDTree(snapshot.points_mm[rows])
    towards = snapshot.lines.laser_mm[snapshot.line[rows]] - snapshot.points_mm[rows]
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    distance, near = tree.query(pieces.points_mm, k=min(4, len(rows)), distance_upper_bound=reach_mm)
    distance = np.asarray(distance).reshape(len(reached), -1)
    near = np.minimum(np.asarray(near, dtype=np.int64).reshape(len(reached), -1), len(rows) - 1)
    facing = np.einsum("kqj,kj->kq", towards[near], pieces.normals) > _SAME_WAY
    return np.asarray((np.isfinite(distance) & facing).any(axis=1))


def _untouched(
    pieces: Pieces, bare: BoolArray, requirement: Requirement, radius_mm: float
) -> list[tuple[RescanRegion, IntArray]]:
    """Untouched pieces that hang together, as regions with the rows of their pieces."""
    rows = np.flatnonzero(bare)
    if not len(rows):
        return []
    pairs = cKDTree(pieces.points_mm[rows]).query_pairs(_BESIDE * pieces.size_mm, output_type="ndarray")
    cosine = np.einsum("ij,ij->i", pieces.normals[rows[pairs[:, 0]]], pieces.normals[rows[pairs[:, 1]]])
    pairs = pairs[cosine >= np.cos(np.radians(requirement.region_angle_deg))]
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rows), len(rows)))
    label = connected_components(graph, directed=False)[1]
    least = requirement.least_area_mm2(radius_mm)
    found = []
    for mine in np.split(rows[np.argsort(label, kind="stable")], np.cumsum(np.bincount(label))[:-1]):
        area = float(pieces.area_mm2[mine].sum())
        if area < least:
            continue
        points = pieces.points_mm[mine]
        size = np.full(len(mine), pieces.size_mm)
        patch = patch_of(points, _BESIDE * size, size)
        region = RescanRegion(
            number=0,
            reason=Reason.UNTOUCHED,
            outline_mm=patch.loops,
            area_mm2=area,
            centroid_mm=np.average(points, axis=0, weights=pieces.area_mm2[mine]),
            normal=mean_normal(pieces.normals[mine]),
            measured_per_mm2=0.0,
            required_per_mm2=float("nan") if requirement.density_per_mm2 is None else requirement.density_per_mm2,
            counting_error_per_mm2=0.0,
            priority=priority_of(1.0, area),
            point_count=0,
            remedy=REMEDIES[Reason.UNTOUCHED],
            point_rows=np.zeros(0, dtype=np.int64),
            line_spacing_mm=float("nan") if requirement.line_spacing_mm is None else requirement.line_spacing_mm,
        )
        found.append((region, mine.astype(np.int64)))
    return sorted(found, key=lambda pair: -pair[0].area_mm2)


def _middles(cuts: int) -> tuple[Float64Array, Float64Array]:
    """Barycentric middles (k²,) of the equal triangles that each side cut into `cuts` gives."""
    i, j = np.meshgrid(np.arange(cuts), np.arange(cuts), indexing="ij")
    up = i + j < cuts
    down = i + j < cuts - 1
    u = np.concatenate([(i[up] + 1 / 3) / cuts, (i[down] + 2 / 3) / cuts])
    v = np.concatenate([(j[up] + 1 / 3) / cuts, (j[down] + 2 / 3) / cuts])
    return u, v


def _check_closed(corners_mm: Float64Array) -> None:
    """Refuse a mesh in which some edge does not run once each way; corners in one place are one corner."""
    flat = corners_mm.reshape(-1, 3)
    vertex = np.unique(flat, axis=0, return_inverse=True)[1].reshape(-1, 3)
    whole = (vertex[:, 0] != vertex[:, 1]) & (vertex[:, 1] != vertex[:, 2]) & (vertex[:, 2] != vertex[:, 0])
    vertex = vertex[whole]
    edge = vertex[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    base = int(edge.max()) + 1
    there, count = np.unique(edge[:, 0] * base + edge[:, 1], return_counts=True)
    back = np.unique(edge[:, 1] * base + edge[:, 0])
    bare = len(np.setxor1d(there, back)) + int((count > 1).sum())
    if bare:
        raise ReferenceOpen(
            f"the reference mesh is not watertight: {bare} of its {len(there)} edges do not have one triangle on "
            "either side; close its holes and try again"
        )
