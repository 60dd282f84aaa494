"""Orientation is right where a closed surface is sampled densely, and says so where it had to guess."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial import cKDTree

from scanner_service.analysis.graphs import riemannian_graph
from scanner_service.analysis.orientation import Doubt, orient_normals

REAL = Path(__file__).parents[5] / "shared" / "data" / "ground_truth_normals"


def any_sign(normals, seed=0):
    """The normals, each turned by the toss of a coin."""
    return normals * np.random.default_rng(seed).choice([-1.0, 1.0], size=(len(normals), 1))


def fitted(points, count=10):
    """Normals by a plane fit over nearest points, of any sign."""
    near = points[cKDTree(points).query(points, count)[1]]
    near = near - near.mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))[1][:, :, 0]


def ball(count, seed=0):
    """Points on the unit sphere, which are their own outward normals."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1)[:, None]


def block(count, seed=0):
    """Points on a cube, and the exact normals of its faces."""
    rng = np.random.default_rng(seed)
    points, normals = rng.uniform(-1, 1, (count, 3)), np.zeros((count, 3))
    axis, sign, every = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count), np.arange(count)
    points[every, axis] = normals[every, axis] = sign
    return points, normals


def torus(count, seed=0):
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(0, 2 * np.pi, (2, count))
    normals = np.column_stack([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)])
    return normals + 3.0 * np.column_stack([np.cos(a), np.sin(a), np.zeros(count)]), normals


def turned(seed):
    """A rotation anywhere."""
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(["ball", "block", "torus"]), st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 1.0, 5e4]))
def test_every_normal_of_a_dense_closed_surface_points_outwards(shape, seed, size_mm):
    points, truth = {"ball": lambda: (ball(2500, seed),) * 2, "block": lambda: block(4000, seed)}.get(
        shape, lambda: torus(5000, seed)
    )()
    turn = turned(seed)
    points, truth = points @ turn * size_mm + 3.0 * size_mm, truth @ turn
    found = orient_normals(points, any_sign(truth, seed))
    assert ((found.normals * truth).sum(axis=1) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, rtol=1e-12)
    assert found.components.confidence[0] > (0.95 if shape == "block" else 0.99)  # at a sharp edge fewer links tell


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.01))
def test_fitted_normals_of_a_noisy_ball_are_all_turned_outwards(seed, noise):
    truth = ball(3000, seed)
    points = truth * (1.0 + noise * np.random.default_rng(seed).normal(size=(len(truth), 1)))
    found = orient_normals(points, fitted(points, 16))
    assert ((found.normals * truth).sum(axis=1) > 0).all()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_neither_signs_given_nor_order_of_points_matter(seed):
    points, truth = block(1500, seed)
    first = orient_normals(points, any_sign(truth, seed))
    order = np.random.default_rng(seed).permutation(len(points))
    second = orient_normals(points[order], any_sign(truth[order], seed + 1))
    np.testing.assert_array_equal(first.normals[order], second.normals)
    np.testing.assert_array_equal(first.sure[order], second.sure)


def test_the_plain_method_is_hoppe_s_written_out_with_scipy():
    points = ball(800, 4) * [3.0, 2.0, 1.0]
    normals = any_sign(fitted(points), 4)
    graph = riemannian_graph(points, 8).tocoo()
    cost = 1.0 - np.abs((normals[graph.row] * normals[graph.col]).sum(axis=1))
    tree = minimum_spanning_tree(csr_array((cost + 1e-9, (graph.row, graph.col)), shape=graph.shape))
    order, before = breadth_first_order(tree + tree.T, int(points[:, 2].argmax()), directed=False)
    truth = normals.copy()
    truth[order[0]] *= np.sign(truth[order[0], 2])
    for i in order[1:]:
        truth[i] *= np.sign(truth[i] @ truth[before[i]])
    found = orient_normals(points, normals, plain=True).normals
    np.testing.assert_array_equal(np.sign((found * truth).sum(axis=1)), 1.0)


def test_separate_bodies_are_components_of_their_own_each_turned_outwards():
    sphere = ball(2000)
    points = np.concatenate([sphere, sphere[:900] * 0.5 + [0, 9, 0], sphere[:400] * 0.3 - [7, 0, 20]])
    truth = np.concatenate([sphere, sphere[:900], sphere[:400]])
    found = orient_normals(points, any_sign(truth))
    assert found.components.points.tolist() == [2000, 900, 400]
    assert found.component.tolist() == [0] * 2000 + [1] * 900 + [2] * 400
    assert ((found.normals * truth).sum(axis=1) > 0).all()
    assert found.sure.all()
    assert points[found.components.start_row, 2] == pytest.approx([1.0, 0.5, -19.7], abs=0.01)


def test_one_side_of_a_part_is_turned_up_and_called_a_guess():
    points = ball(4000)
    points = points[points[:, 2] > 0.2]
    found = orient_normals(points, any_sign(points))
    assert found.normals[found.components.start_row[0], 2] > 0
    assert not found.sure.any()
    assert found.components.confidence[0] == 0.5
    assert found.components.doubt[0] & Doubt.OPEN
    assert "open surface" in found.components.warning(0)


def test_two_sheets_that_face_each_other_are_not_silently_half_wrong():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 20, (6000, 2)), rng.choice([0.0, -0.8], 6000)])
    truth = np.where(points[:, 2:] < -0.4, -1.0, 1.0) * [0.0, 0.0, 1.0]
    found = orient_normals(points, any_sign(truth))
    assert ((found.normals * truth).sum(axis=1) > 0).all()  # the mirror rule's guess
    assert not found.sure.any()
    assert found.components.confidence[0] < 0.8
    plain = orient_normals(points, any_sign(truth), plain=True)
    assert (plain.normals[:, 2] > 0).all()  # every second one is wrong
    assert not plain.sure.any()


