import itertools
import math

import numpy as np
import pytest
from support.ride import DT, Ride, room

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.planning.path_follower import PathFollowerConfig
from thinmap_ros.core.scan import Scan


def test_it_drives_round_a_wall_and_stops_at_the_goal():
    world = room()
    world[30, :60] = 100
    ride = Ride(world, (1.0, 1.0, 0.0))
    assert ride.go((1.0, 5.0))[-1].state == 'reached'
    assert math.dist(ride.pose[:2], (1.0, 5.0)) < 0.2
    assert ride.nearest_m > 0.2
    for _ in range(10):
        last = ride.step()
    assert (last.state, last.v, last.w) == ('idle', 0.0, 0.0)


def test_a_heading_at_the_goal_is_turned_to():
    ride = Ride(room(), (1.0, 1.0, 0.0))
    assert ride.go((3.0, 1.0, -2.0))[-1].state == 'reached'
    assert abs(se2.wrap(ride.pose[2] + 2.0)) < 0.2


def test_a_goal_is_reached_within_the_tolerances_that_a_user_sets():
    config = NavigatorConfig(xy_goal_tolerance_m=0.6, yaw_goal_tolerance_rad=0.5)
    ride = Ride(room(), (1.0, 1.0, 0.0), config=config)
    assert ride.go((3.0, 1.0, -2.0))[-1].state == 'reached'
    assert 0.4 < math.dist(ride.pose[:2], (3.0, 1.0)) < 0.65
    assert 0.3 < abs(se2.wrap(ride.pose[2] + 2.0)) < 0.55


@pytest.mark.parametrize('speed', [0.2, 0.5, 1.2])
def test_waypoints_are_passed_without_a_stop_and_the_goal_is_reached(speed):
    config = NavigatorConfig(controller=PathFollowerConfig(max_speed_m_s=speed))
    ride = Ride(room(), (1.0, 1.0, 0.0), config=config)
    waypoints = [(3.0, 1.2), (5.0, 1.5), (6.5, 3.0)]
    ride.navigator.set_goal(6.5, 5.0, math.pi / 2, waypoints=waypoints)
    nearest = [math.inf, math.inf, math.inf]
    driven = []
    remaining = []
    command = ride.step()
    while command.state == 'driving' and ride.seconds < 120.0:
        driven.append((ride.navigator.waypoints_remaining, command.v))
        remaining.append(ride.navigator.distance_remaining_m)
        nearest = [
            min(m, math.dist(ride.pose[:2], at)) for m, at in zip(nearest, waypoints, strict=True)
        ]
        command = ride.step()
    assert command.state == 'reached'
    assert math.dist(ride.pose[:2], (6.5, 5.0)) < 0.2
    assert abs(se2.wrap(ride.pose[2] - math.pi / 2)) < 0.2
    assert max(nearest) < (0.2 if speed < 1.0 else 0.7)
    assert {count for count, _ in driven} == {0, 1, 2, 3}
    # In between, the robot is slower in bends only.
    between = [v for count, v in driven if count in (1, 2)]
    assert min(between) > 0.5 * min(speed, 0.5)
    assert remaining[1] == pytest.approx(8.2, abs=0.4)
    assert all(after < before + 0.1 for before, after in itertools.pairwise(remaining[1:]))


def test_a_waypoint_that_cannot_be_reached_ends_the_goal_with_its_place():
    world = room()
    world[:, 60] = 100
    ride = Ride(world, (1.0, 1.0, 0.0))
    ride.navigator.set_goal(2.0, 5.0, waypoints=[(2.0, 3.0), (7.0, 3.0)])
    while (command := ride.step()).state == 'driving':
        assert ride.seconds < 60.0
    assert (command.state, command.is_timeout) == ('failed', False)
    assert '(7.00, 3.00)' in command.reason


@pytest.mark.parametrize(('width', 'is_timeout', 'recoveries'), [(12, True, 1), (60, False, 6)])
def test_a_robot_that_stood_still_for_too_long_times_out(width, is_timeout, recoveries):
    """In the corridor it waits; in the hall it looks for a way around the unmapped wall."""
    world = room(rows=width)
    world[:, 40] = 100
    ride = Ride(world, (1.0, 0.6, 0.0), known=room(rows=width))
    last = ride.go((7.0, 0.6))[-1]
    assert (last.state, last.is_timeout) == ('failed', is_timeout)
    assert ride.navigator.recoveries == recoveries


