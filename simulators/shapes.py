"""Exact solids and where a ray first meets them; knows no mesh, no optics and no noise.

Every solid is built from convex *leaves*. A ray meets a leaf in one interval, so every place where it can enter or
leave the whole solid is an end of some leaf's interval; whether it does is decided by which leaves hold the ray just
before and just after that end. That is exact for any tree of unions and differences, also where faces coincide.
Lengths are millimetres; rays are (n, 3) origins and (n, 3) unit directions.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

from drivers.scanline import BoolArray, Float64Array


class Surface(Protocol):
    """Whatever light can hit: a solid of this module or a triangle mesh."""

    def first_hit(self, origins_mm: Float64Array, directions: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Distance (n,) along each ray, inf = no hit, and unit outward normals (n, 3), NaN = no hit."""


class Solid(ABC):
    """A tree of convex leaves, able to tell where rays first cross its surface."""

    @abstractmethod
    def leaves(self) -> "tuple[ConvexSolid, ...]":
        """The convex solids of the tree, from left to right."""

    @abstractmethod
    def combine(self, inside: Iterator[BoolArray]) -> BoolArray:
        """Membership in the tree, given the membership in each leaf in the order of `leaves()`."""

    def first_hit(self, origins_mm: Float64Array, directions: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Where each ray first crosses the surface, ahead of its origin.

        Parameters
        ----------
        origins_mm, directions : (n, 3) each; the directions are unit vectors.

        Returns
        -------
        distance_mm : (n,), inf where the ray meets nothing.
        normals : (n, 3) unit and outward, NaN where the ray meets nothing.
        """
        leaves = self.leaves()
        n = len(origins_mm)
        ends = np.empty((len(leaves), 2, n))
        for leaf, (enter, leave) in zip(leaves, ends, strict=True):
            enter[:], leave[:] = leaf.interval(origins_mm, directions)
        ahead = (ends[:, 0] < ends[:, 1]) & (ends[:, 1] > 0)
        live = np.flatnonzero(ahead.any(axis=1))  # most leaves are away from most laser planes
        distance = np.full(n, np.inf)
        normals = np.full((n, 3), np.nan)
        if not len(live):
            return distance, normals
        at = ends[live].reshape(-1, n)
        before = np.zeros((len(leaves), *at.shape), dtype=np.bool_)
        after = np.zeros_like(before)
        for index in live:
            enter, leave = ends[index]
            before[index] = (enter < at) & (at <= leave)
            after[index] = (enter <= at) & (at < leave)
        enters = self.combine(iter(after))
        # a leaf that the ray misses has no ends, though the ends of its faces may lie where another leaf's are
        met = np.repeat(ends[live, 0] < ends[live, 1], 2, axis=0)
        crossing = (self.combine(iter(before)) != enters) & (at > 0) & met
        candidates = np.where(crossing, at, np.inf)
        nearest = candidates.argmin(axis=0)
        rays = np.arange(n)
        distance = candidates[nearest, rays]
        hit = np.isfinite(distance)
        for index in np.unique(nearest[hit] // 2):
            chosen = hit & (nearest // 2 == index)
            points = origins_mm[chosen] + distance[chosen, None] * directions[chosen]
            normals[chosen] = leaves[live[index]].outward(points)
        # The leaf's outward is the solid's inward where the leaf was cut away: going in is against the normal.
        along = np.einsum("ij,ij->i", normals, directions)
        wrong = hit & ((along > 0) == enters[nearest, rays])
        normals[wrong] *= -1.0
        return distance, normals


class ConvexSolid(Solid):
    """A solid that every straight line meets in one interval or not at all."""

    @abstractmethod
    def interval(self, origins_mm: Float64Array, directions: Float64Array) -> tuple[Float64Array, Float64Array]:
        """(n,) distances at which each ray enters and leaves, of the whole line; enter >= leave means a miss."""

    @abstractmethod
    def outward(self, points_mm: Float64Array) -> Float64Array:
        """(n, 3) unit outward normals at points (n, 3) of the boundary."""

    def leaves(self) -> "tuple[ConvexSolid, ...]":
        """Itself."""
        return (self,)

    def combine(self, inside: Iterator[BoolArray]) -> BoolArray:
        """Its own membership."""
        return next(inside)


class Polyhedron(ConvexSolid):
    """The points p with `outward_normals @ p <= offsets_mm`; need not be bounded."""

    def __init__(self, outward_normals: Float64Array, offsets_mm: Float64Array) -> None:
        lengths = np.linalg.norm(outward_normals, axis=1)
        if not (lengths > 0).all():
            raise ValueError("every face of a polyhedron needs a normal longer than zero")
        self._normals = outward_normals / lengths[:, None]
        self._offsets = offsets_mm / lengths

    def interval(self, origins_mm: Float64Array, directions: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Between the last face entered and the first face left."""
        # One row a face: numpy reduces long rows several times faster than short ones.
        rise = self._normals @ directions.T
        room = self._offsets[:, None] - self._normals @ origins_mm.T
        with np.errstate(divide="ignore", invalid="ignore"):
            at = room / rise
        enter = np.where(rise < 0, at, -np.inf).max(axis=0)
        leave = np.where(rise > 0, at, np.inf).min(axis=0)
        beside = ((rise == 0) & (room < 0)).any(axis=0)
        return enter, np.where(beside, -np.inf, leave)

    def outward(self, points_mm: Float64Array) -> Float64Array:
        """Of the face that each point lies on."""
        height = points_mm @ self._normals.T - self._offsets
        normals: Float64Array = self._normals[height.argmax(axis=1)]
        return normals


class Sphere(ConvexSolid):
    """A ball around `centre_mm`."""

    def __init__(self, centre_mm: Sequence[float], radius_mm: float) -> None:
        self._centre = np.array(centre_mm, dtype=np.float64)
        self._radius = radius_mm

    def interval(self, origins_mm: Float64Array, directions: Float64Array) -> tuple[Float64Array, Float64Array]:
        """From the closest approach, which stays exact for far origins where b^2 - 4ac does not."""
        to_centre = self._centre - origins_mm
        closest = np.einsum("ij,ij->i", to_centre, directions)
        miss = to_centre - closest[:, None] * directions
        half_squared = self._radius**2 - np.einsum("ij,ij->i", miss, miss)
        half = np.sqrt(np.maximum(half_squared, 0.0))
        return closest - half, np.where(half_squared > 0, closest + half, -np.inf)

    def outward(self, points_mm: Float64Array) -> Float64Array:
        """Away from the centre."""
        radial: Float64Array = points_mm - self._centre
        radial /= np.linalg.norm(radial, axis=1, keepdims=True)
        return radial


class Cylinder(ConvexSolid):
    """A closed round cylinder from the centre of its one end, `start_mm`, to that of the other, `end_mm`."""

    def __init__(self, start_mm: Sequence[float], end_mm: Sequence[float], radius_mm: float) -> None:
        self._start = np.array(start_mm, dtype=np.float64)
        span = np.array(end_mm, dtype=np.float64) - self._start
        self._length = float(np.linalg.norm(span))
        if not self._length > 0:
            raise ValueError("the ends of a cylinder must differ")
        self._axis = span / self._length
        self._radius = radius_mm

    def interval(self, origins_mm: Float64Array, directions: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Inside the round wall and between the ends."""
        offset = origins_mm - self._start
        along, climb = offset @ self._axis, directions @ self._axis
        across = offset - along[:, None] * self._axis
        drift = directions - climb[:, None] * self._axis
        speed_squared = np.einsum("ij,ij->i", drift, drift)
        with np.errstate(divide="ignore", invalid="ignore"):
            closest = -np.einsum("ij,ij->i", across, drift) / speed_squared
            miss = across + closest[:, None] * drift
            half_squared = (self._radius**2 - np.einsum("ij,ij->i", miss, miss)) / speed_squared
            half = np.sqrt(np.maximum(half_squared, 0.0))
            at_start, at_end = -along / climb, (self._length - along) / climb
        parallel = speed_squared == 0
        within = np.einsum("ij,ij->i", across, across) < self._radius**2
        enter = np.where(parallel, -np.inf, closest - half)
        leave = np.where(parallel, np.where(within, np.inf, -np.inf), closest + half)
        leave = np.where(parallel | (half_squared > 0), leave, -np.inf)
        level = climb == 0
        between = (along >= 0) & (along <= self._length)
        enter_ends = np.where(level, -np.inf, np.minimum(at_start, at_end))
        leave_ends = np.where(level, np.where(between, np.inf, -np.inf), np.maximum(at_start, at_end))
        return np.maximum(enter, enter_ends), np.minimum(leave, leave_ends)

    def outward(self, points_mm: Float64Array) -> Float64Array:
        """Of the wall or the end that each point lies on."""
        offset = points_mm - self._start
        along = offset @ self._axis
        across = offset - along[:, None] * self._axis
        distance = np.linalg.norm(across, axis=1)
        beyond = np.stack([distance - self._radius, -along, along - self._length])
        with np.errstate(divide="ignore", invalid="ignore"):
            wall = across / distance[:, None]
        choices = np.stack([wall, np.broadcast_to(-self._axis, wall.shape), np.broadcast_to(self._axis, wall.shape)])
        normals: Float64Array = choices[beyond.argmax(axis=0), np.arange(len(points_mm))]
        return normals


class Union(Solid):
    """Whatever lies in any of the parts."""

    def __init__(self, first: Solid, *others: Solid) -> None:
        self._parts = (first, *others)
        self._leaves = tuple(leaf for part in self._parts for leaf in part.leaves())

    def leaves(self) -> tuple[ConvexSolid, ...]:
        """Those of the parts, in their order."""
        return self._leaves

    def combine(self, inside: Iterator[BoolArray]) -> BoolArray:
        """In any part."""
        joined = self._parts[0].combine(inside)
        for part in self._parts[1:]:
            joined = joined | part.combine(inside)
        return joined


class Difference(Solid):
    """What is left of `base` when the cutters are taken away."""

    def __init__(self, base: Solid, *cutters: Solid) -> None:
        self._base = base
        self._cutters = cutters
        self._leaves = tuple(leaf for part in (base, *cutters) for leaf in part.leaves())

    def leaves(self) -> tuple[ConvexSolid, ...]:
        """Those of the base, then those of the cutters."""
        return self._leaves

    def combine(self, inside: Iterator[BoolArray]) -> BoolArray:
        """In the base and in no cutter."""
        left = self._base.combine(inside)
        for cutter in self._cutters:
            left = left & ~cutter.combine(inside)
        return left


def half_space(point_mm: Sequence[float], outward: Sequence[float]) -> Polyhedron:
    """Everything behind the plane through `point_mm` with the normal `outward`."""
    normal = np.array([outward], dtype=np.float64)
    return Polyhedron(normal, normal @ np.array(point_mm, dtype=np.float64))


def box(low_mm: Sequence[float], high_mm: Sequence[float]) -> Polyhedron:
    """The box along the axes between two corners."""
    low, high = np.array(low_mm, dtype=np.float64), np.array(high_mm, dtype=np.float64)
    if not (low < high).all():
        raise ValueError(f"the low corner {low.tolist()} of a box must lie below the high corner {high.tolist()}")
    return Polyhedron(np.vstack([np.eye(3), -np.eye(3)]), np.concatenate([high, -low]))


def extruded_along_x(outline_yz_mm: Sequence[tuple[float, float]], x_mm: tuple[float, float]) -> Polyhedron:
    """A prism: a convex outline in the (y, z) plane, counter-clockwise seen from +x, drawn out between two x."""
    outline = np.array(outline_yz_mm, dtype=np.float64)
    edges = np.roll(outline, -1, axis=0) - outline
    following = np.roll(edges, -1, axis=0)
    if not (edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0] > 0).all():
        raise ValueError("the outline of a prism must be convex and counter-clockwise")
    sides = np.column_stack([np.zeros(len(edges)), edges[:, 1], -edges[:, 0]])
    offsets = np.einsum("ij,ij->i", sides[:, 1:], outline)
    ends = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    return Polyhedron(np.vstack([sides, ends]), np.concatenate([offsets, [x_mm[1], -x_mm[0]]]))
