"""Clouds for the laws of graphs: anything at all, lattices full of ties, surfaces; and graphs as sets of edges."""

import numpy as np
from hypothesis import strategies as st


@st.composite
def any_cloud(draw, least=1, most=60):
    """Points with ties, twins, lines and planes: few distinct values, an axis now and then flattened."""
    count = draw(st.integers(least, most))
    span = draw(st.sampled_from([1, 3, 12, 1000, 10**6]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    points = rng.integers(-span, span + 1, size=(count, 3)).astype(float)
    for axis in draw(st.sets(st.integers(0, 2), max_size=2)):
        points[:, axis] = 7.0
    return points * draw(st.sampled_from([1.0, 1e-3, 0.1, 1e12]))


@st.composite
def general_cloud(draw, least=5, most=200):
    """Points in general position, in a box or near a sphere, anywhere in space."""
    count = draw(st.integers(least, most))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    points = rng.normal(size=(count, 3))
    if draw(st.booleans()):
        points *= (1 + 0.01 * rng.normal(size=(count, 1))) / np.linalg.norm(points, axis=1)[:, None]
    return points * draw(st.sampled_from([0.01, 1.0, 300.0])) + draw(st.sampled_from([0.0, 50.0, -4000.0]))


def edges(graph):
    """The edges of a symmetric sparse matrix as pairs (smaller row, larger row); stored zeros count."""
    entries = graph.tocoo()
    pairs = list(zip(entries.row.tolist(), entries.col.tolist(), strict=True))
    assert len(pairs) == len(set(pairs))
    found = {pair for pair in pairs if pair[0] < pair[1]}
    assert set(pairs) == found | {(b, a) for a, b in found}
    return found


def squares(points):
    """(n, n) squared distances, by the formula and in the order of operations that the graphs use."""
    x, y, z = ((points[:, None, axis] - points[None, :, axis]) ** 2 for axis in range(3))
    return x + y + z


def twins(points):
    """Pairs (first, later) of rows with the very same coordinates."""
    first = {}
    return {(first.setdefault(tuple(point), row), row) for row, point in enumerate(points.tolist())} - {
        (row, row) for row in range(len(points))
    }
