"""Keyframes are sent once each, and come to the same poses and edges, in whatever order."""

import math

import numpy as np
import pytest
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import inverse
from thinmap_ros.core.slam.graph.keyframes import Keyframe, KeyframeConfig, Step
from thinmap_ros.core.slam.graph.loop_closure import LoopClosure, LoopClosureConfig
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.graph.reckoned import Reckoned
from thinmap_ros.core.slam.graph.tables import EdgeTable
from thinmap_ros.core.slam.joining.messages import KeyframeMessage, KeyframeSender
from thinmap_ros.core.slam.joining.pieces import ReceivedKeyframes
from thinmap_ros.core.slam.matching.local_map import LocalMapConfig
from thinmap_ros.core.slam.matching.scan_matcher import MatchingConfig
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.odometry import UNKNOWN, OdometryCalibration

POSES = [se2.pose(2.0 + 0.7 * k, 2.0, 0.2 * k) for k in range(5)]
COVARIANCE = np.diag([0.01, 0.02, 0.003])


@pytest.fixture
def loops():
    return LoopClosure(
        LoopClosureConfig(),
        KeyframeConfig(),
        MatchingConfig(),
        LocalMapConfig(),
        OdometryCalibration(),
    )


def add(loops, *numbers):
    for k in numbers:
        scan = scan_in(ROOM, POSES[k], np.random.default_rng(k), 1000 + k)
        frame = Keyframe(
            scan, surface_points(scan), POSES[k], 0.7 * k, COVARIANCE, loops.pieces.current
        )
        loops.keyframes.add(frame, Step(COVARIANCE))


def told(sender):
    found = []
    while (message := sender.next_message()) is not None:
        found.append(KeyframeMessage.decode(message.encode()))
    return found


def received(messages, corrections=(), session=7):
    found = ReceivedKeyframes()
    for message in messages:
        found.add(session, 1, message)
    for correction in corrections:
        found.correct(session, *correction)
    return found.known()


def ends(messages):
    return [[(edge.a, edge.b) for edge in message.edges] for message in messages]


def test_each_keyframe_is_told_once_with_its_edges(loops):
    sender = KeyframeSender(loops)
    add(loops, 0, 1)
    first = told(sender)
    assert told(sender) == []
    add(loops, 2)
    T = se2.between(POSES[2], POSES[0])
    loops.graph.edges.append(Edge(2, 0, T, inverse(COVARIANCE), robust=True))
    add(loops, 3)
    messages = first + told(sender)
    assert ends(messages) == [[], [(0, 1)], [(1, 2), (2, 0)], [(2, 3)]]
    np.testing.assert_allclose(
        messages[1].edges[0].information, inverse(COVARIANCE), rtol=1e-5, atol=1e-3
    )
    known = received(messages[::-1])
    np.testing.assert_allclose(known.poses, POSES[:4], atol=1e-6)
    assert len(known.edges) == 4
    for edge in known.edges:
        want = se2.between(known.poses[edge.a], known.poses[edge.b])
        np.testing.assert_allclose(edge.T_a_b, want)


def test_a_loop_that_the_robot_does_not_believe_has_no_weight(loops):
    sender = KeyframeSender(loops)
    add(loops, 0, 1, 2)
    wrong = se2.between(POSES[2], POSES[0]) + (5.0, 0.0, 0.0)
    loops.graph.edges.append(Edge(2, 0, wrong, inverse(COVARIANCE), robust=True))
    edges = {(e.a, e.b): e.information for m in told(sender) for e in m.edges}
    assert edges[2, 0].max() < 1e-3 * edges[1, 2].max()