@pytest.mark.parametrize('goal', [(30.0, 30.0), (5.0, 0.02), (7.0, 3.0)])
def test_a_goal_that_cannot_be_reached_is_refused_at_once_with_a_reason(goal):
    world = room()
    world[:, 60] = 100
    commands = Ride(world, (1.0, 1.0, 0.0)).go(goal)
    assert [c.state for c in commands] == ['failed']
    assert f'({goal[0]:.2f}, {goal[1]:.2f})' in commands[-1].reason


@pytest.mark.parametrize('y', [0.1, 0.15, 0.2, 0.25, 0.3])
@pytest.mark.parametrize('heading', [None, 2.0])
def test_a_goal_too_near_to_a_wall_is_reached_as_near_to_it_as_the_robot_may_stand(y, heading):
    ride = Ride(room(), (1.0, 1.0, 0.0))
    assert ride.go((5.0, y) if heading is None else (5.0, y, heading))[-1].state == 'reached'
    assert math.dist(ride.pose[:2], (5.0, 0.35)) < 0.2
    assert ride.nearest_m > 0.2
    assert heading is None or abs(se2.wrap(ride.pose[2] - heading)) < 0.2


def test_it_stops_in_front_of_an_unmapped_obstacle_and_drives_around_it():
    world = room()
    world[5:25, 40] = 100
    ride = Ride(
        world,
        (1.0, 1.0, 0.0),
        known=room(),
        config=NavigatorConfig(controller=PathFollowerConfig(max_speed_m_s=0.5)),
    )
    assert ride.go((7.0, 1.5), 120.0)[-1].state == 'reached'
    assert ride.nearest_m > 0.18


def gap_of(cells):
    """A room divided by a wall with a gap."""
    world = room()
    world[: 30 - cells // 2, 40:43] = 100
    world[30 + cells - cells // 2 :, 40:43] = 100
    return world


def rides_to_and_fro(ride, seconds):
    """Number of crossings to the other side in that time, and the smallest clearance, m."""
    corners = np.argwhere(ride.world == 100)[:, ::-1] * 0.1
    nearest = math.inf
    crossings = 0
    sides = itertools.cycle([(7.0, 3.05), (1.0, 3.05)])
    goal = next(sides)
    ride.navigator.set_goal(*goal)
    while ride.seconds < seconds:
        state = ride.step().state
        crossings += state == 'reached'
        goal = next(sides) if state == 'reached' else goal
        if state in ('reached', 'failed'):
            ride.navigator.set_goal(*goal)
        away = np.maximum(np.abs(ride.pose[:2] - corners - 0.05) - 0.05, 0.0)
        nearest = min(nearest, float(np.hypot(*away.T).min()))
    return crossings, nearest


@pytest.mark.parametrize('seed', range(4))
def test_a_noisy_laser_makes_no_passage_too_narrow_and_none_wide_enough(seed):
    config = NavigatorConfig(controller=PathFollowerConfig(max_speed_m_s=0.5))
    wide = Ride(gap_of(5), (1.0, 3.05, 0.0), config=config, noise=np.random.default_rng(seed))
    crossings, nearest = rides_to_and_fro(wide, 120.0)
    assert crossings >= 4
    assert nearest > 0.22
    narrow = Ride(gap_of(4), (1.0, 3.05, 0.0), room(), config, np.random.default_rng(seed))
    crossings, nearest = rides_to_and_fro(narrow, 120.0)
    assert crossings == 0
    assert nearest > 0.2


def test_without_a_path_around_it_gives_up_with_a_reason():
    world = room()
    world[:, 40] = 100
    ride = Ride(world, (1.0, 3.0, 0.0), known=room())
    commands = ride.go((7.0, 3.0), 120.0)
    assert commands[-1].state == 'failed'
    assert 'blocked' in commands[-1].reason or 'blocks the path' in commands[-1].reason
    assert any(c.state == 'blocked' for c in commands)
    assert ride.nearest_m > 0.18


def test_a_path_that_is_blocked_in_the_map_is_planned_again():
    world = room()
    ride = Ride(world, (1.0, 3.0, 0.0))
    ride.navigator.set_goal(7.0, 3.0)
    ride.step()
    assert ride.navigator.path[:, 1].max() < 3.3
    changed = room()
    changed[10:45, 40] = 100
    ride.world = changed
    ride.patch = GridPatch(ride.patch.frame, changed)
    ride.step()
    crossing = ride.navigator.path[np.abs(ride.navigator.path[:, 0] - 4.05) < 0.1]
    assert (crossing[:, 1] > 4.6).all() or (crossing[:, 1] < 0.9).all()


def test_a_new_goal_takes_the_place_of_the_old_one_and_cancel_brings_it_to_rest():
    ride = Ride(room(), (1.0, 1.0, 0.0))
    ride.navigator.set_goal(7.0, 1.0)
    for _ in range(30):
        ride.step()
    assert ride.navigator.distance_remaining_m > 4.0
    ride.navigator.set_goal(2.0, 4.0)
    ride.step()
    np.testing.assert_allclose(ride.navigator.path[-1], (2.0, 4.0))
    ride.navigator.cancel()
    commands = [ride.step() for _ in range(15)]
    assert {c.state for c in commands} == {'idle'}
    assert (commands[-1].v, commands[-1].w) == (0.0, 0.0)
    assert ride.navigator.distance_remaining_m == 0.0


def test_speed_is_kept_low_enough_to_stop_before_what_stands_ahead():
    """A wall at every distance: the speed always allows braking in front of it."""
    config = NavigatorConfig(controller=PathFollowerConfig(max_speed_m_s=0.5))
    known = room()
    for gap in (0.3, 0.4, 0.6, 1.0):
        world = room()
        world[:, int((2.0 + gap) / 0.1) + 1] = 100
        ride = Ride(world, (2.0, 3.0, 0.0), known=known, config=config)
        ride.navigator.set_goal(7.0, 3.0)
        for _ in range(60):
            ride.step()
        assert ride.nearest_m >= min(0.2, gap - 0.15)


@pytest.mark.parametrize('dt_s', [0.01, 0.02, 0.05, 0.1, 0.2])
def test_it_sets_out_in_free_space_however_often_it_is_asked(dt_s):
    navigator = Navigator()
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), room())
    scan = Scan.create(0, np.full(181, 3.0), -math.pi / 2, math.pi / 180, 0.02, 8.0)
    navigator.set_goal(6.0, 3.0)
    here = np.array([2.0, 3.0, 0.0])
    # Later it would be stuck: it does not move.
    commands = [navigator.step(here, patch, scan, dt_s) for _ in range(round(1.0 / dt_s))]
    assert all(command.state == 'driving' for command in commands)
    assert commands[-1].v == pytest.approx(0.2)


