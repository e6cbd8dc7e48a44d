"""What a navigator commands while it knows everything, and while it must not drive."""

from time import monotonic
from types import SimpleNamespace

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from rclpy.time import Time
from support.halls import empty_hall
from support.timeouts import PATIENCE_S

from thinmap_msgs.msg import SlamStatus
from thinmap_ros.core.planning.navigator import CONTROL_PERIOD_S
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import pose
from thinmap_ros.nodes.navigator import NavigatorNode
from thinmap_ros.ros import messages
from thinmap_ros.ros.diagnostics import ERROR
from thinmap_ros.sim.robot import after_arc

pytestmark = pytest.mark.live
STEP_NS = round(1e9 * CONTROL_PERIOD_S)


class Driven:
    """A navigator in the middle of a hall, with a goal, and the messages that it receives."""

    def __init__(self, node):
        self.node = node
        self.now_ns = 10**9
        self.silent = set()
        self.poses = 1
        self.fast = 1.0
        self.late_ns = 0
        self.T = np.zeros(3)
        node._map._on_map(messages.grid_from_msg(empty_hall()))
        node._drive_to((pose(4.0, 0.0, 0.0),))

    def step(self, count=1):
        """Commands of the next control periods, of which the robot obeys each."""
        for _ in range(count):
            self._pass_time()
            self._publish()
            command = self.node._command()
            if command is not None:
                self.node._output.command(command.v, command.w)
                moved = (self.fast * command.v * CONTROL_PERIOD_S, command.w * CONTROL_PERIOD_S)
                self.T = after_arc(self.T, *moved)
        return command

    def creep(self, seconds, v):
        """Let the base move at v m/s, whatever it was told."""
        for _ in range(round(seconds / CONTROL_PERIOD_S)):
            self._pass_time()
            self.T = after_arc(self.T, v * CONTROL_PERIOD_S, 0.0)
            self._publish()

    def _pass_time(self):
        self.now_ns += STEP_NS
        clock = self.node.get_clock()
        clock.set_ros_time_override(Time(nanoseconds=self.now_ns, clock_type=clock.clock_type))

    def _publish(self):
        T = self.T
        if 'odometry' not in self.silent:
            frames = ('odom', 'base_link')
            odometry = messages.odometry_msg(T, (0.0, 0.0), frames, self.now_ns - self.late_ns)
            self.node._odometry._on_odometry(odometry)
        if 'laser' not in self.silent:
            noise = 0.01 * np.random.default_rng(self.now_ns).standard_normal(61)
            scan = Scan.create(self.now_ns, 6.0 + noise, -1.5, 0.05, 0.05, 8.0)
            self.node._on_scan('scan', messages.scan_msg(scan, 'laser', CONTROL_PERIOD_S))
        if 'localizer' not in self.silent:
            message = messages.pose_with_covariance_msg(T, np.eye(3), 'map', self.now_ns)
            for _ in range(self.poses):
                self.node._on_pose(message)


@pytest.fixture
def driven(ros_domain):
    arguments = ['use_sim_time:=true', 'laser_pose:=0,0,0']
    values = [word for argument in arguments for word in ('-p', argument)]
    rclpy.init(args=['--ros-args', *values], domain_id=ros_domain)
    node = NavigatorNode()
    node.start()
    yield Driven(node)
    node.close()
    node.destroy_node()
    rclpy.try_shutdown()


def test_it_drives_with_all_inputs_and_waits_without_one(driven):
    driven.silent = {'localizer'}
    assert driven.step() is None
    driven.silent = set()
    command = driven.step(20)
    assert command.state == 'driving'
    assert command.v == pytest.approx(driven.node._config.controller.max_speed_m_s)


@pytest.mark.parametrize(('source', 'steps'), [('laser', 6), ('odometry', 6), ('localizer', 32)])
def test_a_silent_input_stops_it_at_once_and_it_starts_anew(driven, source, steps):
    driven.step(20)
    driven.silent = {source}
    command = driven.step(steps)
    assert (command.v, command.w, command.state) == (0.0, 0.0, 'blocked')
    assert command.reason.startswith(f'{source} silent for ')
    assert command.reason.endswith(': standing still')
    driven.silent = set()
    command = driven.step()
    assert command.state == 'driving'
    assert 0.0 < command.v < 0.1


def test_the_state_of_the_localizer_stops_it(driven):
    driven.step(20)
    for state, reason in (
        (SlamStatus.LOST, 'lost (the place of the robot in the map is unknown)'),
        (SlamStatus.BLIND, 'laser blind (it does not confirm the pose)'),
        (SlamStatus.MISALIGNED, 'laser misaligned (turned on the robot)'),
        (SlamStatus.NO_MAP, 'the localizer has no map'),
    ):
        driven.node._on_slam_status(SlamStatus(state=state))
        command = driven.step()
        assert (command.v, command.w, command.state) == (0.0, 0.0, 'blocked')
        assert command.reason == f'{reason}: standing still'
    # A robot that maps apart has to drive to find its place.
    for state in (SlamStatus.TRACKING, SlamStatus.MAPPING_APART):
        driven.node._on_slam_status(SlamStatus(state=state))
        assert driven.step().state == 'driving'


