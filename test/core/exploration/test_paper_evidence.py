"""Evidence of the paper: which views count, and to which end node evidence belongs."""

import math

import numpy as np
import pytest

from thinmap_ros.core.exploration.paper import (
    PRIOR,
    PaperConfig,
    PaperEndNode,
    PaperEndNodes,
    angle_index,
    distance_index,
)
from thinmap_ros.core.topology.graph import Node, NodeKind

CONFIG = PaperConfig()


def laser_at(x, y):
    return np.array([x, y, 0.0])


def evidence_at(place=(5.0, 0.0)):
    return PaperEndNode(1, place, place)


def test_a_robot_that_stands_still_learns_nothing_new():
    evidence = evidence_at()
    assert evidence.add_view(laser_at(0.0, 0.0), CONFIG)
    assert not evidence.add_view(laser_at(0.1, 0.0), CONFIG)
    assert evidence.add_view(laser_at(0.6, 0.0), CONFIG)
    assert evidence.add_view(laser_at(4.9, 0.05), CONFIG)
    assert evidence.add_view(laser_at(4.95, -0.05), CONFIG), 'the bearing has turned'
    assert len(evidence.views) == 4


def test_the_indices_come_from_the_nearest_view_and_the_widest_angle():
    evidence = evidence_at()
    assert evidence.reliability == evidence.distance_index == evidence.angle_index == 0.0
    for laser in (laser_at(0.0, 0.0), laser_at(5.0, -3.0), laser_at(9.0, 0.0)):
        evidence.add_view(laser, CONFIG)
    assert evidence.min_distance_m == pytest.approx(3.0)
    assert evidence.angle_span_deg == pytest.approx(180.0)
    assert evidence.distance_index == distance_index(3.0)
    assert evidence.reliability == evidence.angle_index == angle_index(180.0)


def followed(store, *places):
    nodes = [Node(i, NodeKind.END, x, y, 1.0) for i, (x, y) in enumerate(places)]
    return store.follow(nodes, CONFIG.node_reset_distance_m)


def test_a_place_that_moves_a_little_keeps_its_evidence_and_one_that_moves_on_loses_it():
    store = PaperEndNodes()
    (evidence,) = followed(store, (5.0, 0.0))
    evidence.add_view(laser_at(0.0, 0.0), CONFIG)
    evidence.visits = 1
    evidence.probability = 0.8
    assert followed(store, (5.3, 0.0)) == [evidence]
    assert evidence.views and evidence.visits == 1 and evidence.probability == 0.8
    assert followed(store, (5.7, 0.0)) == [evidence]
    assert not evidence.views and evidence.visits == 0 and evidence.probability == PRIOR
    (other,) = followed(store, (7.0, 0.0))
    assert other is not evidence


def test_evidence_is_inherited_once_and_by_the_nearest_place_in_reach():
    store = PaperEndNodes()
    (first,) = followed(store, (0.0, 0.0))
    found = followed(store, (0.1, 0.0), (0.2, 0.0))
    assert found[0] is first and found[1] is not first


def test_what_was_visited_is_remembered_while_it_is_no_candidate():
    store = PaperEndNodes()
    visited, seen = followed(store, (0.0, 0.0), (5.0, 0.0))
    visited.visits = 2
    followed(store)
    again = followed(store, (0.1, 0.0), (5.0, 0.0))
    assert again[0] is visited
    assert again[1] is not seen


def test_bearings_wrap_around():
    evidence = evidence_at((0.0, 0.0))
    evidence.add_view(laser_at(5.0, 0.1), CONFIG)
    evidence.add_view(laser_at(4.0, -0.1), CONFIG)
    assert evidence.angle_span_deg == pytest.approx(
        math.degrees(math.atan2(0.1, 5.0) + math.atan2(0.1, 4.0))
    )
