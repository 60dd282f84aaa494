"""Graphs agree with their definitions, written out over all points, and lie within each other as they must."""

from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from scanner_service.analysis.graphs import (
    delaunay_graph,
    euclidean_spanning_tree,
    gabriel_graph,
    nearest_neighbour_graph,
    relative_neighbourhood_graph,
    riemannian_graph,
)
from tests.unit.analysis.graphs.clouds import any_cloud, edges, general_cloud, squares, twins

ALL = (
    nearest_neighbour_graph,
    euclidean_spanning_tree,
    relative_neighbourhood_graph,
    gabriel_graph,
    delaunay_graph,
    riemannian_graph,
)


def firsts(points):
    """Rows of the first point of each place."""
    return sorted(set(range(len(points))) - {later for _, later in twins(points)})


def empty_pairs(points, is_between):
    """Pairs of places with no place between them, and the twins."""
    rows, square = firsts(points), squares(points)
    return {
        (i, j)
        for i, j in combinations(rows, 2)
        if not any(is_between(square, i, j, k) for k in rows if k not in (i, j))
    } | twins(points)


@settings(max_examples=60, deadline=None)
@given(any_cloud())
def test_nearest_neighbours_are_those_found_by_looking_at_all(points):
    square = squares(points)
    np.fill_diagonal(square, np.inf)
    truth = {tuple(sorted((i, int(np.argmin(square[i]))))) for i in range(len(points)) if len(points) > 1}
    assert edges(nearest_neighbour_graph(points)) == truth


@settings(max_examples=60, deadline=None)
@given(any_cloud())
def test_the_spanning_tree_is_the_one_that_kruskal_finds(points):
    square = squares(points)
    parent = list(range(len(points)))

    def group(i):
        while parent[i] != i:
            i = parent[i]
        return i

    truth = set()
    for i, j in sorted(combinations(range(len(points)), 2), key=lambda pair: (square[pair], pair)):
        if group(i) != group(j):
            parent[group(i)] = group(j)
            truth.add((i, j))
    assert edges(euclidean_spanning_tree(points)) == truth


@settings(max_examples=30, deadline=None)
@given(any_cloud(most=18))
def test_relative_neighbours_have_an_empty_lune(points):
    truth = empty_pairs(points, lambda square, i, j, k: max(square[i, k], square[j, k]) < square[i, j])
    assert edges(relative_neighbourhood_graph(points)) == truth


@settings(max_examples=30, deadline=None)
@given(any_cloud(most=18))
def test_gabriel_neighbours_have_an_empty_ball(points):
    truth = empty_pairs(points, lambda square, i, j, k: square[i, k] + square[k, j] < square[i, j])
    assert edges(gabriel_graph(points)) == truth


@settings(max_examples=60, deadline=None)
@given(any_cloud(), st.integers(1, 70))
def test_the_riemannian_graph_is_the_tree_and_the_nearest_of_all(points, neighbours):
    rows, square = firsts(points), squares(points)
    truth = edges(euclidean_spanning_tree(points))
    for i in rows:
        nearest = sorted((row for row in rows if row != i), key=lambda row: (square[i, row], row))
        truth |= {tuple(sorted((i, j))) for j in nearest[:neighbours]}
    assert edges(riemannian_graph(points, neighbours)) == truth


@settings(max_examples=30, deadline=None)
@given(general_cloud())
def test_each_graph_is_part_of_the_next(points):
    chain = [edges(graph(points)) for graph in ALL[:5]]
    for smaller, larger in pairwise(chain):
        assert smaller <= larger


