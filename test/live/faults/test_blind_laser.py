"""A blind laser on a live graph.

The robot stops, reports the reason, and continues when ranges return.
"""

import math
from array import array

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Twist
from rclpy.action import ActionClient
from sensor_msgs.msg import LaserScan
from support.doctor import Doctor
from support.peers.standing_robot import StandingRobot

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import ExplorationStatus, SlamStatus
from thinmap_ros.ros import qos

pytestmark = pytest.mark.live
NODES = ('localizer', 'grid_mapper', 'topology_builder', 'explorer', 'navigator')


class Relay:
    """Relay between the laser and the nodes, which spoils scans on request."""

    def __init__(self, graph):
        self.spoil = None
        self.spoiled = 0
        self._scans = graph.node.create_publisher(LaserScan, 'scan', qos.STREAM)
        graph.node.create_subscription(LaserScan, 'raw_scan', self._pass_on, qos.STREAM)

    def _pass_on(self, message):
        if self.spoil is not None:
            message.ranges = array('f', self.spoil(np.array(message.ranges)).astype(np.float32))
            self.spoiled += 1
        self._scans.publish(message)

    def whole(self):
        self.spoil = None
        self.spoiled = 0


@pytest.mark.cpu_budget(20.0, 'an exploration that waits')
@pytest.mark.parametrize('values', [(math.nan, 0.0), pytest.param((-1.0,), marks=pytest.mark.slow)])
def test_a_blind_laser_pauses_an_exploration_until_ranges_return(graph, values):
    truth = graph.heard('ground_truth', PoseStamped)
    commands = graph.heard('cmd_vel', Twist)
    targets = graph.heard('exploration_target', PoseStamped, qos.LATCHED)
    statuses = graph.heard('slam_status', SlamStatus)
    doctor = Doctor(graph)
    relay = Relay(graph)
    start = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.9}
    graph.start(
        'thinmap', arguments=NODES, use_sim_time=True, **{'controller.max_speed_m_s': 0.5}, **start
    )
    # Time waits for the nodes, and for the test, through which the scans go.
    graph.start(
        'sim',
        start='2.0,2.0,0.9',
        remap=('scan:=raw_scan',),
        wait_for_subscribers=1,
        lockstep='local_topology',
    )
    client = ActionClient(graph.node, Explore, 'explore')
    graph.send_goal(client, Explore.Goal())
    graph.until(lambda: truth and statuses, 'where it is, and how it stands')

    def place():
        return np.array([truth[-1].pose.position.x, truth[-1].pose.position.y])

    def stands():
        return commands[-1].linear.x == commands[-1].angular.z == 0.0

    def drives_far():
        """Whether it drives, and does not arrive soon: the goal has to outlast the blindness."""
        target = targets[-1].pose.position
        to_go_m = np.hypot(*(place() - (target.x, target.y)))
        return bool(commands) and commands[-1].linear.x > 0.3 and to_go_m > 1.0

    for value in values:
        graph.until(lambda: targets and drives_far(), 'it drives to a place that is not near')
        before = place()
        relay.spoil = lambda ranges, value=value: np.full_like(ranges, value)
        graph.until(lambda: relay.spoiled > 2, 'it has heard of it')
        graph.until(stands, 'it stops')
        commands.clear()
        graph.until(lambda: len(commands) > 10, 'further commands')
        assert all(c.linear.x == c.angular.z == 0.0 for c in commands)
        # Half a second at 0.5 m/s, and then a braking distance of 0.5 m/s^2.
        assert np.hypot(*(place() - before)) < 0.5
        for node in ('navigator', 'localizer'):
            graph.until(lambda n=node: 'blind' in doctor.status(n).message, f'{node} says so')
        graph.until(lambda: statuses[-1].state == SlamStatus.BLIND, 'the status says so')
        relay.whole()
        graph.until(lambda: statuses[-1].state == SlamStatus.TRACKING, 'it tracks again')
    graph.until(lambda: commands[-1].linear.x > 0.3, 'it drives on')


