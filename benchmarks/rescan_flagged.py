"""How well flagged area agrees with the truth, reason by reason; knows regions and truth, finds neither.

Visible surface is a graph over the scan: angle in the fan and station. There a region's outline is a polygon, and every
sample that the laser lights is in it or not. What is hidden has no place there: a shadow's region is the ribbon that
closes the hidden hollow. So a hidden sample is flagged when it lies within a radius of the ribbon, or when the ribbon
is the first thing that is seen from it in some direction, no further away than the ribbon is wide. A place of the
ribbon is right when the surface that it closes off, on either side and no further away, is truly hidden.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from matplotlib.path import Path as Polygon
from scipy.spatial import cKDTree

from benchmarks.rescan_truth import (
    Bools,
    Caster,
    Floats,
    Optics,
    Samples,
    Sight,
    Sweep,
    band_of,
    scan_coordinates,
)
from scanner_service.rescan.region import RescanRegion

ANY = "any reason"
_DIRECTIONS = 48
_LIFT_MM = 0.01


@dataclass(frozen=True, slots=True)
class Agreement:
    """Areas in mm², the band left out: true, true and flagged, flagged, flagged and true."""

    true_mm2: float
    found_mm2: float
    flagged_mm2: float
    right_mm2: float

    @property
    def recall(self) -> float:
        """Share of the true area that is flagged for this reason; NaN where nothing is true."""
        return self.found_mm2 / self.true_mm2 if self.true_mm2 > 0 else float("nan")

    @property
    def precision(self) -> float:
        """Share of the flagged area of which it is true; NaN where nothing is flagged."""
        return self.right_mm2 / self.flagged_mm2 if self.flagged_mm2 > 0 else float("nan")

    def __add__(self, other: "Agreement") -> "Agreement":
        mine, others = self.areas(), other.areas()
        return Agreement(*(a + b for a, b in zip(mine, others, strict=True)))

    def areas(self) -> tuple[float, float, float, float]:
        """The four areas."""
        return (self.true_mm2, self.found_mm2, self.flagged_mm2, self.right_mm2)


@dataclass(frozen=True, slots=True)
class Looked:
    """Samples of a part, what a sweep sees of them, and of which reasons that is the truth."""

    samples: Samples
    sight: Sight
    truth: dict[str, Bools]


def flagged_visible(
    regions: Sequence[RescanRegion], samples: Samples, sight: Sight, optics: Optics, sweep: Sweep
) -> dict[str, Bools]:
    """Of each reason but `shadow`, which lit samples (n,) lie in a region's outline, as the scanner sees it."""
    depth = float(optics.laser_mm[2])
    place = np.column_stack([sight.angle_rad * depth, sight.station_mm])
    flagged: dict[str, Bools] = {}
    for region in regions:
        if region.reason.label == "shadow":
            continue
        inside = np.zeros(len(samples), dtype=bool)
        for loop in region.outline_mm:
            station, angle = scan_coordinates(loop, optics, sweep)
            corners = np.column_stack([angle * depth, station])
            low, high = corners.min(axis=0), corners.max(axis=0)
            near = np.flatnonzero(((place >= low) & (place <= high)).all(axis=1) & sight.lit)
            if len(near) and len(corners) > 2:
                inside[near] ^= Polygon(corners).contains_points(place[near])
        mine = flagged.setdefault(region.reason.label, np.zeros(len(samples), dtype=bool))
        mine |= inside
    return flagged


def ribbon_of(regions: Sequence[RescanRegion]) -> trimesh.Trimesh | None:
    """The ribbons of all shadows as one mesh, rung by rung; None without a shadow."""
    corners: list[Floats] = []
    faces: list[np.ndarray] = []
    count = 0
    for region in regions:
        if region.reason.label != "shadow":
            continue
        loops = region.outline_mm
        closed = len(loops) == 2 and len(loops[0]) == len(loops[1])
        if not closed and len(loops[0]) % 2:
            continue
        half = len(loops[0]) if closed else len(loops[0]) // 2
        top = loops[0] if closed else loops[0][:half]
        bottom = (loops[1] if closed else loops[0][half:])[::-1]
        at = np.arange(half if closed else half - 1)
        after = (at + 1) % half
        corners += [top, bottom]
        faces.append(count + np.column_stack([at, at + half, after]))
        faces.append(count + np.column_stack([after, at + half, after + half]))
        count += 2 * half
    if not faces:
        return None
    mesh = trimesh.Trimesh(np.concatenate(corners), np.concatenate(faces), process=False)
    mesh.update_faces(mesh.area_faces > 1e-9)
    return mesh if len(mesh.faces) else None


