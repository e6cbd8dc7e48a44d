import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core.planning.paths import (
    path_lengths_to_nodes,
    shortest_path,
    shortest_route,
)
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap


def node(number, x, y):
    return Node(number, NodeKind.BRANCH, x, y, 1.0)


def edge(number, a, b, points):
    path = np.array(points, dtype=np.float64)
    return Edge(number, a, b, path, float(np.hypot(*np.diff(path, axis=0).T).sum()), 1.0)


def square():
    """Corners 1 (0, 0), 2 (4, 0), 3 (4, 3), 4 (0, 3); no edge from 4 to 1; 5 is isolated."""
    nodes = [node(1, 0, 0), node(2, 4, 0), node(3, 4, 3), node(4, 0, 3), node(5, 9, 9)]
    corners = {n.id: (n.x, n.y) for n in nodes}
    edges = [
        edge(10 + i, a, b, np.linspace(corners[a], corners[b], 9))
        for i, (a, b) in enumerate([(1, 2), (3, 2), (3, 4)])
    ]
    return TopologicalMap(nodes, edges)


def test_route_over_the_square():
    route = shortest_path(square(), 1, 4)
    assert route.node_ids == (1, 2, 3, 4)
    assert route.edge_ids == (10, 11, 12)
    assert route.cost_m == pytest.approx(11.0)


def test_a_route_to_itself_and_one_that_does_not_exist():
    assert shortest_path(square(), 2, 2).cost_m == 0.0
    assert shortest_path(square(), 1, 5) is None


@given(st.integers(2, 9), st.integers(0, 2**32 - 1))
def test_costs_equal_floyd_and_warshall_s(count, seed):
    rng = np.random.default_rng(seed)
    places = rng.uniform(0.0, 10.0, (count, 2))
    nodes = [node(i + 1, *places[i]) for i in range(count)]
    pairs = [pair for pair in itertools.product(range(count), repeat=2) if rng.random() < 0.3]
    edges = [
        edge(
            100 + k,
            a + 1,
            b + 1,
            [places[a], (places[a] + places[b]) / 2 + rng.uniform(-1, 1, 2), places[b]],
        )
        for k, (a, b) in enumerate(pairs)
    ]
    best = np.where(np.eye(count, dtype=bool), 0.0, np.inf)
    for e in edges:
        best[e.a - 1, e.b - 1] = best[e.b - 1, e.a - 1] = min(best[e.a - 1, e.b - 1], e.length_m)
    for k in range(count):
        best = np.minimum(best, best[:, k : k + 1] + best[k : k + 1])
    topology = TopologicalMap(nodes, edges)
    for a, b in itertools.product(range(count), repeat=2):
        route = shortest_path(topology, a + 1, b + 1)
        assert (np.inf if route is None else route.cost_m) == pytest.approx(best[a, b])


def test_a_route_between_points_uses_the_cheapest_ends_and_no_avoided_edge():
    route = shortest_route(square(), {1: 1.0, 2: 3.0}, {3: 2.0, 4: 1.0}, (1.0, 3.0))
    assert (route.node_ids, route.edge_ids) == ((2, 3), (11,))
    assert route.cost_m == pytest.approx(8.0)
    assert shortest_route(square(), {1: 1.0}, {3: 1.0}, (4.0, 3.0), {11}) is None


def test_costs_from_a_point_reach_what_is_joined():
    costs = path_lengths_to_nodes(square(), 1.0, 0.25)
    assert costs == pytest.approx({1: 1.25, 2: 3.25, 3: 6.25, 4: 10.25})


def test_a_loop_is_left_by_the_shorter_side():
    ring = [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1), (0, 0)]
    topology = TopologicalMap([node(1, 0, 0)], [edge(2, 1, 1, ring)])
    assert path_lengths_to_nodes(topology, 1.0, 1.0) == pytest.approx({1: 2.0})


def test_a_map_without_edges_and_an_empty_one():
    lone = TopologicalMap([node(7, 1.0, 1.0)])
    assert path_lengths_to_nodes(lone, 1.0, 3.0) == {7: 2.0}
    assert path_lengths_to_nodes(TopologicalMap(), 0.0, 0.0) == {}
