"""Robots that explore one world together, in a closed loop."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from thinmap_ros.closed_loop.loop import TeamOptions
from thinmap_ros.closed_loop.radio import Trouble
from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.grid.shared import TILE_PERIOD_S
from thinmap_ros.core.planning import navigator
from thinmap_ros.evaluation.exploration_run import explore_together
from thinmap_ros.sim.world import World

START = se2.pose(5.0, 2.5, 0.5 * math.pi)
BESIDE = se2.pose(5.8, 2.5, 0.5 * math.pi)
OPTIONS = Options(speed_m_s=0.5, seed=1)


def world():
    """A corridor of 10 m, with a room at each end behind a door of 1 m."""
    cells = np.ones((60, 200), dtype=np.uint8)
    cells[20:40, 50:150] = 0
    cells[5:55, 5:45] = 0
    cells[5:55, 155:195] = 0
    cells[25:35, 40:160] = 0
    return World('two_rooms', cells, GridFrame(-5.0, -0.5, 0.1), START)


@cache
def run(robots, has_own_maps=False, **trouble):
    starts = [START, BESIDE][:robots]
    team = TeamOptions(trouble=Trouble(**trouble), has_own_maps=has_own_maps)
    return explore_together(world(), starts, OPTIONS, team)


def test_two_robots_are_faster_and_do_not_touch():
    _, one = run(1)
    team, two = run(2)
    assert two['finished']
    assert two['coverage'] >= 0.995
    assert two['time'] < 0.7 * one['time']
    assert two['distance'] < 1.3 * one['distance']
    assert two['collisions'] == 0
    # One room each.
    ends = [robot.log.true_poses[-1][0] for robot in team.robots]
    assert min(ends) < 3.0 < 7.0 < max(ends)


def test_the_same_seed_gives_the_same_run():
    one = run(2)[0]
    again = run.__wrapped__(2)[0]
    for a, b in zip(one.robots, again.robots, strict=True):
        assert np.array_equal(a.log.true_poses, b.log.true_poses)


def test_when_a_robot_dies_the_other_one_finishes():
    team, report = run(2, dead=(1, 5.0))
    assert report['finished']
    assert report['coverage'] >= 0.99
    dead = np.array(team.robots[1].log.true_poses)
    assert len(dead) == 25
    assert report['collisions'] == 0


def test_robots_do_not_stay_in_the_map():
    team, _ = run(2)
    patch = team.maps.known_area()
    walls = patch.frame.centres_of(np.argwhere(patch.occupied))
    distance_m = world().distance_to_wall_m
    rows, cols = world().frame.cells_of(walls).T
    assert distance_m[rows, cols].max() < 0.2


def test_robots_with_own_maps_explore_as_with_one():
    _, shared = run(2)
    _, own = run(2, has_own_maps=True)
    assert own['finished']
    assert own['time'] <= shared['time'] + 2.0 * TILE_PERIOD_S
    # Each knows what the other one has seen.
    assert min(robot['coverage'] for robot in own['robots']) >= 0.995
    assert 0.0 < own['bytes_per_m']['tiles'] < 300.0


@pytest.mark.parametrize('trouble', [{'out_of_reach': (1, 4.0, 12.0)}, {'loss': 0.3}])
def test_a_robot_that_missed_messages_catches_up(trouble):
    team, report = run(2, has_own_maps=True, **trouble)
    assert report['finished']
    assert min(robot['coverage'] for robot in report['robots']) >= 0.995
    one, other = team.maps._maps
    for receiver, sender in ((one, other), (other, one)):
        assert receiver.received.version_of(sender.robot.name) >= sender.sender.version - 1


def test_robots_that_would_touch_stand_and_turn(monkeypatch):
    monkeypatch.setattr(navigator, 'must_stop', lambda *situation: True)
    starts = [START, BESIDE]
    _, report = explore_together(world(), starts, replace(OPTIONS, time_limit_s=6.0))
    assert report['distance'] == 0.0
    assert all(robot['yielded_s'] > 1.0 for robot in report['robots'])


@pytest.mark.parametrize(('limit_s', 'is_wall'), [(10.0, False), (40.0, True)])
def test_a_dead_robot_becomes_a_wall_when_its_last_pose_is_old(limit_s, is_wall):
    starts = [se2.pose(5.0, 2.5, 0.0), se2.pose(6.0, 2.5, 0.0)]
    trouble = Trouble(dead=(1, 0.5))
    options = replace(OPTIONS, time_limit_s=limit_s)
    team, _ = explore_together(world(), starts, options, TeamOptions(trouble=trouble))
    patch = team.maps.known_area()
    walls = patch.frame.centres_of(np.argwhere(patch.occupied))
    place = team.robots[1].log.true_poses[-1][:2]
    assert (np.hypot(*(walls - place).T).min() < 0.3) == is_wall


def test_the_graph_holds_what_each_robot_can_reach():
    divided = world()
    divided.occupied[:, 98:102] = 1
    starts = [START - (1.0, 0.0, 0.0), BESIDE]
    team, report = explore_together(divided, starts, OPTIONS)
    nodes = team.maps.view(0)[0].nodes.values()
    assert report['finished']
    assert min(node.x for node in nodes) < 4.0
    assert max(node.x for node in nodes) > 6.0


def test_claims_may_be_late():
    _, report = run(2, claim_delay_s=5.0)
    assert report['finished']
    # Both may drive to one place until each has heard of the other.
    assert report['time'] < 0.8 * run(1)[1]['time']


@pytest.mark.parametrize('has_own_maps', [False, True])
def test_the_graph_has_no_gap_that_is_too_narrow_for_the_robots(has_own_maps):
    narrow = world()
    narrow.occupied[:27, 98:102] = 1
    narrow.occupied[33:, 98:102] = 1
    starts = [START - (1.5, 0.0, 0.0), START - (3.0, 0.0, 0.0)]
    options = replace(OPTIONS, robot='3at')
    team, report = explore_together(narrow, starts, options, TeamOptions(has_own_maps=has_own_maps))
    nodes = team.maps.view(0)[0].nodes.values()
    assert report['finished']
    assert max(node.x for node in nodes) < 5.0
