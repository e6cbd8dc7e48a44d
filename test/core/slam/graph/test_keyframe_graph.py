"""A graph that is moved in slices, between any two of which the robot drives, joins and returns."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.graph import keyframes as keyframes_module
from thinmap_ros.core.slam.graph import pose_graph
from thinmap_ros.core.slam.graph.keyframes import Keyframe, KeyframeConfig, Keyframes, Step
from thinmap_ros.core.slam.graph.loop_closure import KeyframeGraph, LoopClosure, LoopClosureConfig
from thinmap_ros.core.slam.graph.pose_graph import Edge, Systematic
from thinmap_ros.core.slam.graph.reckoned import Reckoned
from thinmap_ros.core.slam.matching.local_map import LocalMapConfig
from thinmap_ros.core.slam.matching.scan_matcher import MatchingConfig
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.slam.odometry import OdometryCalibration

STEP = 1e-4 * np.eye(3)
NOTHING = np.zeros((3, 3))
SCAN = scan_in(ROOM, np.array([3.0, 3.0, 0.0]))
POINTS = surface_points(SCAN)
AHEAD = np.array([0.8, 0.0, 0.02])
OFF = np.array([0.3, -0.2, 0.05])  # of a loop


def along(length_m):
    """Derivative (3, 4), by the calibration, of a straight way."""
    by = np.zeros((3, 4))
    by[0, 0] = length_m
    return by


def learn(calibration):
    """A scale that is new by far more than it is uncertain."""
    calibration.parameters = calibration.parameters + [0.2, 0.0, 0.0, 0.0]
    calibration.covariance = np.diag([1e-8] * 4)
    calibration._spans.add(calibration.parameters, 1e-4 * np.eye(4), 1e-8 * np.eye(4))


class Drive:
    """A robot that sees the same scan everywhere; loops, joins and places are given by hand."""

    def __init__(self):
        self.calibration = OdometryCalibration()
        self.loops = LoopClosure(
            LoopClosureConfig(),
            KeyframeConfig(),
            MatchingConfig(),
            LocalMapConfig(),
            self.calibration,
        )
        self._stamps = count(1)
        self._moving = 0  # keyframes when the move in progress began
        for _ in range(3):
            self.ahead()

    def _add(self, T_map_base):
        loops = self.loops
        anchor = loops.anchor
        path_m = anchor.path_m_at(anchor.relative(T_map_base))
        frame = Keyframe(
            replace(SCAN, stamp_ns=next(self._stamps)),
            POINTS,
            T_map_base,
            path_m,
            STEP,
            loops.pieces.current,
            systematic=along(path_m),
        )
        share = Systematic(along(0.8), self.calibration.parameters, self.calibration.spans)
        loops.add(frame, Step(STEP, share), NOTHING)

    def ahead(self):
        self._add(self.loops.anchor.pose(AHEAD))

    def again(self):
        """Stand where a keyframe is, which stands for the new one."""
        self._add(self.loops.anchor.T_map)

    def edge(self):
        """A match that agrees, or nearly, with an earlier keyframe."""
        frames = self.loops.keyframes.frames
        a = 0
        b = len(frames) - 1
        T_a_b = se2.compose(se2.between(frames[a].T_map_base, frames[b].T_map_base), OFF)
        self.loops.graph.edges.append(Edge(a, b, T_a_b, 100.0 * np.eye(3), robust=True))

    def close(self):
        self.edge()
        if not self.loops.graph.is_moving:
            self.loops.graph.optimize()

    def carried(self):
        """Scans contradict the map: a piece of its own begins."""
        self.loops.pieces.begin(Reckoned(0.0, np.zeros(3), np.eye(3), 0.0))
        self.ahead()
        self.ahead()

    def join(self):
        loops = self.loops
        here = [k for k, f in enumerate(loops.keyframes.frames) if loops.pieces.is_here(f.submap)]
        if loops.pieces.is_apart and here and not loops.graph.is_moving:
            edge = Edge(0, here[-1], AHEAD, 100.0 * np.eye(3), robust=True)
            loops.join(OFF, [edge])

    def place(self):
        self.loops.pieces.return_to_published()
        self.loops.return_to(np.zeros(3))

    def learn(self):
        learn(self.calibration)

    def slice(self):
        correction = self.loops.step()
        if correction is not None:
            self._check(correction)

    def do(self, moment):
        was_moving = self.loops.graph.is_moving
        moment(self)
        if not was_moving:
            self._moving = len(self.loops.keyframes)

    def _check(self, correction):
        keyframes = self.loops.keyframes
        poses = keyframes.poses()
        assert len(correction.before) == len(correction.after) == len(keyframes)
        np.testing.assert_array_equal(correction.after, poses)
        # Those that came meanwhile lie where their steps have them.
        for step in keyframes.steps[self._moving - 1 :]:
            T_a_b = se2.between(poses[step.a], poses[step.b])
            np.testing.assert_allclose(T_a_b, step.T_a_b, atol=1e-9)

    def finish(self):
        for _ in range(10_000):
            if not self.loops.is_busy:
                return
            self.do(Drive.slice)
        raise AssertionError('the move does not end')


MOMENTS = st.sampled_from(
    [
        *[Drive.slice] * 5,
        *[Drive.ahead] * 2,
        Drive.again,
        Drive.edge,
        Drive.close,
        Drive.carried,
        Drive.join,
        Drive.place,
        Drive.finish,
        *[Drive.learn] * 2,
    ]
)


def small_slices(patch):
    patch.setattr(pose_graph, '_SLICE', 1)
    patch.setattr(keyframes_module, '_MOVED_PER_SLICE', 1)


# The crash of a real drive: the graph follows the calibration while a keyframe is added.
@example(moments=[Drive.learn, Drive.slice, Drive.ahead, Drive.slice])
@given(moments=st.lists(MOMENTS, min_size=20, max_size=60))
@settings(max_examples=60)
def test_keyframes_edges_joins_and_places_may_come_between_any_two_slices(moments):
    with pytest.MonkeyPatch.context() as patch:
        small_slices(patch)
        drive = Drive()
        for moment in moments:
            drive.do(moment)
        drive.finish()
    keyframes = drive.loops.keyframes
    assert len(keyframes.steps) == len(keyframes) - 1
    assert np.isfinite(keyframes.poses()).all()
    for number, frame in enumerate(keyframes.frames):
        np.testing.assert_array_equal(frame.T_map_base, keyframes.poses()[number])
        assert number in keyframes.near(frame.T_map_base, 0.01)


@pytest.mark.slow
@pytest.mark.parametrize('size', [1_600, 15_000])
def test_a_large_graph_follows_the_calibration_while_a_keyframe_is_added(size):
    calibration = OdometryCalibration()
    keyframes = Keyframes(KeyframeConfig())
    graph = KeyframeGraph(keyframes, calibration)

    def add(number):
        pose = np.array([float(number), 0.0, 0.0])
        scan = replace(SCAN, stamp_ns=number)
        frame = Keyframe(
            scan, POINTS, pose, float(number), STEP, 0, systematic=along(float(number))
        )
        share = Systematic(along(1.0), calibration.parameters, calibration.spans)
        keyframes.add(frame, Step(STEP, share))

    for number in range(size):
        add(number)
    learn(calibration)
    graph.follow_calibration()
    assert graph.is_moving
    add(size)
    while graph.is_moving:
        correction = graph.step()
    assert correction is not None
    last = keyframes.frames[-1]
    expected = se2.compose(keyframes.frames[-2].T_map_base, keyframes.steps[-1].T_a_b)
    np.testing.assert_allclose(last.T_map_base, expected)
    assert last.T_map_base[0] > 1.1 * size