@pytest.mark.cpu_budget(20.0, 'the minute after which an exploration is given up')
def test_with_too_few_beams_an_exploration_fails_and_the_robot_stands(graph):
    commands = graph.heard('cmd_vel', Twist)
    truth = graph.heard('ground_truth', PoseStamped)
    statuses = graph.heard('slam_status', SlamStatus)
    doctor = Doctor(graph)
    start = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.9}
    graph.start('thinmap', arguments=NODES, use_sim_time=True, **start)
    laser = {'beams': 8, 'field_of_view_deg': 360.0}
    graph.start('sim', start='2.0,2.0,0.9', wait_for_subscribers=1, real_time_factor=4.0, **laser)
    client = ActionClient(graph.node, Explore, 'explore')
    handle = graph.send_goal(client, Explore.Goal())
    ended = handle.get_result_async()
    text = 'laser blind (8 valid beams of 8: expected at least 10)'
    graph.until(lambda: text in doctor.status('localizer').message, 'the reason')
    graph.until(ended.done, 'the exploration is given up')
    assert ended.result().status == GoalStatus.STATUS_ABORTED
    assert ended.result().result.status.reason_code == ExplorationStatus.SENSOR_TIMEOUT
    assert {status.state for status in statuses} == {SlamStatus.BLIND}
    assert not any(command.linear.x or command.angular.z for command in commands)
    assert truth[-1].pose == truth[0].pose


class Robot(StandingRobot):
    """With a navigator alone, and a goal ahead."""

    def __init__(self, graph):
        super().__init__(graph)
        self.drive()

    def drive(self):
        """Send the goal again."""
        self.handle = self.drive_to(4.0)

    def until(self, ranges, condition, what):
        self.graph.until(
            lambda: self.stand(ranges) or (self.commands and condition(self.commands[-1])), what
        )


def drives(command):
    return command.linear.x > 0.02


def stands(command):
    return command.linear.x == command.angular.z == 0.0


def test_a_robot_does_not_drive_where_half_of_the_laser_does_not_see(graph):
    graph.start('navigator', laser_pose='0,0,0')
    robot = Robot(graph)
    half = np.full(61, math.inf)
    half[31:] = math.nan
    ended = robot.handle.get_result_async()
    graph.until(lambda: robot.stand(half) or ended.done(), 'the goal is given up')
    assert 'does not see' in ended.result().result.error_msg
    assert robot.commands
    assert not any(drives(command) for command in robot.commands)


def test_a_hall_in_which_nothing_is_near_is_not_blind(graph):
    doctor = Doctor(graph)
    graph.start('navigator', laser_pose='0,0,0')
    robot = Robot(graph)
    for value in (math.inf, 8.0, 81.83):
        robot.until(np.full(61, value), drives, f'it drives where all beams say {value}')
    assert 'blind' not in doctor.status('navigator').message
    near = np.full(61, math.inf)
    robot.until(near, drives, 'it drives')
    near[28:33] = -math.inf
    robot.until(near, stands, 'it stops in front of what is nearer than can be measured')
    robot.drive()
    few = np.full(61, math.nan)
    few[:7] = math.inf
    robot.until(np.full(61, math.inf), drives, 'it drives')
    few[6] = math.nan
    robot.until(few, stands, 'fewer than a tenth of the beams')
    graph.until(
        lambda: robot.stand(few) or 'blind' in doctor.status('navigator').message, 'it says so'
    )


def test_a_robot_stands_while_the_localizer_reports_a_laser_that_confirms_nothing(graph):
    doctor = Doctor(graph)
    graph.start('navigator', laser_pose='0,0,0')
    status = graph.node.create_publisher(SlamStatus, 'slam_status', qos.STREAM)
    robot = Robot(graph)
    free = np.full(61, math.inf)
    robot.until(free, drives, 'it drives')
    blind = SlamStatus(state=SlamStatus.BLIND)
    robot.until(free, lambda c: status.publish(blind) or stands(c), 'it stands')
    graph.until(
        lambda: robot.stand(free) or 'does not confirm' in doctor.status('navigator').message,
        'the reason',
    )
    confirmed = SlamStatus(state=SlamStatus.TRACKING)
    robot.until(free, lambda c: status.publish(confirmed) or drives(c), 'it drives again')


def test_a_laser_that_is_blind_from_the_start_is_reported(graph):
    doctor = Doctor(graph)
    graph.start('navigator', laser_pose='0,0,0')
    robot = Robot(graph)
    blind = np.full(61, math.nan)
    graph.until(
        lambda: robot.stand(blind) or 'blind' in doctor.status('navigator').message, 'it says so'
    )
    assert not any(drives(command) for command in robot.commands)


def test_zero_means_no_return_where_the_preset_says_so(graph):
    doctor = Doctor(graph)
    graph.start('navigator', laser_pose='0,0,0', zero_is_no_return=True)
    robot = Robot(graph)
    robot.until(np.zeros(61), drives, 'it drives')
    robot.until(np.full(61, math.nan), stands, 'NaN is blind all the same')
    graph.until(lambda: 'blind' in doctor.status('navigator').message, 'it says so')
