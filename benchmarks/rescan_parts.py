"""The parts of the rescan benchmark as meshes, each made to fail in its own way; knows no scanner and no verdict."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

_TOP = 64  # sides of a round thing


def slab(low: tuple[float, float, float], high: tuple[float, float, float]) -> trimesh.Trimesh:
    """A box between two corners."""
    mesh: trimesh.Trimesh = trimesh.creation.box(bounds=np.array([low, high]))
    return mesh


def prism_along_x(outline_yz: list[tuple[float, float]], x: tuple[float, float]) -> trimesh.Trimesh:
    """A convex outline in (y, z) drawn out along x."""
    corners = [(at, y, z) for at in x for y, z in outline_yz]
    mesh: trimesh.Trimesh = trimesh.convex.convex_hull(np.array(corners, dtype=np.float64))
    return mesh


def prism_along_y(outline_xz: list[tuple[float, float]], y: tuple[float, float]) -> trimesh.Trimesh:
    """A convex outline in (x, z) drawn out along y."""
    corners = [(x, at, z) for at in y for x, z in outline_xz]
    mesh: trimesh.Trimesh = trimesh.convex.convex_hull(np.array(corners, dtype=np.float64))
    return mesh


def join(*parts: trimesh.Trimesh) -> trimesh.Trimesh:
    """Their union."""
    mesh: trimesh.Trimesh = trimesh.boolean.union(parts, engine="manifold")
    return mesh


def cut(part: trimesh.Trimesh, *cutters: trimesh.Trimesh) -> trimesh.Trimesh:
    """The part without the cutters."""
    mesh: trimesh.Trimesh = trimesh.boolean.difference([part, *cutters], engine="manifold")
    return mesh


def wedges() -> trimesh.Trimesh:
    """Roofs whose flanks stand at 40 to 75 degrees towards the camera, and at 40 to 75 degrees along the line."""
    parts = [slab((-24.0, 0.0, -6.0), (24.0, 96.0, 0.0))]
    for number, degrees in enumerate((40.0, 50.0, 57.0, 62.0, 66.0, 70.0, 75.0)):
        run = 8.0 / np.tan(np.radians(degrees))
        y = 3.0 + 13.0 * number
        parts.append(prism_along_x([(y, -1.0), (y, 8.0), (y + 2.0, 8.0), (y + 2.0 + run * 9 / 8, -1.0)], (-20.0, -2.0)))
        parts.append(
            prism_along_y(
                [(4.0, -1.0), (4.0 + run * 9 / 8, 8.0), (6.0 + run * 9 / 8, 8.0), (6.0 + run * 9 / 4, -1.0)],
                (y, y + 9.0),
            )
        )
    return join(*parts)


def pockets() -> trimesh.Trimesh:
    """A block with a pocket, a step, thin walls, a hole right through and a dome, on a plate."""
    plate = slab((-23.0, 0.0, -6.0), (23.0, 60.0, 0.0))
    body = slab((-20.0, 8.0, -1.0), (20.0, 28.5, 14.0))
    step = slab((-20.0, 28.0, -1.0), (20.0, 34.0, 19.0))
    wall = slab((5.0, 40.0, -1.0), (17.0, 40.6, 8.0))
    along = slab((19.0, 38.0, -1.0), (19.6, 56.0, 8.0))
    dome = trimesh.creation.icosphere(subdivisions=5, radius=6.0)
    dome.apply_translation((10.0, 50.0, 0.0))
    hole = trimesh.creation.cylinder(radius=4.0, height=60.0, sections=_TOP)
    hole.apply_translation((10.0, 18.0, 0.0))
    return cut(join(plate, body, step, wall, along, dome), slab((-18.0, 11.0, 2.0), (-4.0, 25.0, 20.0)), hole)


def bowl() -> trimesh.Trimesh:
    """A plate with two round bowls, flanks at 45 degrees, deeper than a range of 8 mm below its top."""
    plate = slab((-22.0, 0.0, -20.0), (22.0, 60.0, 0.0))
    cones = []
    for x, y, radius in ((-8.0, 16.0, 12.0), (8.0, 44.0, 12.5)):
        cone = trimesh.creation.cone(radius=radius + 1.0, height=radius + 1.0, sections=96)
        cone.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))  # the tip down
        cone.apply_translation((x, y, 1.0))
        cones.append(cone)
    return cut(plate, *cones)


def waves() -> trimesh.Trimesh:
    """A gently waved plate: nothing is wrong with it but the scan."""
    x, y = np.linspace(-22.0, 22.0, 89), np.linspace(0.0, 70.0, 141)
    gx, gy = np.meshgrid(x, y, indexing="ij")
    top = np.column_stack([gx.ravel(), gy.ravel(), (1.2 * np.sin(gx / 6.0) * np.cos(gy / 7.0)).ravel()])
    bottom = top * [1.0, 1.0, 0.0] - [0.0, 0.0, 6.0]
    corner = (np.arange(88)[:, None] * 141 + np.arange(140)[None]).ravel()
    quads = np.column_stack([corner, corner + 141, corner + 142, corner + 1])
    upper = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    rim = np.concatenate(
        [np.arange(89) * 141, 88 * 141 + np.arange(1, 141), np.arange(87, -1, -1) * 141 + 140, np.arange(139, 0, -1)]
    )
    count = len(top)
    along = np.roll(rim, -1)
    skirt = np.concatenate(
        [np.column_stack([rim, rim + count, along]), np.column_stack([along, rim + count, along + count])]
    )
    mesh: trimesh.Trimesh = trimesh.Trimesh(
        np.concatenate([top, bottom]), np.concatenate([upper, upper[:, ::-1] + count, skirt])
    )
    return mesh


def ball() -> trimesh.Trimesh:
    """A ball of 24 mm over a plate: every incidence from head-on to grazing."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=12.0)
    sphere.apply_translation((0.0, 18.0, 4.0))
    return join(slab((-20.0, 0.0, -10.0), (20.0, 48.0, -4.0)), sphere)


