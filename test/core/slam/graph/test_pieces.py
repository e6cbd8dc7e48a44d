"""Pieces of map: what is mapped at an unknown place, until matches tell where it is."""

import numpy as np
import pytest

from thinmap_ros.core.scan import Scan
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.loop_closure import Pieces
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.graph.reckoned import Reckoned, Search

SCAN = Scan.create(1, np.ones(3), 0.0, 0.1, 0.05, 8.0, np.zeros(3))
SEARCH = Search(2.0, 0.5)


def frame(submap, x):
    return Keyframe(SCAN, np.zeros((0, 5)), np.array([x, 0.0, 0.0]), 0.0, np.eye(3), submap)


def edge(a, b, x=0.0):
    return Edge(a, b, np.array([x, 0.0, 0.0]), np.eye(3) / 0.1**2, True)


def reckoned(log_odds):
    return Reckoned(log_odds, np.zeros(3), 1e-4 * np.eye(3), 0.0)


def test_a_new_submap_is_apart_until_a_pose_in_the_map_is_given():
    pieces = Pieces()
    assert not pieces.is_apart
    pieces.begin(reckoned(0.0))
    assert pieces.is_apart and pieces.current == 1
    assert not pieces.is_here(0) and pieces.is_published(0) and not pieces.is_published(1)
    pieces.return_to_published()
    assert not pieces.is_apart and pieces.current == 2
    assert pieces.is_here(0) and not pieces.is_here(1)
    pieces.return_to_published()
    assert pieces.current == 2, 'it was there already'


@pytest.mark.parametrize(('step_m', 'closes'), [(1.0, False), (3.0, True)])
def test_ambiguous_matches_close_a_loop_if_each_is_of_another_view(step_m, closes):
    pieces = Pieces()
    frames = [frame(0, 0.0), *(frame(0, 50.0 + step_m * k) for k in range(5))]
    for k in range(5):
        assert pieces.take_edges(frames, 5) == []
        pieces.add_match(edge(0, 1 + k, step_m * k))
    assert bool(pieces.take_edges(frames, 5)) == closes
    assert pieces.take_edges(frames, 5) == []


def test_a_piece_returns_once_the_odds_of_its_place_are_high_enough():
    pieces = Pieces()
    pieces.begin(reckoned(-4.0))
    frames = [frame(0, 0.0), frame(1, 0.0), frame(1, 3.0)]
    own = pieces.reckoned_between(0, pieces.current)
    own.add(np.zeros(2), edge(0, 1), np.zeros(3), 1e-4 * np.eye(3), SEARCH)
    assert pieces.take_returning() == []
    own.add(np.array([3.0, 0.0]), edge(0, 2), np.zeros(3), 1e-4 * np.eye(3), SEARCH)
    edges = pieces.take_returning()
    assert [each.b for each in edges] == [1, 2]
    assert pieces.take_returning() == []
    pieces.join(frames, edges)
    assert not pieces.is_apart
    assert pieces.reckoned_between(0, pieces.current) is None


def test_a_piece_that_was_left_is_judged_from_the_published_map_and_not_from_another_piece():
    pieces = Pieces()
    pieces.begin(reckoned(-2.0))
    pieces.begin(reckoned(-3.0))
    assert pieces.reckoned_between(1, pieces.current) is None
    assert pieces.reckoned_between(0, pieces.current).log_odds == pytest.approx(
        -np.logaddexp(2.0, 3.0)
    )
    pieces.return_to_published()
    assert pieces.reckoned_between(1, pieces.current).log_odds == -2.0
    assert pieces.reckoned_between(0, pieces.current) is None


def test_a_piece_that_recognition_joins_is_judged_no_longer():
    pieces = Pieces()
    pieces.begin(reckoned(-3.0))
    pieces.join([frame(0, 0.0), frame(1, 0.0)], [edge(0, 1)])
    pieces.begin(reckoned(-1.0))
    assert pieces.reckoned_between(0, pieces.current).log_odds == -1.0


def test_a_piece_without_a_look_does_not_return():
    pieces = Pieces()
    pieces.begin(reckoned(9.0))
    assert pieces.take_returning() == []
    own = pieces.reckoned_between(0, 1)
    own.add(np.zeros(2), edge(0, 1), np.zeros(3), 1e-4 * np.eye(3), SEARCH)
    assert pieces.take_returning() == [], 'one place alone'
