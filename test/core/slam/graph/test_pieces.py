"""Pieces of map: what is mapped at an unknown place, until matches tell where it is."""

import numpy as np
import pytest

from thinmap_ros.core.scan import Scan
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.loop_closure import Pieces
from thinmap_ros.core.slam.graph.pose_graph import Edge

SCAN = Scan.create(1, np.ones(3), 0.0, 0.1, 0.05, 8.0, np.zeros(3))


def frame(submap, x):
    return Keyframe(SCAN, np.zeros((0, 5)), np.array([x, 0.0, 0.0]), 0.0, np.eye(3), submap)


def edge(a, b, x=0.0):
    return Edge(a, b, np.array([x, 0.0, 0.0]), np.eye(3) / 0.1**2, True)


def test_a_new_submap_is_apart_until_a_pose_in_the_map_is_given():
    pieces = Pieces()
    assert not pieces.is_apart
    pieces.begin()
    assert pieces.is_apart and pieces.current == 1
    assert not pieces.is_here(0) and pieces.is_published(0) and not pieces.is_published(1)
    pieces.return_to_published()
    assert not pieces.is_apart and pieces.current == 2
    assert pieces.is_here(0) and not pieces.is_here(1)
    pieces.return_to_published()
    assert pieces.current == 2, 'it was there already'


@pytest.mark.parametrize(('step_m', 'joins'), [(1.0, False), (3.0, True)])
def test_as_many_matches_as_close_a_loop_join_pieces_if_each_is_of_another_view(step_m, joins):
    pieces = Pieces()
    pieces.begin()
    frames = [frame(0, 0.0), *(frame(1, 50.0 + step_m * k) for k in range(5))]
    for k in range(5):
        assert pieces.take_edges(frames, 5) == []
        pieces.add_match(edge(0, 1 + k, step_m * k))
    edges = pieces.take_edges(frames, 5)
    assert bool(edges) == joins
    pieces.join(frames, edges)
    assert pieces.is_apart != joins


def test_matches_that_do_not_agree_or_are_with_several_pieces_join_nothing():
    pieces = Pieces()
    pieces.begin()
    pieces.begin()
    frames = [frame(0, 0.0), frame(1, 9.0), *(frame(2, 50.0 + 3.0 * k) for k in range(6))]
    for k in range(6):
        pieces.add_match(edge(k % 2, 2 + k, 20.0 * k))
    assert pieces.take_edges(frames, 3) == [], 'they do not agree'
    for k in range(6):
        pieces.add_match(edge(k % 2, 2 + k, 3.0 * k))
    assert pieces.take_edges(frames, 4) == [], 'three with each piece'
    edges = pieces.take_edges(frames, 3)
    pieces.join(frames, edges)
    assert not pieces.is_apart
    assert not pieces.is_published(1), 'it is still apart from the other two'


def test_matches_of_a_piece_that_was_left_say_nothing_on_the_next():
    pieces = Pieces()
    pieces.begin()
    frames = [frame(0, 0.0), frame(1, 50.0), frame(2, 60.0)]
    pieces.add_match(edge(0, 1))
    pieces.begin()
    assert pieces.take_edges(frames, 1) == []