def drawn(seed: int) -> trimesh.Trimesh:
    """A plate with six bodies and hollows drawn by chance: roofs, balls, posts, blocks, pockets, bowls and holes.

    Slopes lie between 30 and 78 degrees, everything is turned about the vertical by any angle.
    """
    rng = np.random.default_rng(seed)
    bodies, cutters = [slab((-22.0, 0.0, -14.0), (22.0, 62.0, 0.0))], list[trimesh.Trimesh]()
    for at, kind in enumerate(rng.choice(["roof", "ball", "post", "block", "pocket", "bowl", "hole"], size=6)):
        x, y = -11.0 + 22.0 * (at % 2), 11.0 + 20.0 * (at // 2)
        size, height = rng.uniform(4.0, 8.0), rng.uniform(3.0, 9.0)
        if kind == "roof":
            run = height / np.tan(np.radians(rng.uniform(30.0, 78.0, size=2)))
            run = np.minimum(run, 6.0)
            outline = [(-1.0 - run[0], -0.5), (-1.0, height), (1.0, height), (1.0 + run[1], -0.5)]
            body = prism_along_x([(float(a), float(b)) for a, b in outline], (-size, size))
        elif kind == "ball":
            body = trimesh.creation.icosphere(subdivisions=5, radius=size)
            body.apply_translation((0.0, 0.0, rng.uniform(-0.3, 0.6) * size))
        elif kind in ("post", "hole"):
            body = trimesh.creation.cylinder(radius=0.8 * size, height=2.0 * height, sections=_TOP)
            if kind == "hole":
                body = trimesh.creation.cylinder(radius=0.5 * size, height=60.0, sections=_TOP)
        elif kind == "bowl":
            body = trimesh.creation.cone(radius=size + 1.0, height=min(height, 8.0) + 1.0, sections=96)
            body.apply_transform(np.diag([1.0, -1.0, -1.0, 1.0]))
            body.apply_translation((0.0, 0.0, 1.0))
        else:
            half = rng.uniform(2.0, 7.0, size=2)
            low, high = (-0.5, height) if kind == "block" else (-height, 2.0)
            body = slab((-half[0], -half[1], low), (half[0], half[1], high))
        turn = rng.uniform(0.0, 2.0 * np.pi)
        turned = np.eye(4)
        turned[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        body.apply_transform(turned)
        body.apply_translation((x, y, 0.0))
        (cutters if kind in ("pocket", "bowl", "hole") else bodies).append(body)
    part = join(*bodies)
    return cut(part, *cutters) if cutters else part


PARTS: dict[str, Callable[[], trimesh.Trimesh]] = {
    "wedges": wedges,
    "pockets": pockets,
    "bowl": bowl,
    "waves": waves,
    "ball": ball,
}
_SCALES = {"fandisk.obj": 25.0, "gears.stl": 0.9, "featuretype.STL": 9.0}


def mesh_from(path: Path) -> trimesh.Trimesh:
    """A mesh file at the size that suits the scanner, its middle over x = 0, its near side at y = 0, half as z = 0."""
    mesh = trimesh.load_mesh(path)
    scale = _SCALES.get(path.name, 40.0 / float(np.max(mesh.extents)))
    mesh.apply_transform(np.diag([scale, scale, scale, 1.0]))
    low, high = mesh.bounds
    mesh.apply_translation(-np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2]))
    return mesh
