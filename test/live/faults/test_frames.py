"""Frames and transforms that do not fit, on a live graph: refused and named, and nothing moves."""

import math

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan
from support.doctor import Doctor
from support.slam_room import ROOM, scan_in
from tf2_msgs.msg import TFMessage

from thinmap_msgs.msg import SlamStatus
from thinmap_ros.core import se2
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
PERIOD_S = 0.05
HERE = se2.pose(2.0, 2.0, 0.3)
AT_HERE = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.3}
MOUNT = np.zeros(3)
COVARIANCE = np.diag([0.04, 0.04, 0.01])


class StandingRobot:
    """A robot that stands in a room, with the frames that its odometry and its laser have."""

    def __init__(self, graph):
        self.graph = graph
        self.frames = ('odom', 'base_link')
        self.doctor = Doctor(graph)
        self.poses = graph.heard('pose', PoseWithCovarianceStamped)
        self.status = graph.heard('slam_status', SlamStatus)
        node = graph.node
        self._rng = np.random.default_rng(3)
        self._odometry = node.create_publisher(Odometry, 'odom', qos.STREAM)
        self._scan = node.create_publisher(LaserScan, 'scan', qos.STREAM)
        self._static = node.create_publisher(TFMessage, '/tf_static', qos.STATIC_TRANSFORMS)
        self._initial = node.create_publisher(PoseWithCovarianceStamped, 'initialpose', 10)
        node.create_timer(PERIOD_S, self._publish)

    def _publish(self):
        ns = self.graph.node.get_clock().now().nanoseconds
        self._odometry.publish(messages.odometry_msg(np.zeros(3), (0.0, 0.0), self.frames, ns))
        scan = scan_in(ROOM, HERE, self._rng, ns)
        self._scan.publish(messages.scan_msg(scan, 'laser', PERIOD_S))

    def connect(self, parent, child, T):
        """Publish a static transform."""
        transform = messages.transform_msg(np.array(T), parent, child, 0)
        self._static.publish(TFMessage(transforms=[transform]))

    def place(self, message):
        """Publish an initial pose."""
        self.graph.until(self._initial.get_subscription_count, 'a subscriber of initialpose')
        self._initial.publish(message)

    def localized(self, count=5):
        """The next poses (N, 3)."""
        self.poses.clear()
        self.graph.until(lambda: len(self.poses) >= count, 'poses')
        return np.array([messages.pose_from_msg(message.pose.pose) for message in self.poses])

    def is_tracking(self):
        """Whether the next states are all TRACKING."""
        self.status.clear()
        self.graph.until(lambda: len(self.status) >= 5, 'states')
        return {message.state for message in self.status} == {SlamStatus.TRACKING}

    def rejected(self, topic, count):
        """Wait until so many messages of a topic are counted as rejected."""
        key = f'{topic}: rejected'
        self.graph.until(
            lambda: self.doctor.number('localizer', key) >= count, f'{count} rejected {topic}'
        )


def errors_m(poses):
    return np.hypot(*(poses - HERE)[:, :2].T)


def initial_pose(T=HERE, frame='map', covariance=COVARIANCE):
    return messages.pose_with_covariance_msg(np.array(T), covariance, frame, 0)


def test_odometry_of_other_frames_is_refused_unless_static_transforms_connect_them(graph):
    robot = StandingRobot(graph)
    graph.start('localizer', laser_pose='0,0,0', **AT_HERE)
    assert errors_m(robot.localized()).max() < 0.05
    for frames, text in (
        (('wheels', 'base_link'), "odom: frame_id 'wheels': expected 'odom' (odom_frame)"),
        (('odom', 'camera'), "odom: child_frame_id 'camera': expected 'base_link' (base_frame)"),
    ):
        robot.frames = frames
        before = robot.doctor.number('localizer', 'odom: rejected')
        robot.rejected('odom', before + 5)
        graph.until(lambda t=text: t in graph.log('localizer'), 'it is named')
        graph.drain()
        robot.poses.clear()
        robot.rejected('odom', before + 25)
        # Scans that had their odometry before the change may still have been processed.
        assert len(robot.poses) <= 2
    robot.frames = ('odom', '')
    assert errors_m(robot.localized()).max() < 0.05
    graph.until(lambda: 'odom: child_frame_id is empty' in graph.log('localizer'), 'a note')
    robot.frames = ('odom', 'base_footprint')
    robot.connect('base_footprint', 'base_link', (0.0, 0.0, 0.0))
    assert errors_m(robot.localized()).max() < 0.05


