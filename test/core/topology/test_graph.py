"""The map of nodes and edges."""

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap


def edge(number, a, b, *points):
    return Edge(number, a, b, np.array(points, dtype=float), 1.0, 0.5)


@pytest.fixture
def triangle():
    nodes = [Node(k, NodeKind.END, float(k), 0.0, 0.5) for k in (1, 2, 3, 9)]
    edges = [
        edge(4, 1, 2, (1, 0), (2, 0)),
        edge(5, 1, 2, (1, 0), (1.5, 1), (2, 0)),
        edge(6, 3, 3, (3, 0), (3, 1), (3, 0)),
    ]
    return TopologicalMap(nodes, edges)


def test_parallel_edges_and_loops(triangle):
    assert [e.id for e in triangle.edges_at(1)] == [4, 5]
    assert triangle.neighbours(1) == [2]
    assert triangle.neighbours(3) == [3] and [e.id for e in triangle.edges_at(3)] == [6]
    assert triangle.components()[0] == {1, 2} and len(triangle.components()) == 3


def test_nearest(triangle):
    assert triangle.nearest_node(2.2, 0.3).id == 2
    number, index, distance = triangle.nearest_edge_point(1.5, 1.2)
    assert (number, index) == (5, 1) and distance == pytest.approx(0.2)
    assert TopologicalMap().nearest_node(0, 0) is None and TopologicalMap().nearest_edge_point(0, 0) is None


def test_paths_from_either_end(triangle):
    passage = triangle.edges[5]
    assert passage.other(1) == 2 and passage.other(2) == 1
    assert np.array_equal(passage.path_from(2), passage.path[::-1])


def test_dropping_a_node_drops_its_edges(triangle):
    kept = triangle.copy()
    triangle.drop_node(1)
    assert set(triangle.edges) == {6} and 1 not in triangle.nodes and triangle.edges_at(2) == []
    assert set(kept.edges) == {4, 5, 6}


def test_ids_are_positive_and_unique(triangle):
    with pytest.raises(InputError, match='node id 4'):
        triangle.put_node(Node(4, NodeKind.END, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match='edge id 1'):
        triangle.put_edge(edge(1, 2, 3, (0, 0)))
    with pytest.raises(InputError, match='node id 0'):
        triangle.put_node(Node(0, NodeKind.END, 0.0, 0.0, 0.0))
    with pytest.raises(InputError, match='nodes of the map'):
        triangle.put_edge(edge(7, 1, 77, (0, 0)))