def agreements_of_lit(
    regions: Sequence[RescanRegion], looked: Looked, optics: Optics, sweep: Sweep, radius_mm: float
) -> dict[str, Agreement]:
    """Of each reason but `shadow`, how flagged and true area agree."""
    flagged = flagged_visible(regions, looked.samples, looked.sight, optics, sweep)
    none = np.zeros(len(looked.samples), dtype=bool)
    return {
        reason: _agreement(looked, true, flagged.get(reason, none), none, radius_mm)
        for reason, true in looked.truth.items()
        if reason != "shadow"
    }


def agreements_of_shadows(
    regions: Sequence[RescanRegion],
    part: trimesh.Trimesh,
    looked: Looked,
    optics: Optics,
    sweep: Sweep,
    radius_mm: float,
) -> dict[str, Agreement]:
    """The same of shadows, and of any reason (`ANY`): worth another pass, whatever it is called."""
    samples, sight = looked.samples, looked.sight
    anything = np.logical_or.reduce(list(looked.truth.values()))
    none = np.zeros(len(samples), dtype=bool)
    lit = np.logical_or.reduce([none, *flagged_visible(regions, samples, sight, optics, sweep).values()])
    found = {}
    for reason, true, seen in (("shadow", looked.truth["shadow"], none), (ANY, anything, lit)):
        closed, right_mm2, ribbon_mm2 = _ribbons(regions, part, samples, true, sight.grazing, radius_mm)
        found[reason] = _agreement(looked, true, seen, closed, radius_mm) + Agreement(0.0, 0.0, ribbon_mm2, right_mm2)
    return found


def _agreement(looked: Looked, true: Bools, seen: Bools, closed: Bools, radius_mm: float) -> Agreement:
    """Of samples that are flagged where they are seen, or closed off by a ribbon, whose own area is not in it."""
    counted = ~band_of(looked.samples, true, radius_mm) & ~looked.sight.grazing
    areas = (true, true & (seen | closed), seen, seen & true)
    return Agreement(*(looked.samples.area_mm2 * int((marks & counted).sum()) for marks in areas))


def _ribbons(
    regions: Sequence[RescanRegion],
    part: trimesh.Trimesh,
    samples: Samples,
    true: Bools,
    left_out: Bools,
    radius_mm: float,
) -> tuple[Bools, float, float]:
    """Which hidden samples (n,) a ribbon closes off; area of the ribbons that is right, and area that was looked at."""
    closed = np.zeros(len(samples), dtype=bool)
    ribbon = ribbon_of(regions)
    if ribbon is None:
        return closed, 0.0, 0.0
    corners = np.concatenate([part.vertices, ribbon.vertices])
    faces = np.concatenate([part.faces, np.asarray(ribbon.faces) + len(part.vertices)])
    caster = Caster(trimesh.Trimesh(corners, faces, process=False))
    first = len(part.faces)
    edges = np.asarray(ribbon.vertices)[ribbon.faces]
    width = np.linalg.norm(edges - np.roll(edges, 1, axis=1), axis=2).max(axis=1)
    rng = np.random.default_rng(3)
    rows = np.flatnonzero(true)
    dense = np.asarray(
        trimesh.sample.sample_surface(ribbon, max(1, int(4 * ribbon.area / samples.area_mm2)), seed=7)[0]
    )
    closed[rows] = np.isfinite(cKDTree(dense).query(samples.points_mm[rows], distance_upper_bound=radius_mm)[0])
    for _ in range(_DIRECTIONS):
        left = rows[~closed[rows]]
        normal = samples.normals[left]
        way = rng.normal(size=(len(left), 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        way += 1.02 * normal
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        start = samples.points_mm[left] + _LIFT_MM * normal
        distance, triangle = caster.first_hit(start, way)
        mine = triangle >= first
        closed[left[mine]] = distance[mine] <= np.maximum(width[triangle[mine] - first], radius_mm)
    count = max(1, int(ribbon.area / samples.area_mm2))
    points, face = trimesh.sample.sample_surface(ribbon, count, seed=5)
    points, normals = np.asarray(points), np.asarray(ribbon.face_normals)[face]
    surface, band = cKDTree(samples.points_mm), band_of(samples, true, radius_mm) | left_out
    good, excused = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    sure = good.copy()
    solid = Caster(part)
    for side in (1.0, -1.0):
        distance = solid.distance_mm(points, side * normals)
        reached = distance <= np.maximum(width[face], radius_mm)
        foot = points[reached] + side * distance[reached, None] * normals[reached]
        nearest = np.asarray(surface.query(foot)[1])
        good[reached] |= true[nearest]
        sure[reached] |= true[nearest] & ~band[nearest]
        excused[reached] |= band[nearest]
    looked = sure | ~(good | excused)  # a ribbon that closes nothing off is wrong wherever it is
    per_point = float(ribbon.area) / count
    return closed, per_point * int((good & looked).sum()), per_point * int(looked.sum())