def test_an_initial_pose_that_cannot_be_is_refused_and_the_robot_stays_where_it_is(graph):
    robot = StandingRobot(graph)
    graph.start('localizer', laser_pose='0,0,0', **AT_HERE)
    assert errors_m(robot.localized()).max() < 0.05
    no_number = initial_pose()
    no_number.pose.pose.position.x = math.nan
    no_rotation = initial_pose()
    no_rotation.pose.pose.orientation = Quaternion(z=0.5, w=0.1)
    no_covariance = initial_pose()
    no_covariance.pose.covariance[0] = math.nan
    negative = initial_pose(covariance=np.diag([0.04, -1.0, 0.01]))
    wrong = (
        (initial_pose(frame='moon'), "frame 'moon'"),
        (initial_pose((100e3, 100e3, 0.0)), 'expected a place in the map or within # m of it'),
        (initial_pose((2.0, -45.0, 0.0)), 'expected a place in the map or within # m of it'),
        (no_number, 'position: #'),
        (no_rotation, 'expected norm #'),
        (no_covariance, 'covariance: #'),
        (negative, 'expected no negative eigenvalue'),
    )
    for count, (message, text) in enumerate(wrong, start=1):
        robot.place(message)
        robot.rejected('initialpose', count)
        keys = [pair.key for pair in robot.doctor.status('localizer').values]
        assert any(key.startswith('initialpose: rejected: ') and text in key for key in keys), keys
        assert errors_m(robot.localized()).max() < 0.05, text
    assert robot.is_tracking()
    assert 'localizer]: initialpose: frame' in graph.log('localizer')
    # Near, and as exact as it says: it is believed, and the next scans correct it.
    robot.place(initial_pose(HERE + (0.1, 0.0, 0.0)))
    graph.until(robot.is_tracking, 'tracking again')
    assert errors_m(robot.localized()).max() < 0.05


def test_a_laser_whose_static_transform_changes_keeps_the_first_one_until_the_restart(graph):
    robot = StandingRobot(graph)
    robot.connect('base_link', 'laser', MOUNT)
    graph.start('localizer', **AT_HERE)
    assert errors_m(robot.localized()).max() < 0.05
    # Scans may have come before the transform.
    graph.until(lambda: 'laser' not in robot.doctor.status('localizer').message, 'all is well')
    robot.connect('base_link', 'laser', MOUNT + (0.001, 0.0, 0.0))
    updates = robot.doctor.times('localizer') + 2
    graph.until(lambda: robot.doctor.times('localizer') >= updates, 'diagnostics')
    assert 'laser' not in robot.doctor.status('localizer').message
    robot.connect('base_link', 'laser', MOUNT + (2.2, 0.0, 0.0))
    text = "static transform of laser 'laser' has changed by 2.20 m, 0.00 rad"
    graph.until(lambda: text in robot.doctor.status('localizer').message, 'it is reported')
    graph.until(lambda: text in graph.log('localizer'), 'it is logged')
    assert errors_m(robot.localized(10)).max() < 0.05
    assert robot.is_tracking()
    # The first one again: nothing to report.
    robot.connect('base_link', 'laser', MOUNT)
    graph.until(lambda: 'laser' not in robot.doctor.status('localizer').message, 'all is well')
