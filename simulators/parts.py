"""The parts that a simulated scanner can be put over, by name or from a file; knows no optics.

Part frame: x along the laser line, y the travel, z height. The base plate's top is z = 0. Every part lies within reach
of `optics.demo_scanner` when the sensor frame is moved along y only, so that stage position and part y are the same.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.scanline import Pose
from simulators.meshes import load_mesh
from simulators.shapes import Cylinder, Difference, Sphere, Surface, Union, box, extruded_along_x


@dataclass(frozen=True, slots=True)
class Part:
    """A surface to scan, and the (first, last) stage position that covers it."""

    surface: Surface
    travel_mm: tuple[float, float]
    description: str


def demo_part() -> Part:
    """Everything that makes a scan fail in places, on a plate of 46 x 60 mm, 20 mm high.

    With the demo scanner (laser above, camera on the +y side, 27 degrees): a pocket 12 mm deep, on whose floor lie the
    shadows of camera and laser; a step of 5 mm; a flank that falls along the travel, first at 45, then at 68 degrees;
    two walls 0.35 mm thick, one across the travel and one along it; a round hole right through; a dome.
    """
    plate = box((-23.0, 0.0, -6.0), (23.0, 60.0, 0.0))
    body = box((-20.0, 8.0, -1.0), (20.0, 34.0, 14.0))
    step = box((-20.0, 28.0, 13.0), (20.0, 34.0, 19.0))
    flank_foot_mm = 42.0 + 12.0 / np.tan(np.radians(68.0))
    flank = extruded_along_x(
        [(33.0, -1.0), (flank_foot_mm, -1.0), (42.0, 11.0), (34.0, 19.0), (33.0, 19.0)], x_mm=(-20.0, 2.0)
    )
    wall_across = box((5.0, 40.0, -1.0), (17.0, 40.35, 8.0))
    wall_along = box((19.0, 38.0, -1.0), (19.35, 56.0, 8.0))
    dome = Sphere((12.0, 50.0, 0.0), 6.0)
    pocket = box((-18.0, 11.0, 2.0), (-4.0, 25.0, 20.0))
    hole = Cylinder((10.0, 18.0, -10.0), (10.0, 18.0, 25.0), 4.0)
    surface = Difference(Union(plate, body, step, flank, wall_across, wall_along, dome), pocket, hole)
    return Part(surface, (-1.0, 61.0), "pocket, step, steep flank, thin walls, hole and dome on a plate")


def plate() -> Part:
    """A flat plate: the scan that has nothing to complain of."""
    return Part(box((-20.0, 0.0, -6.0), (20.0, 40.0, 0.0)), (-1.0, 41.0), "a flat plate, 40 x 40 mm")


def step() -> Part:
    """A plate with one step of 5 mm across the travel: it throws the camera's shadow."""
    surface = Union(box((-20.0, 0.0, -6.0), (20.0, 40.0, 0.0)), box((-20.0, 20.0, -6.0), (20.0, 40.0, 5.0)))
    return Part(surface, (-1.0, 41.0), "a plate with a step of 5 mm across the travel")


def sphere() -> Part:
    """A ball that hangs free: every incidence from head-on to grazing."""
    return Part(Sphere((0.0, 15.0, 0.0), 12.0), (2.0, 28.0), "a ball of 24 mm")


PARTS: dict[str, Callable[[], Part]] = {"demo": demo_part, "plate": plate, "step": step, "sphere": sphere}


def mesh_part(path: Path, scale_to_mm: float = 1.0) -> Part:
    """A mesh file set down with the middle of its width at x = 0, its near side at y = 0, half its height at z = 0.

    Raises
    ------
    simulators.meshes.MeshError : when there is no mesh to be had.
    """
    low, high = load_mesh(path, scale_to_mm).bounds_mm
    place = Pose(np.eye(3), -np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2]))
    length_mm = float(high[1] - low[1])
    return Part(load_mesh(path, scale_to_mm, place), (-1.0, length_mm + 1.0), f"the mesh {path.name}")
