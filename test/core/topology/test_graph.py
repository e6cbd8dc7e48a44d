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
    assert (
        TopologicalMap().nearest_node(0, 0) is None
        and TopologicalMap().nearest_edge_point(0, 0) is None
    )


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


def test_the_nearest_node_is_the_nearest_of_all_however_far():
    rng = np.random.default_rng(0)
    places = np.vstack([rng.uniform(-30.0, 30.0, (200, 2)), [[500.0, 0.0]]])
    topology = TopologicalMap(
        Node(k + 1, NodeKind.END, x, y, 0.5) for k, (x, y) in enumerate(places.tolist())
    )
    for x, y in np.vstack(
        [rng.uniform(-80.0, 80.0, (100, 2)), [[300.0, 10.0], [-2000.0, 0.0]]]
    ).tolist():
        assert topology.nearest_node(x, y).id == 1 + int(
            ((places - (x, y)) ** 2).sum(axis=1).argmin()
        )
        assert {n.id for n in topology.nodes_near(x, y, 9.0)} >= {
            k + 1 for k in np.flatnonzero(np.hypot(*(places - (x, y)).T) <= 9.0).tolist()
        }
    for k in range(200):
        topology.drop_node(k + 1)
    assert topology.nearest_node(0.0, 0.0).id == 201
