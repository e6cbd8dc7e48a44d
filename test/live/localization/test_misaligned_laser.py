"""A laser that slips on its mount, on a live graph: the robot stops and names the reason."""

from array import array

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from sensor_msgs.msg import LaserScan
from support.doctor import Doctor
from support.peers.standing_robot import StandingRobot

from thinmap_msgs.msg import SlamStatus
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.diagnostics import ERROR, WARN

pytestmark = pytest.mark.live
NODES = ('localizer', 'grid_mapper', 'topology_builder', 'navigator')
BEAMS = 360
# In sight of the start, and of each other.
PLACES = ((6.5, 3.6), (2.0, 5.0))


class Mount:
    """Relay between a laser all round and the nodes; it turns the laser on request."""

    def __init__(self, graph):
        self.turned_deg = 0
        self.is_mirrored = False
        self._scans = graph.node.create_publisher(LaserScan, 'scan', qos.STREAM)
        graph.node.create_subscription(LaserScan, 'raw_scan', self._pass_on, qos.STREAM)

    def _pass_on(self, message):
        ranges = np.roll(np.array(message.ranges), -self.turned_deg)
        # Beam 0 points backwards.
        ranges = np.roll(ranges[::-1], 1) if self.is_mirrored else ranges
        message.ranges = array('f', ranges.astype(np.float32))
        self._scans.publish(message)


class Robot:
    """A robot that drives back and forth between two places of a room."""

    def __init__(self, graph):
        self.graph = graph
        self.commands = graph.heard('cmd_vel', Twist)
        self.statuses = graph.heard('slam_status', SlamStatus)
        self.doctor = Doctor(graph)
        self.mount = Mount(graph)
        self._client = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')
        self._result = None
        self._goals = 0
        start = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.9}
        speed = {'controller.max_speed_m_s': 0.5}
        graph.start('thinmap', arguments=NODES, use_sim_time=True, **speed, **start)
        laser = {'beams': BEAMS, 'field_of_view_deg': 360.0, 'range_max_m': 20.0}
        # Time waits for the nodes, and for the test, through which the scans go.
        graph.start(
            'sim',
            start='2.0,2.0,0.9',
            remap=('scan:=raw_scan',),
            wait_for_subscribers=1,
            lockstep='local_topology',
            **laser,
        )
        graph.until(lambda: self.statuses, 'a status')

    def drives(self):
        """Send the next goal where the last one is over; whether the robot moves."""
        if self._result is None or self._result.done():
            x, y = PLACES[self._goals % 2]
            self._goals += 1
            pose = messages.pose_stamped_msg(np.array([x, y, 0.0]), 'map', 0)
            handle = self.graph.send_goal(self._client, NavigateToPose.Goal(pose=pose))
            self._result = handle.get_result_async()
        return bool(self.commands) and self.commands[-1].linear.x > 0.3

    def state(self):
        return self.statuses[-1].state

    def until(self, condition, what):
        """Drive on until a condition holds."""
        self.graph.until(lambda: [self.drives(), condition()][1], what)


def test_a_robot_stops_once_its_laser_has_slipped(graph):
    robot = Robot(graph)
    robot.until(robot.drives, 'it drives')
    robot.mount.turned_deg = 35
    robot.until(lambda: robot.state() == SlamStatus.MISALIGNED, 'the status')
    graph.until(lambda: robot.commands[-1] == Twist(), 'it stands')
    robot.commands.clear()
    robot.until(lambda: len(robot.commands) > 10, 'further commands')
    assert all(command == Twist() for command in robot.commands)
    for node, text in (('localizer', 'laser turned by'), ('navigator', 'laser misaligned')):
        graph.until(lambda n=node, t=text: t in robot.doctor.status(n).message, f'{node} says so')
    assert robot.doctor.level('localizer') == ERROR


def test_a_small_turn_of_the_laser_is_a_warning_and_the_robot_drives_on(graph):
    robot = Robot(graph)
    robot.mount.turned_deg = 12
    robot.until(
        lambda: 'laser turned by' in robot.doctor.status('localizer').message, 'the warning'
    )
    assert robot.doctor.level('localizer') == WARN
    robot.until(robot.drives, 'it drives')
    assert robot.state() == SlamStatus.TRACKING


def test_a_mirrored_laser_is_a_warning(graph):
    robot = Robot(graph)
    robot.mount.is_mirrored = True
    robot.until(
        lambda: 'scans turn against' in robot.doctor.status('localizer').message, 'the warning'
    )


def test_a_robot_stands_while_the_localizer_reports_a_misaligned_laser(graph):
    doctor = Doctor(graph)
    graph.start('navigator', laser_pose='0,0,0')
    status = graph.node.create_publisher(SlamStatus, 'slam_status', qos.STREAM)
    robot = StandingRobot(graph)
    robot.drive_to(4.0)

    def until(state, condition, what):
        def step():
            robot.stand()
            status.publish(SlamStatus(state=state))
            return bool(robot.commands) and condition(robot.commands[-1])

        graph.until(step, what)

    until(SlamStatus.TRACKING, lambda command: command.linear.x > 0.02, 'it drives')
    until(SlamStatus.MISALIGNED, lambda command: command == Twist(), 'it stands')
    graph.until(
        lambda: robot.stand() or 'laser misaligned' in doctor.status('navigator').message, 'why'
    )
    until(SlamStatus.TRACKING, lambda command: command.linear.x > 0.02, 'it drives again')
