"""Graphs of unstructured points as sparse matrices; knows distances, refuses to know surfaces.

Nearest-neighbour graph <= Euclidean minimum spanning tree <= relative neighbourhood graph <= Gabriel graph <= Delaunay
graph: each is a part of the next, the last step for points in general position. All compare the same float64 squares
of lengths, so the first three steps hold to the last bit, ties included.
"""

from scanner_service.analysis.graphs.delaunay import delaunay_graph
from scanner_service.analysis.graphs.gabriel import gabriel_graph
from scanner_service.analysis.graphs.nearest_neighbour import nearest_neighbour_graph
from scanner_service.analysis.graphs.relative_neighbourhood import relative_neighbourhood_graph
from scanner_service.analysis.graphs.riemannian import riemannian_graph
from scanner_service.analysis.graphs.spanning_tree import euclidean_spanning_tree

__all__ = [
    "delaunay_graph",
    "euclidean_spanning_tree",
    "gabriel_graph",
    "nearest_neighbour_graph",
    "relative_neighbourhood_graph",
    "riemannian_graph",
]
