"""Which surface of a part can be scanned at all, and how densely it was: truth by dense ray casting.

Imports neither the planner of passes nor the simulator's optics; of a part it asks only where a ray first meets it.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from drivers.scanline import Float64Array, Scanline

BoolArray = npt.NDArray[np.bool_]
BALL_MM = 1.2
"""Radius of the ball in which the density at a place is counted."""
LAYER_MM = 0.25
"""How far from its tangent plane a point may lie to belong to a place's own side of a wall: noise and curvature."""
_LIFT_MM = 2e-3


class Rays(Protocol):
    """A surface that rays can be sent to."""

    def first_hit(self, origins_mm: Float64Array, directions: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Distance (n,) along each ray, inf = none, and unit outward normals (n, 3)."""


@dataclass(frozen=True, slots=True)
class Samples:
    """Places (n, 3) spread evenly over a surface, with normals (n, 3); each stands for `each_mm2`."""

    places_mm: Float64Array
    normals: Float64Array
    each_mm2: float

    def __len__(self) -> int:
        return len(self.places_mm)


def sample_surface(
    surface: Rays, low_mm: Float64Array, high_mm: Float64Array, count: int, rng: np.random.Generator
) -> Samples:
    """At least `count` places, uniform by area: where isotropic random lines meet the surface (Crofton 1868).

    A line through a ball of radius R meets a surface of area A in it 2 A / (4 pi R^2) times on the average.
    """
    centre = 0.5 * (low_mm + high_mm)
    radius = 0.5 * float(np.linalg.norm(high_mm - low_mm)) * 1.01
    found: list[Float64Array] = []
    turned: list[Float64Array] = []
    lines, hits = 0, 0
    while hits < count:
        n = 20_000
        ends = rng.standard_normal((2, n, 3))
        ends /= np.linalg.norm(ends, axis=2, keepdims=True)  # chords between uniform ends on the sphere are isotropic
        start, way = centre + radius * ends[0], radius * (ends[1] - ends[0])
        length = np.linalg.norm(way, axis=1)
        way = way / length[:, None]
        lines += n
        gone = np.zeros(n)
        alive = np.arange(n)
        for _ in range(24):
            distance, normals = surface.first_hit(start[alive] + gone[alive, None] * way[alive], way[alive])
            met = np.isfinite(distance) & (gone[alive] + distance < length[alive])
            alive, distance, normals = alive[met], distance[met], normals[met]
            if not len(alive):
                break
            gone[alive] += distance
            found.append(start[alive] + gone[alive, None] * way[alive])
            turned.append(normals)
            hits += len(alive)
            gone[alive] += 1e-4
    places, normals = np.concatenate(found), np.concatenate(turned)
    area = 4.0 * math.pi * radius**2 * hits / (2.0 * lines)
    return Samples(places, normals, area / hits)


@dataclass(frozen=True, slots=True)
class Allowed:
    """What poses and sights are allowed, as inequalities.

    The sensor's z axis is at most `max_tilt_rad` from +z; the angle between normal and laser ray at most
    `max_incidence_rad`; the camera stands `camera_rad` aside of the laser, in the direction of any roll.
    """

    max_tilt_rad: float
    max_incidence_rad: float
    camera_rad: float


def scannable(surface: Rays, samples: Samples, allowed: Allowed, directions: int = 900, rolls: int = 12) -> BoolArray:
    """(n,) True where some allowed pose has both the laser's and the camera's line of sight free.

    Every sample sends rays along an even spread of directions; the camera's direction is taken as the nearest of them.
    """
    turn = np.arange(directions) * math.pi * (3.0 - math.sqrt(5.0))
    z = 1.0 - (2.0 * np.arange(directions) + 1.0) / directions
    flat = np.sqrt(1.0 - z * z)
    ways = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])
    clear = np.zeros((len(samples), directions), dtype=np.bool_)
    for column, way in enumerate(ways):
        asked = np.flatnonzero(samples.normals @ way > 0.05)
        starts = samples.places_mm[asked] + _LIFT_MM * samples.normals[asked]
        distance, _ = surface.first_hit(starts, np.broadcast_to(way, starts.shape))
        clear[asked[~np.isfinite(distance)], column] = True
    seen = np.zeros(len(samples), dtype=np.bool_)
    for column, way in enumerate(ways):
        if way[2] < math.cos(allowed.max_tilt_rad):
            continue
        lit = clear[:, column] & (samples.normals @ way >= math.cos(allowed.max_incidence_rad))
        side = np.cross(way, [0.3, 0.5, 0.8])
        side /= np.linalg.norm(side)
        other = np.cross(way, side)
        for roll in np.arange(rolls) * 2.0 * math.pi / rolls:
            camera = math.cos(allowed.camera_rad) * way + math.sin(allowed.camera_rad) * (
                math.cos(roll) * side + math.sin(roll) * other
            )
            seen |= lit & clear[:, int(np.argmax(ways @ camera))]
    return seen


class CoverageTruth:
    """How much of the scannable surface meets a density, counted from the scanlines themselves.

    `judged` samples are those that are scannable and not within one ball of a place that is not. The density at a
    sample is the points of its own side in a ball over the true area in it, known from many more samples.
    """

    def __init__(self, samples: Samples, dense: Samples, is_scannable: BoolArray, density_per_mm2: float) -> None:
        hidden = cKDTree(samples.places_mm[~is_scannable]) if (~is_scannable).any() else None
        keep = is_scannable.copy()
        if hidden is not None:
            keep &= ~np.isfinite(hidden.query(samples.places_mm, distance_upper_bound=BALL_MM)[0])
        self.judged = np.flatnonzero(keep)
        self._places, self._normals = samples.places_mm[keep], samples.normals[keep]
        self._required = density_per_mm2
        self._each_mm2 = samples.each_mm2
        same = self._count(dense.places_mm, dense.normals)
        self._area = np.maximum(same, 1.0) * dense.each_mm2
        self._points = np.zeros(len(self._places))

    @property
    def scannable_mm2(self) -> float:
        """Area of the judged surface."""
        return len(self._places) * self._each_mm2

    def add(self, lines: Iterable[Scanline]) -> None:
        """Count the points of a pass."""
        points, ways = [], []
        for line in lines:
            good = np.isfinite(line.points_mm).all(axis=1)
            points.append(line.points_mm[good])
            ways.append(line.laser_mm - line.points_mm[good])
        if points and sum(map(len, points)):
            self._points += self._count(np.concatenate(points), np.concatenate(ways))

    @property
    def met(self) -> BoolArray:
        """(judged,) where the density is there."""
        enough: BoolArray = self._points / self._area >= self._required
        return enough

    @property
    def share(self) -> float:
        """Coverage of the scannable surface."""
        return float(self.met.mean()) if len(self._places) else math.nan

    @property
    def met_mm2(self) -> float:
        """Area that has the density."""
        return float(self.met.sum()) * self._each_mm2

    def places(self) -> tuple[Float64Array, Float64Array, BoolArray]:
        """Places and normals of the judged samples, and where the density is there."""
        return self._places, self._normals, self.met

    def _count(self, points_mm: Float64Array, towards: Float64Array) -> Float64Array:
        """(judged,) how many points lie around each sample, in its layer and on its side."""
        tree = cKDTree(points_mm)
        counts = np.zeros(len(self._places))
        for begin in range(0, len(self._places), 2000):
            part = slice(begin, begin + 2000)
            near = tree.query_ball_point(self._places[part], BALL_MM)
            of = np.repeat(
                np.arange(begin, begin + len(near)), np.array([np.size(one) for one in near], dtype=np.int64)
            )
            if not len(of):
                continue
            which = np.concatenate([np.asarray(one, dtype=np.int64) for one in near])
            off = np.abs(np.einsum("ij,ij->i", points_mm[which] - self._places[of], self._normals[of]))
            side = np.einsum("ij,ij->i", towards[which], self._normals[of])
            mine = (off <= LAYER_MM) & (side > 0)
            counts += np.bincount(of[mine], minlength=len(counts))
        return counts