def test_a_pose_in_another_map_than_the_grid_stops_it(driven):
    driven.step(20)
    grid = messages.probability_grid_msg(messages.grid_from_msg(empty_hall()), 'map', 0, map_id=7)
    driven.node._map._on_grid(grid)
    driven.node._on_slam_status(SlamStatus(state=SlamStatus.TRACKING, map_id=8))
    assert driven.step().reason.startswith('the pose is in another map than the one on grid')
    driven.node._on_slam_status(SlamStatus(state=SlamStatus.TRACKING, map_id=7))
    assert driven.step().state == 'driving'


@pytest.fixture
def other(driven):
    """Another node of the graph."""
    node = rclpy.create_node('other')
    yield node
    node.destroy_node()


def diagnose(driven):
    """Level and message of /diagnostics."""
    status = driven.node.diagnostics._status(0.0)
    return status.level, status.message


def test_two_localizers_stop_it_and_a_dead_one_does_not(driven, other):
    """A localizer that was killed is known for a while beside the one that replaces it."""
    assert all(other.create_publisher(PoseWithCovarianceStamped, 'pose', 1) for _ in range(2))
    driven.step(20)
    diagnose(driven)
    assert driven.step().state == 'driving'
    driven.poses = 2
    driven.step(5)
    level, message = diagnose(driven)
    assert level == ERROR and message.startswith('2 nodes publish /pose: ')
    command = driven.step()
    assert (command.v, command.w, command.state) == (0.0, 0.0, 'blocked')
    assert command.reason.startswith('2 nodes publish /pose: ')
    driven.poses = 1
    driven.step(30)
    diagnose(driven)
    assert driven.step().state == 'driving'


def test_a_base_that_is_too_fast_is_an_error_until_a_stop_is_released(driven, other):
    assert other.create_subscription(Twist, 'cmd_vel', print, 1)
    driven.fast = 4.0
    driven.step(30)
    level, message = diagnose(driven)
    assert level == ERROR and message.startswith('the base moves at 0.')
    assert 'm/s: no goal is driven before ' in message
    driven.fast = 1.0
    driven.step(30)
    assert diagnose(driven)[0] == ERROR
    for reason in ('somebody says true', ''):
        driven.node._on_stop(SimpleNamespace(reason=reason))
    driven.step(30)
    assert diagnose(driven)[0] != ERROR


def test_the_motion_of_a_base_that_others_drive_too_is_nobodys_fault(driven, other):
    assert other.create_publisher(Twist, 'cmd_vel', 1)
    driven.fast = 4.0
    driven.step(30)
    assert diagnose(driven)[0] != ERROR


def commands_of_idle(driven, other, heard):
    """Commands of the next two seconds without a goal."""
    known = -1
    while len(heard) > known:
        known = len(heard)
        rclpy.spin_once(other, timeout_sec=0.1)
    heard.clear()
    for _ in range(20):
        driven.node._control()
        rclpy.spin_once(other, timeout_sec=0.05)
    return [(command.linear.x, command.angular.z) for command in heard]


def test_a_base_that_is_discovered_is_told_to_stand_and_one_that_creeps_as_long_as_it_does(
    driven, other
):
    heard = []
    assert other.create_subscription(Twist, 'cmd_vel', heard.append, 10)
    end_s = monotonic() + PATIENCE_S
    while not driven.node.count_subscribers('cmd_vel') and monotonic() < end_s:
        rclpy.spin_once(other, timeout_sec=0.05)
    told = commands_of_idle(driven, other, heard)
    assert 0 < len(told) <= 10 and set(told) == {(0.0, 0.0)}
    assert not commands_of_idle(driven, other, heard)
    driven.node._look()
    assert driven.node._timer.is_canceled()
    driven.step(50)
    driven.node._output.command(0.0, 0.0)
    driven.creep(4.0, 0.0)
    assert diagnose(driven)[0] != ERROR
    driven.creep(3.0, 0.15)
    level, message = diagnose(driven)
    assert level == ERROR
    assert message.startswith('the base moves at 0.1') and message.endswith(
        ', and is commanded to stand'
    )
    driven.node._look()
    assert not driven.node._timer.is_canceled()
    told = commands_of_idle(driven, other, heard)
    assert len(told) > 10 and set(told) == {(0.0, 0.0)}
    driven.creep(3.0, 0.0)
    assert diagnose(driven)[0] != ERROR
    assert not commands_of_idle(driven, other, heard)


def test_motion_that_odometry_reports_late_is_no_creeping(driven, other):
    assert other.create_subscription(Twist, 'cmd_vel', print, 1)
    driven.step(20)
    driven.node._output.command(0.0, 0.0)
    driven.silent = {'odometry'}
    driven.creep(4.0, 0.0)
    driven.silent = set()
    driven.late_ns = 4 * 10**9
    driven.creep(4.0, 0.15)
    assert diagnose(driven)[0] != ERROR
