"""The robot: exact motion, limits, contact, and realistic odometry drift."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.sim.robot import PRESETS, DifferentialDriveRobot, RobotConfig, after_arc
from thinmap_ros.sim.world import World

EXACT = RobotConfig(
    scale_sigma=0.0,
    turn_scale_sigma=0.0,
    drift_sigma_rad_m=0.0,
    distance_noise=0.0,
    turn_noise=0.0,
    turn_noise_driving=0.0,
)


def hall(size_m: float = 40.0) -> World:
    cells = np.zeros((round(size_m / 0.1),) * 2, dtype=np.uint8)
    cells[0] = 1
    cells[-1] = 1
    cells[:, 0] = 1
    cells[:, -1] = 1
    return World('hall', cells, GridFrame(-size_m / 2, -size_m / 2, 0.1), np.zeros(3))


HALL = hall()


@given(st.floats(-2.0, 2.0), st.floats(-7.0, 7.0))
def test_an_arc_is_many_small_steps(distance: float, turn: float) -> None:
    pose = np.zeros(3)
    for _ in range(4000):
        middle = se2.compose(pose, se2.pose(0, 0, turn / 8000))
        pose = se2.compose(middle, se2.pose(distance / 4000, 0, turn / 8000))
    ours = after_arc(np.zeros(3), distance, turn)
    assert np.allclose(ours[:2], pose[:2], atol=1e-5)
    assert abs(se2.wrap(float(ours[2] - pose[2]))) < 1e-9


@given(st.floats(-1e-6, 1e-6))
def test_an_arc_has_no_jump_where_it_becomes_straight(turn: float) -> None:
    assert np.allclose(after_arc(np.zeros(3), 1.0, turn), [1.0, turn / 2.0, turn], atol=1e-9)


def test_a_full_circle_comes_back() -> None:
    robot = DifferentialDriveRobot(EXACT, HALL, np.array([1.0, 2.0, 0.3]), 0)
    robot.v = 0.2
    robot.w = 2 * math.pi / 10
    for _ in range(200):
        robot.step(0.2, 2 * math.pi / 10, 0.05)
    assert np.allclose(robot.T_world_base, [1.0, 2.0, 0.3], atol=1e-9)
    assert np.allclose(robot.T_odom_base, [0.0, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize('name', ['2dx', '3at'])
def test_limits_of_speed_and_acceleration(name: str) -> None:
    config = PRESETS[name]
    robot = DifferentialDriveRobot(config, HALL, np.zeros(3), 0)
    previous = (0.0, 0.0)
    for _ in range(100):
        robot.step(9.0, -9.0, 0.05)
        assert abs(robot.v - previous[0]) <= config.max_acceleration_m_s2 * 0.05 + 1e-12
        assert abs(robot.w - previous[1]) <= config.max_angular_acceleration_rad_s2 * 0.05 + 1e-12
        previous = (robot.v, robot.w)
    assert previous == (config.max_speed_m_s, -config.max_angular_speed_rad_s)


def test_it_stops_at_a_wall_and_counts_the_contact_once() -> None:
    robot = DifferentialDriveRobot(EXACT, HALL, np.array([18.0, 0.0, 0.0]), 0)
    for _ in range(200):
        robot.step(0.5, 0.0, 0.05)
        assert HALL.is_clear(robot.T_world_base[0], robot.T_world_base[1], EXACT.radius_m)
    assert robot.collisions == 1
    assert 19.9 - EXACT.radius_m - 0.03 < robot.T_world_base[0] < 19.9 - EXACT.radius_m
    for _ in range(40):
        robot.step(-0.3, 0.0, 0.05)
    assert robot.T_world_base[0] < 19.4
    assert robot.collisions == 1
    for _ in range(200):
        robot.step(0.5, 0.0, 0.05)
    assert robot.collisions == 2


def test_odometry_is_relative_to_the_start() -> None:
    start = np.array([2.0, -3.0, 2.5])
    robot = DifferentialDriveRobot(EXACT, HALL, start, 0)
    for i in range(300):
        robot.step(0.4, 0.5 * math.sin(i / 20), 0.05)
    assert np.allclose(se2.compose(start, robot.T_odom_base), robot.T_world_base, atol=1e-9)


def drift(name: str, seed: int) -> tuple[float, float, float]:
    """Odometry errors over 20 m: of distance (relative), of heading (rad).

    And of ten rotations in place (relative).
    """
    robot = DifferentialDriveRobot(PRESETS[name], hall(90.0), np.zeros(3), seed)
    while robot.T_world_base[0] < 20.0:
        robot.step(0.5, 0.0, 0.05)
    heading = float(robot.T_odom_base[2])
    path = np.hypot(*robot.T_odom_base[:2]) / 20.0 - 1.0
    turned = 0.0
    counted = 0.0
    last = robot.T_odom_base[2]
    while turned < 20 * math.pi:
        robot.step(0.0, 1.0, 0.05)
        turned += robot.w * 0.05
        counted += se2.wrap(float(robot.T_odom_base[2] - last))
        last = robot.T_odom_base[2]
    return float(path), heading, counted / turned - 1.0


def test_drift_is_that_of_real_wheels_and_worse_when_they_skid() -> None:
    small = np.array([drift('2dx', seed) for seed in range(12)])
    large = np.array([drift('3at', seed) for seed in range(12)])
    rms_small, rms_large = (np.sqrt((errors**2).mean(axis=0)) for errors in (small, large))
    assert 0.002 < rms_small[0] < 0.05
    assert 0.05 < rms_small[1] < 0.6
    assert 0.005 < rms_small[2] < 0.05
    assert rms_large[2] > 2.0 * rms_small[2]


def test_the_seed_decides_everything() -> None:
    runs = []
    for seed in (7, 7, 8):
        robot = DifferentialDriveRobot(PRESETS['2dx'], HALL, np.zeros(3), seed)
        for _ in range(100):
            robot.step(0.2, 0.1, 0.05)
        runs.append(robot.T_odom_base)
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_a_robot_that_stands_still_counts_nothing() -> None:
    robot = DifferentialDriveRobot(PRESETS['3at'], HALL, np.zeros(3), 3)
    for _ in range(50):
        robot.step(0.0, 0.0, 0.05)
    assert np.array_equal(robot.T_odom_base, np.zeros(3))
