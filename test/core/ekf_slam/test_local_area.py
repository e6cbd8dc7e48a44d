"""Local area: features stored at the robot's node and at nodes ahead."""

import math
from itertools import pairwise

import numpy as np
import pytest

from thinmap_ros.core.ekf_slam.feature_map import LocalArea
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap

AHEAD = math.pi / 2.0


def corridor(*xs):
    """A map of nodes 1, 2, ... along a line, one edge from each to the next."""
    nodes = [Node(i + 1, NodeKind.BRANCH, x, 0.0, 1.0) for i, x in enumerate(xs)]
    edges = [
        Edge(100 + i, i + 1, i + 2, np.array([[a, 0.0], [b, 0.0]]), b - a, 1.0)
        for i, (a, b) in enumerate(pairwise(xs))
    ]
    return TopologicalMap(nodes, edges)


def stored(area, *xs):
    """Feature 10 i, observed at the i-th position, i from 1."""
    for i, x in enumerate(xs):
        area.store(np.array([x, 0.0, 0.0]), [10 * (i + 1)])


@pytest.fixture
def area():
    result = LocalArea()
    result.set_topology(corridor(0.0, 5.0, 10.0, 15.0))
    stored(result, 0.0, 5.0, 10.0, 15.0)
    return result


def test_the_node_of_the_robot_and_those_ahead_but_none_behind(area):
    assert area.features_near(np.array([5.2, 0.3, 0.0]), AHEAD) == {20, 30}
    assert area.features_near(np.array([5.2, 0.3, math.pi]), AHEAD) == {10, 20}


def test_a_laser_that_sees_all_round_has_no_behind(area):
    assert area.features_near(np.array([5.2, 0.3, 0.0]), math.pi) == {10, 20, 30}


def test_of_two_nodes_about_as_near_the_one_ahead(area):
    middle = np.array([7.5, 0.0, 0.0])
    assert area.features_near(middle, AHEAD) == {20, 30, 40} - {20}
    assert area.features_near(middle + [0.0, 0.0, math.pi], AHEAD) == {10, 20}


def test_no_edge_no_neighbour(area):
    topology = corridor(0.0, 5.0, 10.0, 15.0)
    topology.drop_edge(101)
    area.set_topology(topology)
    assert area.features_near(np.array([5.2, 0.3, 0.0]), AHEAD) == {20}


def test_features_of_a_node_that_goes_are_handed_on(area):
    topology = corridor(0.0, 5.0, 10.0, 15.0)
    area.set_topology(topology)
    assert area.features_near(np.array([0.0, 0.0, 0.0]), AHEAD) == {10, 20}
    topology.drop_node(2)
    topology.put_node(Node(7, NodeKind.BRANCH, 5.5, 0.2, 1.0))
    assert area.features_near(np.array([5.0, 0.0, 0.0]), AHEAD) == {20}
    assert area.nodes_of(20) == [7]


def test_features_of_a_node_that_moved_are_handed_on_where_it_was_last():
    area = LocalArea()
    for topology in (corridor(0.0, 4.0, 10.0), corridor(0.0, 8.0, 10.0)):
        area.set_topology(topology)
        area.store(np.array([topology.nodes[2].x, 0.0, 0.0]), [20])
        assert area.nodes_of(20) == [2]
    without = corridor(0.0, 8.0, 10.0)
    without.drop_node(2)
    area.set_topology(without)
    area.features_near(np.zeros(3), AHEAD)
    assert area.nodes_of(20) == [3]


def test_features_of_a_node_that_goes_at_once_are_handed_on_where_it_was():
    area = LocalArea()
    area.set_topology(corridor(0.0, 4.0, 10.0))
    area.store(np.array([4.0, 0.0, 0.0]), [20])
    without = corridor(0.0, 4.0, 10.0)
    without.drop_node(2)
    area.set_topology(without)
    area.features_near(np.array([10.0, 0.0, 0.0]), AHEAD)
    assert area.nodes_of(20) == [1]


def test_merged_and_dropped_features(area):
    area.remove(10, heir=30)
    assert area.nodes_of(30) == [1, 3]
    area.remove(30)
    assert area.features_near(np.array([0.0, 0.0, 0.0]), AHEAD) == {20}
    assert area.nodes_of(30) == []


def test_without_a_topology_nodes_are_placed_along_the_path():
    area = LocalArea()
    xs = np.arange(0.0, 20.0, 0.5)
    stored(area, *xs)
    near = area.features_near(np.array([10.0, 0.0, 0.0]), AHEAD)
    places = sorted(0.05 * i - 0.5 for i in near)
    assert 8.0 <= places[0] <= 11.0
    # The nodes ahead, up to 8 m along edges, and what was seen from 3 m beyond them.
    assert 16.0 <= places[-1] <= 10.0 + 11.0
    # A topology adopts the features of the path's nodes.
    area.set_topology(corridor(0.0, 10.0, 20.0))
    assert area.features_near(np.array([10.0, 0.0, 0.0]), math.pi) == {
        10 * (i + 1) for i in range(len(xs))
    }


def test_without_any_node_there_is_no_area():
    assert LocalArea().features_near(np.zeros(3), AHEAD) == set()
