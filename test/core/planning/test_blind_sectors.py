"""Blind sectors: possible obstacles in them, and the behaviour of a robot with a blind laser."""

import math

import numpy as np
import pytest
from support.ride import Ride, room

from thinmap_ros.core import se2
from thinmap_ros.core.planning.obstacles import BlindSectors
from thinmap_ros.core.scan import Scan

MIN_OBSTACLE_WIDTH_M = 0.1


def scan_with(invalid, beams=181, first=-math.pi / 2, step=math.pi / 180, value=np.nan):
    ranges = np.full(beams, np.inf)
    ranges[invalid] = value
    return Scan.create(0, ranges, first, step, 0.05, 8.0)


def unseen_points(scan, pose=(0.0, 0.0, 0.0), reach_m=2.0):
    sectors = BlindSectors()
    sectors.add_scan(np.array(pose), scan)
    return sectors.points(reach_m, 0.5)


def bearings_deg(points, pose=(0.0, 0.0, 0.0)):
    away = se2.transform_points(se2.invert(np.array(pose)), points)
    return np.degrees(np.arctan2(away[:, 1], away[:, 0]))


@pytest.mark.parametrize('value', [np.nan, 0.0, -1.0, 0.01])
@pytest.mark.parametrize('pose', [(0.0, 0.0, 0.0), (3.0, -2.0, 2.5)])
@pytest.mark.parametrize('first, count', [(0, 30), (80, 21), (151, 30), (90, 90)])
def test_points_fill_a_sector_from_where_something_can_hide(first, count, pose, value):
    points = unseen_points(scan_with(slice(first, first + count), value=value), pose)
    bearings = bearings_deg(points, pose)
    assert bearings.min() == pytest.approx(first - 90.0, abs=1e-3)
    assert bearings.max() == pytest.approx(first + count - 1 - 90.0, abs=1e-3)
    nearest = np.hypot(*(points - np.array(pose[:2])).T).min()
    assert nearest == pytest.approx(MIN_OBSTACLE_WIDTH_M / math.radians(count + 1), rel=1e-4)
    # So dense that the robot's footprint does not fit in between.
    for metres in (nearest, 1.0, 1.9):
        for degrees in np.linspace(first, first + count - 1, 7) - 90.0:
            angle = pose[2] + math.radians(degrees)
            place = np.array(pose[:2]) + metres * np.array([math.cos(angle), math.sin(angle)])
            assert np.hypot(*(points - place).T).min() <= 1.01 * MIN_OBSTACLE_WIDTH_M


def test_single_beams_hide_nothing_that_is_near():
    rng = np.random.default_rng(1)
    every_second = np.arange(0, 181, 2)
    assert len(unseen_points(scan_with(every_second))) == 0
    few = rng.choice(181, 20, replace=False)
    few = few[np.append(np.diff(np.sort(few)) > 1, True)]
    assert len(unseen_points(scan_with(few), reach_m=1.4)) == 0


@pytest.mark.parametrize('clockwise', [False, True])
def test_all_round_the_last_beam_is_beside_the_first(clockwise):
    step = -math.pi / 180 if clockwise else math.pi / 180
    scan = scan_with(np.r_[350:360, 0:10], 360, 0.0, step)
    points = unseen_points(scan)
    assert np.abs(bearings_deg(points)).max() <= 10.001
    assert np.hypot(*points.T).min() == pytest.approx(
        MIN_OBSTACLE_WIDTH_M / math.radians(21), rel=1e-4
    )


def test_what_was_seen_from_where_the_robot_just_was_is_seen():
    sectors = BlindSectors()
    dead = scan_with(slice(130, 181))
    for step in range(40):
        sectors.add_scan(np.array([0.05 * step, 0.0, 0.0]), dead)
    here = np.array([0.05 * 39, 0.0])
    bare = unseen_points(dead, (here[0], 0.0, 0.0))
    left = sectors.points(2.0, 0.5)
    assert 0 < len(left) < len(bare)
    # The space beside the robot was observed ahead of it; the space farther out never was.
    beside = here + np.array([0.0, 0.25])
    assert np.hypot(*(bare - beside).T).min() < 0.1 < np.hypot(*(left - beside).T).min()
    # Observations beyond its memory distance are forgotten.
    assert len(sectors.points(2.0, 0.0)) == len(bare)


