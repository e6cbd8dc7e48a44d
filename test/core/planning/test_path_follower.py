import math
from itertools import pairwise

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.planning.path_follower import PathFollower, PathFollowerConfig

DT = 0.1


def drive(path, start, config=None, seconds=60.0):
    """Exact unicycle driven by the follower: poses and commands."""
    follower = PathFollower(config or PathFollowerConfig())
    pose = np.array(start, dtype=np.float64)
    poses = []
    commands = []
    for _ in range(int(seconds / DT)):
        v, w = follower.command(pose, path, DT)
        pose = se2.compose(
            pose, se2.pose(v * DT * np.cos(w * DT / 2), v * DT * np.sin(w * DT / 2), w * DT)
        )
        poses.append(pose)
        commands.append((v, w))
        if math.dist(pose[:2], path[-1]) < 0.03:
            break
    return np.array(poses), np.array(commands)


def dense(points):
    parts = [np.linspace(a, b, 40, endpoint=False) for a, b in pairwise(points)]
    return np.concatenate([*parts, [points[-1]]])


def distance_to(path, poses):
    return np.hypot(*(poses[:, None, :2] - path[None]).transpose(2, 0, 1)).min(axis=1)


CORNERS = dense([(0.0, 0.0), (2.0, 0.0), (2.0, 1.5), (0.5, 1.5)])


def test_it_arrives_and_stays_near_the_path_round_sharp_corners():
    poses, _ = drive(CORNERS, (0.0, 0.0, 0.0))
    assert math.dist(poses[-1][:2], CORNERS[-1]) < 0.03
    assert distance_to(CORNERS, poses).max() < 0.12


@pytest.mark.parametrize('speed', [0.2, 0.5])
def test_commands_keep_all_limits(speed):
    config = PathFollowerConfig(max_speed_m_s=speed, max_angular_acceleration_rad_s2=1.0)
    _, commands = drive(CORNERS, (0.0, 0.0, 2.5), config)
    v, w = commands.T
    assert (v >= 0.0).all()
    assert v.max() <= speed + 1e-9
    assert np.abs(w).max() <= config.max_angular_speed_rad_s + 1e-9
    steps = np.abs(np.diff(commands, axis=0, prepend=[[0.0, 0.0]]))
    assert steps[:, 0].max() <= config.max_acceleration_m_s2 * DT + 1e-9
    assert steps[:, 1].max() <= config.max_angular_acceleration_rad_s2 * DT + 1e-9


def test_it_rotates_in_place_towards_a_path_that_starts_behind():
    poses, commands = drive(dense([(0.0, 0.0), (-2.0, 0.0)]), (0.0, 0.0, 0.0))
    turning = np.abs(poses[:, 2]) < math.pi - 0.9
    assert commands[turning, 0].max() == 0.0
    assert np.abs(poses[:, 1]).max() < 0.05


def test_it_slows_down_to_stop_at_the_end():
    poses, commands = drive(
        dense([(0.0, 0.0), (3.0, 0.0)]), (0.0, 0.0, 0.0), PathFollowerConfig(max_speed_m_s=0.5)
    )
    assert commands[:, 0].max() == pytest.approx(0.5)
    # The speed from which it can brake to rest within the last 0.1 m.
    assert commands[-1, 0] < math.sqrt(2.0 * PathFollowerConfig().max_acceleration_m_s2 * 0.1)
    assert poses[-1][0] <= 3.03


@pytest.mark.parametrize(
    ('lookahead_time_s', 'margin_m', 'expected'),
    [(0.8, 0.05, 0.25), (0.4, 0.05, 0.5), (0.4, 0.1, 0.75), (2.0, 0.0, 0.1)],
)
def test_in_a_narrow_passage_the_speed_is_the_shorter_lookahead_over_its_time(
    lookahead_time_s, margin_m, expected
):
    config = PathFollowerConfig(max_speed_m_s=2.0, lookahead_time_s=lookahead_time_s)
    follower = PathFollower(config)
    path = dense([(0.0, 0.0), (20.0, 0.0)])
    for _ in range(30):
        v, w = follower.command(np.zeros(3), path, DT, margin_m)
    assert (v, w) == pytest.approx((expected, 0.0))


def test_a_shorter_lookahead_leads_back_to_the_path_sooner():
    path = dense([(0.0, 0.0), (8.0, 0.0)])
    off_m = []
    for lookahead_distance_m in (0.3, 0.6, 1.2):
        config = PathFollowerConfig(lookahead_distance_m=lookahead_distance_m)
        poses, _ = drive(path, (0.0, 0.2, 0.0), config)
        off_m.append(np.abs(poses[:, 1]).sum())
    assert off_m == sorted(off_m)
    assert off_m[0] < 0.7 * off_m[-1]


def test_turning_to_a_heading_ends_there():
    follower = PathFollower(PathFollowerConfig())
    heading = 0.0
    for _ in range(100):
        v, w = follower.turn_to(np.array([0.0, 0.0, heading]), 2.0, DT)
        assert v == 0.0
        heading += w * DT
    assert heading == pytest.approx(2.0, abs=0.01)


def test_a_path_of_one_point():
    v, w = PathFollower(PathFollowerConfig()).command(np.zeros(3), np.array([[0.0, 0.0]]), DT)
    assert (v, w) == (0.0, 0.0)


@pytest.mark.parametrize('how', ['stop', 'turn'])
def test_it_comes_to_rest_on_the_arc_that_it_drives_before_it_turns(how):
    follower = PathFollower(PathFollowerConfig(max_speed_m_s=0.5))
    follower.override_speed(0.5, 0.6)
    turned = False
    for _ in range(40):
        before = follower.v
        v, w = follower.stop(DT) if how == 'stop' else follower.turn_to(np.zeros(3), -2.0, DT)
        assert v <= max(before - 0.04, 0.0) + 1e-9
        if v > 0.1:
            assert w / v == pytest.approx(1.2)
        turned |= w < 0.0
        assert not (turned and v > 0.0)
    assert follower.v == 0.0
    assert turned == (how == 'turn')
