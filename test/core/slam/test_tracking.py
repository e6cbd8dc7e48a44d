"""Whether a robot notices that it was carried off, and not where it only turns or drives on."""

import numpy as np
import pytest
from slam_room import ROOM, drive, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.localizer import Localizer, LocalizerConfig
from thinmap_ros.core.slam.tracking import share_seen_again

START = np.array([2.0, 2.0, 0.0])


@pytest.mark.parametrize('clockwise', [False, True])
@pytest.mark.parametrize('mount', [[0.0, 0.0, 0.0], [0.3, 0.1, 0.4]])
def test_what_was_just_seen_is_seen_again_unless_the_robot_was_carried_off(clockwise, mount, rng):
    how = {'T_base_laser': np.array(mount), 'clockwise': clockwise}
    increment = np.array([0.08, 0.01, 0.12])
    before = scan_in(ROOM, START, rng, **how).points_base()
    moved = scan_in(ROOM, se2.compose(START, increment), rng, **how)
    assert share_seen_again(before, increment, moved) > 0.9
    elsewhere = scan_in(ROOM, np.array([5.5, 8.0, 2.0]), rng, **how)
    assert share_seen_again(before, increment, elsewhere) < 0.4
    assert share_seen_again(before[:5], increment, scan_in(ROOM, START, rng, **how)) == 1.0


def test_a_robot_that_is_carried_off_is_lost_at_once_and_learns_nothing(rng):
    localizer = Localizer(LocalizerConfig(start_x_m=2.0, start_y_m=2.0))
    for i, (truth, odom) in enumerate(drive(400, rng, START)):
        assert not localizer.step(scan_in(ROOM, truth, rng, i), odom).lost
    lost = 0
    places = ([8.5, 8.5, -2.0], [8.5, 1.0, 2.5], [1.0, 8.0, 0.5], [5.5, 8.0, -1.0])
    for k, place in enumerate(places):
        localizer.set_pose(truth, 1e-4 * np.eye(3))
        assert not localizer.step(scan_in(ROOM, truth, rng, 10_000 + 10 * k), odom).lost
        points = localizer.state()['points']
        if localizer.step(scan_in(ROOM, np.array(place), rng, 10_001 + 10 * k), odom).lost:
            np.testing.assert_array_equal(localizer.state()['points'], points)
            lost += 1
    assert lost >= 3
    localizer.set_pose(truth, 1e-4 * np.eye(3))
    estimate = localizer.step(scan_in(ROOM, truth, rng, 20_000), odom)
    assert not estimate.lost and estimate.covariance[0, 0] < 1.0


def test_a_robot_that_turns_fast_is_not_lost_and_one_carried_off_in_the_turn_is(rng):
    localizer = Localizer(LocalizerConfig(start_x_m=2.0, start_y_m=2.0))
    for i in range(12):
        turned = se2.compose(START, np.array([0.0, 0.0, 0.4 * i]))
        assert not localizer.step(scan_in(ROOM, turned, rng, i), turned).lost
    odometry = se2.compose(turned, np.array([0.0, 0.0, 0.3]))
    assert localizer.step(scan_in(ROOM, np.array([8.5, 1.0, 2.5]), rng, 100), odometry).lost


def test_the_pose_of_a_lost_robot_is_known_to_nothing(rng):
    localizer = Localizer(LocalizerConfig(start_x_m=2.0, start_y_m=2.0))
    for i, (truth, odom) in enumerate(drive(100, rng, START)):
        localizer.step(scan_in(ROOM, truth, rng, i), odom)
    estimate = localizer.step(scan_in(ROOM, np.array([8.5, 8.5, -2.0]), rng, 10_000), odom)
    assert estimate.lost and estimate.covariance[0, 0] > 200.0**2
