"""Clouds whose normals are known exactly: sphere, cylinder and edge, sampled at random; knows no noise."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.scanline import BoolArray, Float64Array, read_only
from scanner_service.analysis.errors import MethodRefused


@dataclass(frozen=True, slots=True)
class KnownCloud:
    """Points (n, 3) in mm with unit normals (n, 3), whose sign has no meaning."""

    name: str
    points_mm: Float64Array
    normals: Float64Array

    def __post_init__(self) -> None:
        read_only(self.points_mm)
        read_only(self.normals)


def known_cloud(name: str, points_mm: Float64Array, normals: Float64Array) -> tuple[KnownCloud, BoolArray]:
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
    return KnownCloud(name, points_mm[kept], normals[kept] / length[kept, None]), kept


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


SHAPES: dict[str, Callable[[int, np.random.Generator], KnownCloud]] = {
    "sphere": sphere,
    "cylinder": cylinder,
    "edge": edge,
}