def test_it_remembers_obstacles_beside_it_outside_of_the_field_of_view():
    navigator = Navigator()
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), room())

    def look(pose, ranges, stamp):
        scan = Scan.create(stamp, ranges, -math.pi / 2, math.pi / 180, 0.02, 8.0)
        navigator.step(np.array(pose), patch, scan, DT)
        return navigator._obstacles.points

    ahead = np.full(181, np.inf)
    ahead[90] = 0.5
    assert np.allclose(look((2.0, 3.0, 0.0), ahead, 0), [[2.5, 3.0]], atol=1e-6)
    # Out of view, it is remembered; observed as free, it is forgotten.
    assert np.allclose(look((2.0, 3.0, 2.5), np.full(181, np.inf), 1), [[2.5, 3.0]], atol=1e-6)
    assert len(look((2.0, 3.0, 0.5), np.full(181, np.inf), 2)) == 0
    # Distant points are dropped, too.
    look((2.0, 3.0, 0.0), ahead, 3)
    assert len(look((3.6, 3.0, 0.0), np.full(181, np.inf), 4)) == 0


def test_it_can_return_along_its_recent_path_however_narrow():
    navigator = Navigator()
    looks_open = GridPatch(GridFrame(0.0, 0.0, 0.1), room())
    for x in np.arange(1.0, 7.0, 0.05):
        navigator.step(np.array([x, 3.05, 0.0]), looks_open, None, DT)
    narrow = GridPatch(looks_open.frame, gap_of(2))
    navigator.set_goal(1.0, 3.05)
    assert navigator.step(np.array([7.0, 3.05, math.pi]), narrow, None, DT).state == 'driving'
    # The robot has not been there.
    other = Navigator()
    other.set_goal(1.0, 3.05)
    assert other.step(np.array([7.0, 3.05, math.pi]), narrow, None, DT).state == 'failed'


def test_displaced_from_its_path_it_plans_again_at_once():
    navigator = Navigator()
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), room())
    navigator.set_goal(7.0, 1.0)
    navigator.step(np.array([1.0, 1.0, 0.0]), patch, None, DT)
    kept = navigator.path
    navigator.step(np.array([1.1, 1.1, 0.0]), patch, None, DT)
    assert navigator.path is kept
    navigator.step(np.array([1.0, 5.0, 0.0]), patch, None, DT)
    np.testing.assert_allclose(navigator.path[0], (1.0, 5.0))