@settings(max_examples=60, deadline=None)
@given(any_cloud())
@example(np.zeros((40, 3)))
def test_with_ties_and_twins_the_chain_holds_up_to_the_gabriel_graph(points):
    chain = [edges(graph(points)) for graph in ALL[:4]]
    for smaller, larger in pairwise(chain):
        assert smaller <= larger
    assert len(chain[1]) == len(points) - 1


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 3000), st.integers(0, 2**32 - 1), st.sampled_from(["box", "lines", "clusters", "grid"]))
def test_the_spanning_tree_of_larger_clouds_weighs_what_scipy_finds(count, seed, kind):
    rng = np.random.default_rng(seed)
    points = rng.random((count, 3))
    if kind == "lines":  # nearest neighbours all lie along the line
        points = np.column_stack([rng.random(count) * 10, rng.integers(0, 9, count) * 3.0, np.zeros(count)])
    elif kind == "clusters":
        points = rng.integers(0, 5, (count, 3)) * 100.0 + points
    elif kind == "grid":
        points = rng.integers(0, 12, (count, 3)).astype(float)
    tree = euclidean_spanning_tree(points)
    assert tree.nnz == 2 * (count - 1)
    assert connected_components(tree, directed=False)[0] == 1
    some = points[: min(count, 700)]
    dense = np.sqrt(squares(some)) + 1.0  # a length of 0 would be no edge there
    truth = minimum_spanning_tree(np.triu(dense, 1)).sum() - (len(some) - 1)
    assert euclidean_spanning_tree(some).sum() / 2 == pytest.approx(truth, rel=1e-9, abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(general_cloud(), st.integers(2, 3))
def test_threads_change_nothing(points, threads):
    points = np.concatenate([points, points[:3]])
    for graph in (nearest_neighbour_graph, euclidean_spanning_tree, gabriel_graph, riemannian_graph):
        assert (graph(points) != graph(points, threads=threads)).nnz == 0


@settings(max_examples=30, deadline=None)
@given(general_cloud(), st.integers(0, 2**32 - 1))
def test_the_order_of_the_points_only_renumbers_the_edges(points, seed):
    order = np.random.default_rng(seed).permutation(len(points))
    for graph in ALL:
        renumbered = {tuple(sorted((order[i], order[j]))) for i, j in edges(graph(points[order]))}
        assert renumbered == edges(graph(points)), graph.__name__


@pytest.mark.parametrize("graph", ALL)
def test_the_values_are_the_lengths(graph):
    points = np.random.default_rng(3).normal(size=(80, 3))
    entries = graph(points).tocoo()
    truth = np.linalg.norm(points[entries.row] - points[entries.col], axis=1)
    np.testing.assert_allclose(entries.data, truth, rtol=1e-12)


@pytest.mark.parametrize("graph", ALL)
def test_clouds_that_are_no_cloud_are_refused_in_one_sentence(graph):
    with pytest.raises(ValueError, match="holds no points"):
        graph(np.empty((0, 3)))
    with pytest.raises(ValueError, match=r"shape \(n, 3\)"):
        graph(np.zeros((4, 2)))
    for bad in (np.nan, np.inf, 1e200):
        with pytest.raises(ValueError, match="1 of 3 points are not finite"):
            graph([[0, 0, 0], [1, bad, 0], [1, 1, 1]])


@pytest.mark.parametrize("graph", ALL)
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_a_handful_of_points_is_a_graph_too(graph, count):
    points = np.random.default_rng(count).normal(size=(count, 3))
    found = graph(points)
    assert found.shape == (count, count)
    assert connected_components(found, directed=False)[0] == 1 or graph is nearest_neighbour_graph


def test_no_neighbours_at_all_are_refused():
    with pytest.raises(ValueError, match="1 neighbour or more"):
        riemannian_graph(np.eye(3), 0)


@settings(max_examples=30, deadline=None)
@given(general_cloud(most=60), st.sampled_from([1, 2]))
def test_flat_and_straight_clouds_have_a_delaunay_graph(points, flat):
    points[:, 3 - flat :] = 5.0
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    found = edges(delaunay_graph(points @ turn))
    assert edges(relative_neighbourhood_graph(points)) <= found
    if flat == 2:
        assert len(found) == len(points) - 1
    else:
        assert len(found) <= 3 * len(points) - 3  # Euler: what a planar graph can have


@pytest.mark.parametrize("distance_mm", [1e3, 1e4, 1e6, 1e9, 1e15])
def test_a_far_outlier_is_either_in_the_triangulation_or_refused(distance_mm):
    points = np.concatenate([np.random.default_rng(0).random((300, 3)), [[distance_mm, 0.0, 0.0]]])
    gabriel = edges(gabriel_graph(points))
    try:
        found = edges(delaunay_graph(points))
    except ValueError as error:
        assert "far outlier" in str(error)
        assert distance_mm > 1e4
    else:
        assert gabriel <= found


def test_cospherical_points_have_a_triangulation_with_the_spanning_tree_in_it():
    lattice = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3)
    assert edges(relative_neighbourhood_graph(lattice)) <= edges(delaunay_graph(lattice))
