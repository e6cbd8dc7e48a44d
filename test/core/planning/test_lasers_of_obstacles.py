"""Obstacles and blind sectors of a robot with two lasers, whose fields of view overlap."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.ride import Ride, room

from thinmap_ros.core.planning.obstacles import BlindSectors, ObstaclePoints
from thinmap_ros.core.scan import Scan

HERE = np.zeros(3)
MOUNTS = {'front': np.array([0.3, 0.0, 0.0]), 'rear': np.array([-0.3, 0.0, math.pi])}
SIDE = np.array([0.0, 0.6])  # in sight of both


def seen_by(frame, *places, stamp_ns=0, blind=()):
    """A scan of 270 degrees in an open hall, with a hit at each of some places (2,), robot frame.

    blind: the bearings between two angles, laser frame, degrees, are invalid.
    """
    mount = MOUNTS[frame]
    step = math.radians(1.0)
    ranges = np.full(271, np.inf)
    for place in places:
        away = np.asarray(place) - mount[:2]
        beam = round((math.atan2(away[1], away[0]) - mount[2]) / step) % 360
        beam = (beam + 135) % 360
        assert beam < 271, 'in the field of view'
        ranges[beam] = np.hypot(*away)
    if blind:
        ranges[135 + blind[0] : 136 + blind[1]] = np.nan
    scan = Scan.create(stamp_ns, ranges, -135 * step, step, 0.05, 8.0, mount)
    return replace(scan, frame=frame)


def near(points, place):
    return bool(len(points)) and np.hypot(*(points - place).T).min() < 0.02


def test_what_one_laser_sees_stays_while_the_other_one_looks_over_it():
    obstacles = ObstaclePoints()
    for number in range(4):
        obstacles.add_scan(HERE, seen_by('front', SIDE, stamp_ns=10**8 * number))
        assert near(obstacles.points, SIDE)
        obstacles.add_scan(HERE, seen_by('rear', stamp_ns=10**8 * number + 5 * 10**7))
        assert near(obstacles.points, SIDE)
    obstacles.add_scan(HERE, seen_by('front', stamp_ns=5 * 10**8))
    assert not len(obstacles.points), 'it has gone away'


def test_both_see_their_own_side_and_one_point_is_there_once_a_laser():
    obstacles = ObstaclePoints()
    ahead = np.array([1.5, 0.0])
    behind = np.array([-1.5, 0.0])
    for number in range(4):
        obstacles.add_scan(HERE, seen_by('front', ahead, SIDE, stamp_ns=10**8 * number))
        obstacles.add_scan(HERE, seen_by('rear', behind, SIDE, stamp_ns=10**8 * number + 1))
    assert len(obstacles.points) == 4
    assert all(near(obstacles.points, place) for place in (ahead, behind, SIDE))


def test_what_has_left_the_view_of_one_is_remembered_until_the_other_one_looks_there():
    obstacles = ObstaclePoints()
    place = np.array([0.5, 0.4])
    obstacles.add_scan(HERE, seen_by('front', place))
    obstacles.add_scan(HERE, seen_by('rear', stamp_ns=10**7))
    turned = np.array([0.0, 0.0, math.pi])
    obstacles.add_scan(turned, seen_by('front', stamp_ns=10**8))
    assert near(obstacles.points, place), 'it is behind the front laser now'
    obstacles.add_scan(turned, seen_by('rear', stamp_ns=11 * 10**7))
    assert not len(obstacles.points)


def test_what_a_silent_laser_saw_is_past():
    obstacles = ObstaclePoints()
    far = np.array([2.5, 0.0])
    obstacles.add_scan(HERE, seen_by('front', far))
    obstacles.add_scan(HERE, seen_by('rear', stamp_ns=9 * 10**8))
    assert near(obstacles.points, far)
    obstacles.add_scan(HERE, seen_by('rear', stamp_ns=11 * 10**8))
    assert not len(obstacles.points)


def blind_points(*scans):
    sectors = BlindSectors()
    for scan in scans:
        sectors.add_scan(MOUNTS[scan.frame], scan)
    return sectors.points(2.0, 0.5)


def test_a_sector_of_invalid_beams_that_another_laser_sees_is_not_blind():
    dead = seen_by('front', blind=(70, 135), stamp_ns=10**8)
    alone = blind_points(dead)
    assert len(alone)
    both = blind_points(dead, seen_by('rear', stamp_ns=10**8))
    bearings = np.degrees(np.arctan2(both[:, 1], both[:, 0] + 0.3))
    assert 0 < len(both) < 0.5 * len(alone)
    assert bearings.max() < 45.6, 'the rear laser does not see there'
    later = seen_by('rear', stamp_ns=2 * 10**9)
    assert not len(blind_points(dead, later)), 'the other one has been silent for long'


def test_a_laser_with_dead_sectors_is_seen_through_in_either_order():
    dead = seen_by('front', blind=(70, 135))
    sound = seen_by('rear')
    one = blind_points(dead, sound)
    other = blind_points(sound, dead)
    assert sorted(map(tuple, one)) == sorted(map(tuple, other))


class TwoLasers(Ride):
    """A ride with a laser that looks ahead and one that looks around; spoil: of the first."""

    def __init__(self, *arguments, spoil=lambda ranges: ranges, sees_twice=True):
        super().__init__(*arguments)
        self._spoil = spoil
        self._sees_twice = sees_twice

    def scan(self):
        made = super().scan()
        ranges = self._spoil(made.ranges_m.copy())
        spoiled = replace(made, ranges_m=ranges, frame='front')
        return (spoiled, replace(made, frame='rear')) if self._sees_twice else spoiled


@pytest.mark.parametrize(('sees_twice', 'end'), [(False, 'failed'), (True, 'reached')])
def test_a_robot_drives_where_its_second_laser_sees_the_dead_half_of_the_first(sees_twice, end):
    def spoil(ranges):
        ranges[60:121] = np.nan
        return ranges

    ride = TwoLasers(room(), (1.0, 3.0, 0.0), spoil=spoil, sees_twice=sees_twice)
    assert ride.go((6.0, 3.0))[-1].state == end


@pytest.mark.parametrize('blocked', ['front', 'rear'])
def test_a_robot_stops_before_what_only_one_of_its_lasers_sees(blocked):
    def open_hall(ranges):
        return np.full_like(ranges, np.inf)

    world = room()
    world[:, 40] = 100
    ride = TwoLasers(world, (1.0, 3.0, 0.0), spoil=open_hall)
    ride.patch = replace(ride.patch, cells=room())
    whole = ride.scan
    if blocked == 'front':
        ride.scan = lambda: whole()[::-1]
    ride.go((6.0, 3.0))
    assert ride.nearest_m > 0.15 and ride.pose[0] < 4.0
