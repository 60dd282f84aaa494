"""Laws of exact solids under rays."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from simulators.shapes import (
    Cylinder,
    Difference,
    Polyhedron,
    Solid,
    Sphere,
    Union,
    box,
    extruded_along_x,
    half_space,
)

Points = npt.NDArray[np.float64]


def rays(n: int, seed: int) -> tuple[Points, Points]:
    """Rays from a shell of radius 30 towards points near the origin."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(n, 3))
    origins *= 30.0 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-8.0, 8.0, size=(n, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def in_box(p: Points) -> npt.NDArray[np.bool_]:
    return ((p >= (-6.0, -5.0, -4.0)) & (p <= (6.0, 5.0, 4.0))).all(axis=-1)


def in_pocket(p: Points) -> npt.NDArray[np.bool_]:
    return ((p >= (-3.0, -2.0, 0.0)) & (p <= (1.0, 2.0, 9.0))).all(axis=-1)


def in_ball(p: Points) -> npt.NDArray[np.bool_]:
    return np.linalg.norm(p - (5.0, 0.0, 4.0), axis=-1) <= 3.0


def in_hole(p: Points) -> npt.NDArray[np.bool_]:
    return (np.hypot(p[..., 0] + 4.5, p[..., 1] - 3.0) <= 1.0) & (np.abs(p[..., 2]) <= 10.0)


def in_tilted(p: Points) -> npt.NDArray[np.bool_]:
    axis = np.array([1.0, 2.0, 2.0]) / 3.0
    along = p @ axis
    return (np.linalg.norm(p - along[..., None] * axis, axis=-1) <= 2.0) & (along >= -6.0) & (along <= 6.0)


BOX = box((-6.0, -5.0, -4.0), (6.0, 5.0, 4.0))
POCKET = box((-3.0, -2.0, 0.0), (1.0, 2.0, 9.0))
BALL = Sphere((5.0, 0.0, 4.0), 3.0)
HOLE = Cylinder((-4.5, 3.0, -10.0), (-4.5, 3.0, 10.0), 1.0)
TILTED = Cylinder((-2.0, -4.0, -4.0), (2.0, 4.0, 4.0), 2.0)

SOLIDS: dict[str, tuple[Solid, Callable[[Points], npt.NDArray[np.bool_]]]] = {
    "box": (BOX, in_box),
    "ball": (BALL, in_ball),
    "cylinder": (HOLE, in_hole),
    "tilted cylinder": (TILTED, in_tilted),
    "union": (Union(BOX, BALL, TILTED), lambda p: in_box(p) | in_ball(p) | in_tilted(p)),
    "difference": (
        Difference(BOX, POCKET, BALL, HOLE),
        lambda p: in_box(p) & ~(in_pocket(p) | in_ball(p) | in_hole(p)),
    ),
    "nested": (
        Difference(Union(BOX, Difference(TILTED, BALL)), Difference(POCKET, HOLE)),
        lambda p: (in_box(p) | (in_tilted(p) & ~in_ball(p))) & ~(in_pocket(p) & ~in_hole(p)),
    ),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_the_first_hit_is_the_first_change_of_membership_along_the_ray(name: str) -> None:
    solid, contains = SOLIDS[name]
    origins, directions = rays(400, seed=1)
    distance, _ = solid.first_hit(origins, directions)
    assert np.isfinite(distance).sum() > 20
    step = 0.01
    at = np.arange(0.0, 60.0, step)
    marched = contains(origins[:, None, :] + at[None, :, None] * directions[:, None, :])
    first = np.where(marched.any(axis=1), at[marched.argmax(axis=1)], np.inf)
    # Marching may step over a corner thinner than its step: then the hit is earlier, never later.
    with np.errstate(invalid="ignore"):
        late = np.where(distance == first, 0.0, first - distance)
    assert (late > -1e-9).all()
    agree = late <= step + 1e-9
    assert agree.mean() > 0.98
    for i in np.flatnonzero(~agree):
        sliver = origins[i] + (distance[i] + np.linspace(1e-9, step, 2000))[:, None] * directions[i]
        assert contains(sliver).any()


@pytest.mark.parametrize("name", SOLIDS)
def test_a_hit_lies_between_outside_and_inside_and_its_normal_points_out(name: str) -> None:
    solid, contains = SOLIDS[name]
    origins, directions = rays(400, seed=2)
    distance, normals = solid.first_hit(origins, directions)
    hit = np.isfinite(distance)
    assert np.isnan(normals[~hit]).all()
    np.testing.assert_allclose(np.linalg.norm(normals[hit], axis=1), 1.0, atol=1e-12)
    points = origins[hit] + distance[hit, None] * directions[hit]
    assert (np.einsum("ij,ij->i", normals[hit], directions[hit]) < 0).all()
    assert not contains(points + 1e-7 * normals[hit]).any()
    assert contains(points - 1e-7 * normals[hit]).all()


def test_hits_lie_on_the_surface_to_a_billionth() -> None:
    origins, directions = rays(2000, seed=3)
    far = origins - 500.0 * directions

    distance, _ = BALL.first_hit(far, directions)
    points = (far + distance[:, None] * directions)[np.isfinite(distance)]
    np.testing.assert_allclose(np.linalg.norm(points - (5.0, 0.0, 4.0), axis=1), 3.0, atol=1e-9)

    distance, normals = HOLE.first_hit(far, directions)
    points = (far + distance[:, None] * directions)[np.isfinite(distance)]
    round_wall = np.abs(normals[np.isfinite(distance), 2]) < 0.5
    radius = np.hypot(points[:, 0] + 4.5, points[:, 1] - 3.0)
    np.testing.assert_allclose(radius[round_wall], 1.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(points[~round_wall, 2]), 10.0, atol=1e-9)

    distance, _ = BOX.first_hit(far, directions)
    points = (far + distance[:, None] * directions)[np.isfinite(distance)]
    np.testing.assert_allclose(np.abs(points / (6.0, 5.0, 4.0)).max(axis=1), 1.0, atol=1e-9)


def test_from_inside_the_ray_hits_the_wall_it_leaves_by() -> None:
    distance, normals = BOX.first_hit(np.zeros((3, 3)), np.eye(3))
    np.testing.assert_allclose(distance, [6.0, 5.0, 4.0])
    np.testing.assert_allclose(normals, np.eye(3))


def test_a_surface_behind_the_origin_is_not_hit() -> None:
    distance, normals = BOX.first_hit(np.array([[0.0, 0.0, 20.0]]), np.array([[0.0, 0.0, 1.0]]))
    assert np.isinf(distance).all()
    assert np.isnan(normals).all()


def test_faces_that_coincide_leave_no_skin_between_parts_and_over_cuts() -> None:
    down = np.array([[0.0, 0.0, -1.0]])
    flush_cut = Difference(box((-5.0, -5.0, 0.0), (5.0, 5.0, 2.0)), box((-1.0, -1.0, 1.0), (1.0, 1.0, 2.0)))
    distance, _ = flush_cut.first_hit(np.array([[0.0, 0.0, 10.0]]), down)
    assert distance[0] == pytest.approx(9.0)
    stacked = Union(box((-5.0, -5.0, 0.0), (5.0, 5.0, 2.0)), box((-1.0, -1.0, 2.0), (1.0, 1.0, 3.0)))
    distance, _ = stacked.first_hit(np.array([[0.0, 0.0, 2.5]]), down)
    assert distance[0] == pytest.approx(2.5), "the face between the two boxes is no surface"


def test_a_ray_along_a_face_neither_hits_nor_fails() -> None:
    beside = np.array([[-20.0, 0.0, 4.0 + 1e-9]])
    distance, _ = BOX.first_hit(beside, np.array([[1.0, 0.0, 0.0]]))
    assert np.isinf(distance).all()


def test_a_half_space_is_a_plane() -> None:
    rng = np.random.default_rng(4)
    normal = np.array([1.0, 2.0, -2.0]) / 3.0
    origins = rng.uniform(-5.0, 5.0, size=(50, 3)) + 40.0 * normal
    directions = -normal + rng.normal(scale=0.3, size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance, normals = half_space((0.0, 0.0, 7.0), (2.0, 4.0, -4.0)).first_hit(origins, directions)
    heights = (origins + distance[:, None] * directions - (0.0, 0.0, 7.0)) @ normal
    np.testing.assert_allclose(heights, 0.0, atol=1e-9)
    np.testing.assert_allclose(normals, np.broadcast_to(normal, (50, 3)), atol=1e-12)


def test_a_wedge_has_the_slope_of_its_outline() -> None:
    wedge = extruded_along_x([(0.0, 0.0), (4.0, 0.0), (0.0, 3.0)], (-1.0, 1.0))
    distance, normals = wedge.first_hit(np.array([[0.0, 2.0, 9.0]]), np.array([[0.0, 0.0, -1.0]]))
    assert distance[0] == pytest.approx(7.5)
    np.testing.assert_allclose(normals, [[0.0, 0.6, 0.8]], atol=1e-12)


def test_shapes_that_make_no_solid_are_refused() -> None:
    with pytest.raises(ValueError, match="counter-clockwise"):
        extruded_along_x([(0.0, 0.0), (0.0, 3.0), (4.0, 0.0)], (-1.0, 1.0))
    with pytest.raises(ValueError, match="below the high corner"):
        box((0.0, 0.0, 0.0), (1.0, -1.0, 1.0))
    with pytest.raises(ValueError, match="must differ"):
        Cylinder((1.0, 1.0, 1.0), (1.0, 1.0, 1.0), 2.0)
    with pytest.raises(ValueError, match="longer than zero"):
        Polyhedron(np.zeros((1, 3)), np.zeros(1))


def test_the_end_of_a_part_that_the_ray_misses_gives_no_normal() -> None:
    low = box((-20.0, 8.0, 0.0), (20.0, 34.0, 14.0))
    beside = box((-20.0, 34.0, 0.0), (2.0, 50.0, 14.0))  # its end lies in the same plane as that of the other
    way = np.array([-0.6, -0.8, 0.0])  # leaves by x = -20 before it comes to the other
    at = np.array([[-20.0, y, 7.0] for y in np.linspace(37.0, 46.0, 8)])
    origins = np.vstack([at - 1.5 * way, [-30.0, 20.0, 7.0]])  # and a ray through the other
    ways = np.vstack([np.broadcast_to(way, at.shape), [1.0, 0.0, 0.0]])
    for solid in (Union(low, beside), Union(beside, low)):
        distance, normals = solid.first_hit(origins, ways)
        assert distance[:-1] == pytest.approx(1.5)
        assert normals == pytest.approx(np.broadcast_to([-1.0, 0.0, 0.0], normals.shape))
