"""A scan against the previous one: a robot that drives on, a crowd, and a kidnapped robot."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import BLIND, ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.continuity import Motion, continues, continuity, log_ratio, seen_again

HERE = np.array([3.0, 2.0, 0.3])
MOVED = np.array([0.4, 0.0, 0.2])
RNG = np.random.default_rng(3)
HALL = np.array([[0.0, 0.0, 60.0, 0.0], [0.0, 40.0, 60.0, 40.0]])


def seen_from(T, stamp_ns=1):
    return scan_in(ROOM, T, RNG, stamp_ns)


def test_a_scan_shows_the_last_one_again_at_the_motion_between_both():
    before = seen_from(HERE)
    scan = seen_from(se2.compose(HERE, MOVED))
    assert seen_again(before, scan, MOVED) > 0.97
    assert continues(before, scan, MOVED)
    assert continuity(before, scan, [Motion(MOVED)]) == 0.0


def test_a_turn_that_the_odometry_did_not_see_does_not_go_on_but_by_its_match():
    before = seen_from(HERE)
    turn = np.array([0.0, 0.0, 1.5])
    scan = seen_from(se2.compose(HERE, turn))
    assert not continues(before, scan, np.zeros(3))
    assert continuity(before, scan, [Motion(np.zeros(3))]) < 0.0
    assert continuity(before, scan, [Motion(np.zeros(3)), Motion(turn)]) == 0.0


def test_a_robot_at_another_place_does_not_go_on():
    scan = seen_from(np.array([8.5, 5.0, -2.0]))
    assert continuity(seen_from(HERE), scan, [Motion(MOVED)]) < -5.0


def test_who_stands_beside_the_laser_hides_what_he_hides_and_is_no_other_place():
    before = seen_from(HERE)
    scan = seen_from(se2.compose(HERE, MOVED))
    ranges = scan.ranges_m.copy()
    ranges[: len(ranges) // 2] = 0.7
    hidden = type(scan).create(
        2, ranges, scan.angle_min_rad, scan.angle_increment_rad, 0.05, scan.range_max_m
    )
    assert continues(before, hidden, MOVED)


def test_a_scan_without_returns_tells_nothing():
    scan = seen_from(HERE)
    blind = scan.blinded('covered')
    assert seen_again(scan, blind, MOVED) is None
    assert continuity(scan, blind, [Motion(MOVED)]) == 0.0


def test_in_a_hall_beams_without_return_tell_of_another_place():
    """A wall on the left, and then one on the right: no return is in front of another one."""
    left = scan_in(HALL, np.array([30.0, 37.0, 0.0]), RNG)
    right = scan_in(HALL, np.array([30.0, 3.0, 0.0]), RNG)
    driven = scan_in(HALL, np.array([30.5, 37.0, 0.0]), RNG)
    ahead = Motion(np.array([0.5, 0.0, 0.0]))
    assert continuity(left, right, [ahead]) < -5.0
    assert continuity(left, driven, [ahead]) == 0.0
    dropping = [replace(scan, drops_out=True) for scan in (left, right)]
    assert continuity(*dropping, [ahead]) == 0.0, 'its beams without return say nothing'


def test_what_sees_nothing_at_all_does_not_tell_of_free_space():
    scan = seen_from(HERE)
    assert seen_again(BLIND, scan, MOVED) is None
    assert continues(BLIND, scan, MOVED) and not continues(BLIND, scan, MOVED, is_told=True)


@pytest.mark.parametrize('found', [0.3, 0.5, 0.7, 0.9])
def test_more_that_is_found_again_speaks_for_here_and_so_does_a_crowd_on_the_way(found):
    assert log_ratio(found, 0.1) < log_ratio(found + 0.1, 0.1)
    assert log_ratio(found, 0.0) <= log_ratio(found, 1.0)


def test_of_a_crowd_at_rest_little_is_believed():
    assert log_ratio(0.45, 1.0) - log_ratio(0.45, 0.0) > math.log(10.0)