def spoiled(ride, spoil):
    """The same ride with a laser that is blind from now on."""
    whole = ride.scan

    def scan():
        made = whole()
        ranges = np.where(made.no_return, np.inf, made.ranges_m)
        return Scan.create(
            made.stamp_ns, spoil(ranges), made.angle_min_rad, made.angle_increment_rad, 0.02, 8.0
        )

    ride.scan = scan
    return ride


def with_beams(first, end, value):
    def spoil(ranges):
        ranges[first:end] = value
        return ranges

    return spoil


@pytest.mark.parametrize('first, end', [(90, 181), (0, 91), (60, 121)])
@pytest.mark.parametrize('value', [np.nan, 0.0, -1.0])
def test_a_robot_does_not_drive_where_a_sector_is_dead(first, end, value):
    ride = spoiled(Ride(room(), (1.0, 3.0, 0.0)), with_beams(first, end, value))
    last = ride.go((6.0, 3.0))[-1]
    assert last.state == 'failed'
    assert 'does not see' in last.reason
    assert math.dist(ride.pose[:2], (1.0, 3.0)) < 0.6


@pytest.mark.parametrize('first, end', [(90, 181), (60, 121)])
def test_a_robot_stops_if_a_sector_becomes_blind_ahead(first, end):
    ride = Ride(room(), (1.0, 3.0, 0.0))
    ride.navigator.set_goal(6.5, 3.0)
    while ride.pose[0] < 3.0:
        ride.step()
    spoiled(ride, with_beams(first, end, np.nan))
    ride.go((6.5, 3.0))
    assert ride.pose[0] < 4.2, 'it stops within what it has seen just before'


def test_where_a_leg_can_hide_a_little_ahead_it_drives_no_faster_than_it_can_stop():
    """20 degrees: a leg in the sector is at least 0.26 m away, 2 cm ahead of the body."""
    ride = spoiled(Ride(room(), (1.0, 3.0, 0.0)), with_beams(80, 101, np.nan))
    ride.go((3.0, 3.0))
    fastest = max(v for v, _ in ride.commands)
    assert (
        fastest * ride.navigator.config.reaction_time_s
        < MIN_OBSTACLE_WIDTH_M / math.radians(22) - 0.24
    )


@pytest.mark.parametrize('first, end', [(0, 40), (150, 181), (60, 63)])
def test_a_blind_sector_beside_the_path_does_not_stop_it(first, end):
    ride = spoiled(Ride(room(), (1.0, 3.0, 0.0)), with_beams(first, end, np.nan))
    assert ride.go((6.0, 3.0))[-1].state == 'reached'


def test_every_second_beam_is_enough():
    def spoil(ranges):
        ranges[::2] = np.nan
        return ranges

    assert spoiled(Ride(room(), (1.0, 3.0, 0.0)), spoil).go((6.0, 3.0))[-1].state == 'reached'


def test_a_hall_without_a_return_is_driven_through():
    ride = spoiled(Ride(room(), (1.0, 3.0, 0.0)), with_beams(0, 181, np.inf))
    assert ride.go((6.0, 3.0))[-1].state == 'reached'


def test_something_nearer_than_can_be_measured_is_an_obstacle():
    """-inf (REP 117): an obstacle at range_min, inside the swept area of the robot."""
    ride = spoiled(Ride(room(), (1.0, 3.0, 0.0)), with_beams(85, 96, -np.inf))
    last = ride.go((6.0, 3.0))[-1]
    assert last.state == 'failed'
    assert 'blocks the path' in last.reason
    assert ride.pose[0] == pytest.approx(1.0)
    behind = spoiled(Ride(room(), (1.0, 3.0, 0.0)), with_beams(0, 5, -np.inf))
    assert behind.go((6.0, 3.0))[-1].state == 'reached', "beside the robot it is in nobody's way"
