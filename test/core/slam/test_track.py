"""The pose is kept relative to the last keyframe scan: a correction moves keyframes only."""

from copy import deepcopy

import numpy as np
import pytest
from support.slam_room import ROOM, drive, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import rotated_covariance
from thinmap_ros.core.slam.graph.keyframes import Anchor
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.odometry import MotionConfig, OdometryPrediction
from thinmap_ros.core.slam.track import DeadReckoning, LocalizerConfig, Tracker

START = np.array([2.0, 2.0, 0.0])
PERIOD_NS = 200_000_000
CORRECTION = se2.pose(0.7, -1.2, np.pi / 2.0)


@pytest.fixture(scope='module')
def steps():
    rng = np.random.default_rng(3)
    return [
        (scan_in(ROOM, truth, rng, k * PERIOD_NS), odom)
        for k, (truth, odom) in enumerate(drive(330, rng, START))
    ]


@pytest.fixture(scope='module')
def driven(steps):
    """A localizer after 300 of the steps; the last ones have added no keyframe."""
    localizer = Localizer(LocalizerConfig(initial_x_m=2.0, initial_y_m=2.0))
    for scan, odom in steps[:300]:
        localizer.step(scan, odom)
    assert np.hypot(*localizer._tracker.T_anchor_base[:2]) > 0.05
    return localizer


def corrected(localizer, by=CORRECTION):
    """The same localizer after all keyframes were moved, and nothing else."""
    other = deepcopy(localizer)
    loops = other._loops
    moved = np.array([se2.compose(by, T) for T in loops.keyframes.poses()])
    list(loops.keyframes.move(moved, loops.graph.edges))
    other._close_loops()
    return other


def test_the_pose_follows_the_keyframes(driven):
    other = corrected(driven)
    np.testing.assert_allclose(other.pose, se2.compose(CORRECTION, driven.pose), atol=1e-12)
    before = driven._tracker
    after = other._tracker
    np.testing.assert_array_equal(after.reckoned.T_anchor_base, before.reckoned.T_anchor_base)
    np.testing.assert_array_equal(after.T_anchor_update, before.T_anchor_update)
    np.testing.assert_array_equal(after.uncertainty.since_match, before.uncertainty.since_match)


def test_tracking_continues_in_the_corrected_map_as_if_it_had_always_been_there(driven, steps):
    one = corrected(driven, np.zeros(3))
    other = corrected(driven)
    for scan, odom in steps[300:]:
        here = one.step(scan, odom)
        there = other.step(scan, odom)
        assert not there.is_lost
        assert there.inlier_ratio > 0.9
        off = se2.between(se2.compose(CORRECTION, here.T_map_base), there.T_map_base)
        assert np.hypot(off[0], off[1]) < 0.02
        assert abs(off[2]) < 0.005


def test_a_new_anchor_changes_nothing_in_the_map():
    track = Tracker(LocalizerConfig(initial_x_m=1.0, initial_y_m=0.5, initial_yaw_rad=0.8))
    covariance = np.array([[0.04, 0.01, 0.002], [0.01, 0.09, 0.001], [0.002, 0.001, 0.01]])
    track.uncertainty.since_match = covariance
    track.reckoned = DeadReckoning(se2.pose(0.8, 0.6, 0.7), covariance)
    track.T_anchor_update = se2.pose(0.9, 0.4, 0.6)
    anchor = Anchor(T_frame=se2.pose(5.0, -2.0, 2.0))
    new = Anchor(T_frame=anchor.pose(track.T_anchor_base))

    def in_map(anchor):
        yaw = float(anchor.T_map[2])
        return [
            anchor.pose(track.T_anchor_base),
            anchor.pose(track.reckoned.T_anchor_base),
            anchor.pose(track.T_anchor_update),
            anchor.pose(track.uncertainty.T_moved),
            rotated_covariance(track.uncertainty.since_match, yaw),
            rotated_covariance(track.reckoned.covariance, yaw),
        ]

    before = in_map(anchor)
    track.begin_step()
    for old, now in zip(before, in_map(new), strict=True):
        np.testing.assert_allclose(now, old, atol=1e-12)


@pytest.mark.parametrize('revision', [0, 1])
def test_matches_before_a_correction_are_not_compared_with_those_after_it(steps, revision):
    """Half a metre that the map has moved is no error of the wheels."""
    prediction = OdometryPrediction(MotionConfig())
    before = np.zeros(3)
    for k, (scan, odom) in enumerate(steps[:40]):
        is_after = k >= 20
        found = prediction.predict(scan, odom, before, revision if is_after else 0)
        before = found.prior + (0.5 * (k == 20), 0.0, 0.0)
        prediction.calibration.update(before, 1e6 * np.eye(3), np.zeros((3, 4)))
    compared = np.abs(prediction.calibration.parameters - [1.0, 0.0, 1.0, 0.0]).max() > 0.0
    assert compared == (revision == 0)