def test_a_correction_tells_the_poses_of_all_and_no_scan(loops):
    sender = KeyframeSender(loops)
    add(loops, 0, 1, 2)
    before = told(sender)
    assert sender.corrected_poses() is None
    moved = np.array(POSES[:3]) + (0.1, 0.2, 0.0)
    list(loops.keyframes.move(moved, EdgeTable()))
    correction = (1, sender.corrected_poses())
    assert sender.revision == 1
    assert sender.corrected_poses() is None
    add(loops, 3)
    after = told(sender)
    assert [message.revision for message in before + after] == [0, 0, 0, 1]
    known = received(before + after, [correction])
    np.testing.assert_allclose(known.poses[:3], moved, atol=1e-6)
    np.testing.assert_allclose(known.poses[3], POSES[3], atol=1e-6)


def test_the_edges_of_a_loop_do_not_wait_for_the_next_keyframe(loops):
    sender = KeyframeSender(loops)
    add(loops, 0, 1, 2)
    messages = told(sender)
    T = se2.between(POSES[2], POSES[0])
    loops.graph.edges.append(Edge(2, 0, T, inverse(COVARIANCE), robust=True))
    list(loops.keyframes.move(np.array(POSES[:3]), loops.graph.edges))
    correction = (1, sender.corrected_poses())
    again = told(sender)
    assert ends(again) == [[(2, 0)]]
    known = received(messages + again, [correction])
    assert len(known.frames) == 3
    assert sorted((e.a, e.b) for e in known.edges) == [(0, 1), (1, 2), (2, 0)]


def test_a_keyframe_waits_for_the_correction_that_it_follows(loops):
    sender = KeyframeSender(loops)
    add(loops, 0, 1)
    messages = told(sender)
    found = ReceivedKeyframes()
    for message in messages:
        found.add(7, 1, message)
    known = found.known()
    list(loops.keyframes.move(np.array(POSES[:2]) + (0.1, 0.0, 0.0), EdgeTable()))
    correction = sender.corrected_poses()
    add(loops, 2)
    (newest,) = told(sender)
    found.add(7, 1, newest)
    assert found.known() is known
    found.correct(7, 1, correction)
    assert len(found.known().frames) == 3


def test_a_gap_ends_what_is_known_and_another_session_replaces_it(loops):
    sender = KeyframeSender(loops)
    add(loops, 0, 1, 2, 3)
    messages = told(sender)
    found = ReceivedKeyframes()
    assert found.known() is None
    for number in (0, 1, 3):
        found.add(7, 1, messages[number])
    assert len(found.known().frames) == 2
    assert [(e.a, e.b) for e in found.known().edges] == [(0, 1)]
    found.add(7, 1, messages[2])
    assert len(found.known().frames) == 4
    found.add(8, 2, messages[0])
    assert found.map_id == 2
    assert len(found.known().frames) == 1


def test_what_is_apart_is_told_when_it_is_joined(loops):
    sender = KeyframeSender(loops)
    add(loops, 0, 1)
    loops.pieces.begin(Reckoned(0.0, np.zeros(3), np.eye(3), 0.0))
    add(loops, 2, 3)
    messages = told(sender)
    assert len(messages) == 2
    link = Edge(0, 3, se2.between(POSES[0], POSES[3]), inverse(COVARIANCE), robust=True)
    loops.graph.edges.append(link)
    loops.pieces.join(loops.keyframes.frames, [link])
    messages += told(sender)
    assert ends(messages) == [[], [(0, 1)], [(1, 2)], [(0, 3), (2, 3)]]


def test_a_keyframe_whose_anchor_is_not_told_hangs_on_the_last_one(loops):
    sender = KeyframeSender(loops)
    add(loops, 0)
    loops.pieces.begin(Reckoned(0.0, np.zeros(3), np.eye(3), 0.0))
    add(loops, 1)
    loops.pieces.return_to_published()
    add(loops, 2)
    messages = told(sender)
    assert ends(messages) == [[], [(0, 1)]]
    weak = messages[1].edges[0].information
    assert math.isclose(weak[0, 0], inverse(UNKNOWN)[0, 0], rel_tol=1e-5)