def test_a_hollow_inside_a_body_is_a_guess_and_the_body_is_not():
    sphere = ball(3000)
    found = orient_normals(np.concatenate([sphere, sphere * 0.5]), any_sign(np.concatenate([sphere, sphere])))
    doubts = found.components.doubt.tolist()
    assert sorted(doubts) == [0, int(Doubt.ENCLOSED)]
    assert (found.sure == (found.component == doubts.index(0))).all()
    beside = orient_normals(np.concatenate([sphere, sphere * 0.1 + 0.9]), np.concatenate([sphere, sphere]))
    assert beside.sure.all()  # within the other's box, yet outside


def test_a_surface_with_one_side_only_is_never_sure():
    rng = np.random.default_rng(1)
    turn, across = rng.uniform(0, 2 * np.pi, 6000), rng.uniform(-0.4, 0.4, 6000)

    def place(t, w):
        radius = 1 + w * np.cos(t / 2)
        return np.column_stack([radius * np.cos(t), radius * np.sin(t), w * np.sin(t / 2)])

    points = place(turn, across)
    normals = np.cross(place(turn + 1e-5, across) - points, place(turn, across + 1e-5) - points)
    found = orient_normals(points, normals)
    assert not found.sure.any()
    assert found.components.disagreeing[0] > 0


def test_outliers_are_small_components_of_their_own():
    sphere = ball(2000)
    points = np.concatenate([sphere, [[1e9, 0, 0], [0, 0, 50.0]]])
    found = orient_normals(points, np.concatenate([any_sign(sphere), [[0, 0, 1.0], [1.0, 0, 0]]]))
    assert found.components.points.tolist() == [2000, 1, 1]
    assert found.sure.tolist() == [True] * 2000 + [False] * 2
    assert found.components.doubt.tolist() == [0, Doubt.SMALL, Doubt.SMALL]
    assert ((found.normals[:2000] * sphere).sum(axis=1) > 0).all()


def test_points_without_a_place_or_a_normal_are_left_out_and_counted():
    points, normals = ball(1000), ball(1000).copy()
    points = points.copy()
    points[3], normals[5], normals[6], normals[7] = np.nan, np.nan, 0.0, np.inf
    found = orient_normals(points, normals)
    assert found.left_out == {"not_finite": 1, "no_normal": 3}
    assert np.flatnonzero(found.component < 0).tolist() == [3, 5, 6, 7]
    assert np.isnan(found.normals[[3, 5, 6, 7]]).all()
    assert not found.sure[[3, 5, 6, 7]].any()


def test_identical_points_are_turned_together():
    sphere = ball(1500)
    found = orient_normals(np.concatenate([sphere] * 3), any_sign(np.concatenate([sphere] * 3)))
    assert ((found.normals * np.concatenate([sphere] * 3)).sum(axis=1) > 0).all()
    assert found.sure.all()
    same = orient_normals(np.zeros((50, 3)), any_sign(np.tile([0.0, 0.6, 0.8], (50, 1))))
    np.testing.assert_allclose(same.normals, np.tile([0.0, 0.6, 0.8], (50, 1)))
    assert not same.sure.any()


@settings(max_examples=150, deadline=None)
@given(
    st.integers(1, 40),
    st.integers(0, 2**32 - 1),
    st.sampled_from([1.0, 1e-30, 1e50]),
    st.sets(st.integers(0, 2), max_size=2),
)
def test_any_points_and_normals_give_unit_normals_or_nan(count, seed, size, flat):
    rng = np.random.default_rng(seed)
    points = rng.integers(-3, 4, (count, 3)) * size
    points[:, sorted(flat)] = 0.0
    normals = rng.integers(-1, 2, (count, 3)).astype(float)
    normals[0] = [0, 0, 1]
    found = orient_normals(points, normals, neighbours=int(rng.integers(1, 50)))
    given_one = normals.any(axis=1)
    np.testing.assert_allclose(np.linalg.norm(found.normals[given_one], axis=1), 1.0, rtol=1e-12)
    assert np.isnan(found.normals[~given_one]).all()
    assert ((found.components.confidence >= 0.5) & (found.components.confidence <= 1.0)).all()
    assert found.components.points.sum() <= given_one.sum()


@pytest.mark.parametrize(
    ("points", "normals", "options", "said"),
    [
        (np.zeros((3, 2)), np.zeros((3, 2)), {}, r"shape \(n, 3\)"),
        (np.eye(3), np.eye(3)[:2], {}, r"shape \(n, 3\)"),
        (np.eye(3), np.full((3, 3), np.nan), {}, "nothing to orient"),
        (np.empty((0, 3)), np.empty((0, 3)), {}, "nothing to orient"),
        (np.eye(3), np.eye(3), {"neighbours": 0}, "1 neighbour or more"),
        (np.eye(3), np.eye(3), {"gap_factor": 0.0}, "greater than 0"),
    ],
)
def test_what_cannot_be_oriented_is_refused_in_one_sentence(points, normals, options, said):
    with pytest.raises(ValueError, match=said):
        orient_normals(points, normals, **options)


@pytest.mark.parametrize("name", ["vase", "fandisk"])
def test_sampled_parts_with_reference_normals(name):
    file = REAL / f"{name}.xyz"
    if not file.exists():
        pytest.skip(f"{file.name} with reference normals is not here")
    table = np.loadtxt(file)
    points, truth = table[:, :3], table[:, 3:6]
    found = orient_normals(points, any_sign(truth))
    right = (found.normals * truth).sum(axis=1) > 0
    assert right.mean() > 0.9995
    assert right[found.sure].all()
    assert found.components.confidence[0] > 0.97
