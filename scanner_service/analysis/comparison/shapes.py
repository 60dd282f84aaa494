"""Clouds whose normals are known exactly, smooth ones and ones with edges, sampled at random; knows no noise."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.errors import MethodRefused

Reference = Literal["shape", "file", "live map", "scanner analyse"]
"""Where normals that others are compared with are from; those of this program are no truth but another estimate."""

ESTIMATES: dict[Reference, str] = {"live map": "the live map", "scanner analyse": "scanner analyse"}
"""What a comparison with each of them is a difference from; with all others it is an error."""


@dataclass(frozen=True, slots=True)
class KnownCloud:
    """Points (n, 3) in mm with unit normals (n, 3), whose sign has no meaning, and where the normals are from."""

    name: str
    points_mm: Float64Array
    normals: Float64Array
    reference: Reference = "shape"

    def __post_init__(self) -> None:
        read_only(self.points_mm)
        read_only(self.normals)


def known_cloud(
    name: str, points_mm: Float64Array, normals: Float64Array, reference: Reference = "file"
) -> tuple[KnownCloud, BoolArray]:
    """A cloud with reference normals (n, 3) of any length, and which of the points (n,) have one and are in it.

    Raises
    ------
    MethodRefused : no point has a reference normal.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.sqrt((normals * normals).sum(axis=1))
    kept: BoolArray = np.asarray(np.isfinite(length) & (length > 0.0) & np.isfinite(points_mm).all(axis=1))
    if not kept.any():
        raise MethodRefused(f"{name} has no point with a reference normal, so there is nothing to compare with")
    return KnownCloud(name, points_mm[kept], normals[kept] / length[kept, None], reference), kept


def sphere(count: int, rng: np.random.Generator) -> KnownCloud:
    """A sphere of radius 10 mm, uniformly at random."""
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return KnownCloud("sphere", 10.0 * normals, normals)


def cylinder(count: int, rng: np.random.Generator) -> KnownCloud:
    """The mantle of a cylinder, radius 5 mm, height 20 mm, uniformly at random; open at both ends."""
    angle, z = rng.uniform(0.0, 2.0 * math.pi, count), rng.uniform(-10.0, 10.0, count)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    return KnownCloud("cylinder", np.column_stack([5.0 * normals[:, :2], z]), normals)


def edge(count: int, rng: np.random.Generator) -> KnownCloud:
    """Two square faces of 10 mm that meet in a right angle, uniformly at random."""
    along, away = rng.uniform(-5.0, 5.0, count), rng.uniform(0.0, 10.0, count)
    upper = np.arange(count) % 2 == 0
    zero = np.zeros(count)
    points = np.where(upper[:, None], np.column_stack([away, along, zero]), np.column_stack([zero, along, -away]))
    normals = np.where(upper[:, None], np.array([0.0, 0.0, 1.0]), np.array([-1.0, 0.0, 0.0]))
    return KnownCloud("edge", points, normals)


def ridge(count: int, rng: np.random.Generator) -> KnownCloud:
    """Two square faces of 10 mm that meet at 140°, uniformly at random: an edge that noise soon hides."""
    along, away = rng.uniform(-5.0, 5.0, count), rng.uniform(0.0, 10.0, count)
    side = np.where(np.arange(count) % 2 == 0, 1.0, -1.0)
    slope = math.radians(20.0)
    points = np.column_stack([side * away * math.cos(slope), along, -away * math.sin(slope)])
    normals = np.column_stack([side * math.sin(slope), np.zeros(count), np.full(count, math.cos(slope))])
    return KnownCloud("ridge", points, normals)


def corner(count: int, rng: np.random.Generator) -> KnownCloud:
    """Three square faces of 10 mm that meet at a corner of a cube, uniformly at random."""
    points = rng.uniform(0.0, 10.0, (count, 3))
    face = np.arange(count) % 3
    points[np.arange(count), face] = 0.0
    return KnownCloud("corner", points, np.eye(3)[face])


def can(count: int, rng: np.random.Generator) -> KnownCloud:
    """A closed cylinder, radius 5 mm, height 10 mm, uniformly at random: a third of its area are the two lids."""
    angle, high = rng.uniform(0.0, 2.0 * math.pi, count), rng.uniform(-5.0, 5.0, count)
    outwards = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    is_lid = rng.uniform(size=count) < 1.0 / 3.0
    up = np.where(high > 0.0, 1.0, -1.0)
    on_lid = np.column_stack([5.0 * np.sqrt(rng.uniform(size=count))[:, None] * outwards[:, :2], 5.0 * up])
    on_mantle = np.column_stack([5.0 * outwards[:, :2], high])
    upwards = np.column_stack([np.zeros((count, 2)), up])
    return KnownCloud("can", np.where(is_lid[:, None], on_lid, on_mantle), np.where(is_lid[:, None], upwards, outwards))


def torus(count: int, rng: np.random.Generator) -> KnownCloud:
    """A torus, radii 10 and 3 mm, uniformly at random."""
    around = rng.uniform(0.0, 2.0 * math.pi, count)
    tube = _at_random(count, rng, 2.0 * math.pi, lambda v: (10.0 + 3.0 * np.cos(v)) / 13.0)
    normals = np.column_stack([np.cos(tube) * np.cos(around), np.cos(tube) * np.sin(around), np.sin(tube)])
    middle = np.column_stack([10.0 * np.cos(around), 10.0 * np.sin(around), np.zeros(count)])
    return KnownCloud("torus", middle + 3.0 * normals, normals)


def waves(count: int, rng: np.random.Generator) -> KnownCloud:
    """z = cos(x/1.5 mm) over a square of 20 mm, uniformly at random: curvature that changes from place to place."""
    x = _at_random(count, rng, 20.0, lambda x: np.hypot(1.0, np.sin(x / 1.5) / 1.5) / math.hypot(1.0, 1.0 / 1.5))
    y = rng.uniform(-10.0, 10.0, count)
    normals = np.column_stack([np.sin(x / 1.5) / 1.5, np.zeros(count), np.ones(count)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return KnownCloud("waves", np.column_stack([x - 10.0, y, np.cos(x / 1.5)]), normals)


def _at_random(
    count: int, rng: np.random.Generator, end: float, share: Callable[[Float64Array], Float64Array]
) -> Float64Array:
    """Numbers (count,) from 0 to `end`, each kept with its share of the largest area that an interval has there."""
    kept = np.empty(0)
    while len(kept) < count:
        some = rng.uniform(0.0, end, 2 * count)
        kept = np.concatenate([kept, some[rng.uniform(size=2 * count) < share(some)]])
    return kept[:count]


SHAPES: dict[str, Callable[[int, np.random.Generator], KnownCloud]] = {
    "sphere": sphere,
    "cylinder": cylinder,
    "edge": edge,
    "ridge": ridge,
    "corner": corner,
    "can": can,
    "torus": torus,
    "waves": waves,
}
CUSTOMARY = ("sphere", "cylinder", "edge")
"""The shapes of a comparison for which none is named; the others on request."""
