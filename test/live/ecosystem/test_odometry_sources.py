"""The localizer with odometry as robots offer it, and the transforms that others look up."""

import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from support.doctor import Doctor
from support.peers.transform_client import TransformClient
from tf2_msgs.msg import TFMessage

from thinmap_msgs.msg import SlamStatus
from thinmap_ros.core import se2
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
START = se2.pose(5.0, 2.0, 0.0)
AT_START = {'initial_x_m': 5.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.0}
DRIVEN_M = 3.0


class Drive:
    """A simulated robot that drives a curve, with true and estimated poses by their stamps.

    It waits for the pose of each scan, so that no result depends on the load of the machine.
    """

    def __init__(self, graph, remap=(), rate=4.0):
        self.graph = graph
        self._truth = {}
        self._poses = {}
        graph.node.create_subscription(PoseStamped, 'ground_truth', self._on_truth, 100)
        graph.node.create_subscription(PoseWithCovarianceStamped, 'pose', self._on_pose, 100)
        self._commands = graph.node.create_publisher(Twist, 'cmd_vel', 10)
        graph.start(
            'sim',
            remap=remap,
            world='office',
            start='5.0,2.0,0.0',
            wait_for_subscribers=1,
            lockstep='pose',
            real_time_factor=rate,
        )

    def _on_truth(self, message):
        self._truth[messages.stamp_ns(message.header.stamp)] = messages.pose_from_msg(message.pose)

    def _on_pose(self, message):
        ns = messages.stamp_ns(message.header.stamp)
        self._poses[ns] = messages.pose_from_msg(message.pose.pose)

    def now_ns(self):
        """The newest simulated time that was received."""
        return max(self._truth)

    def command(self, v=0.3, w=0.2):
        self._commands.publish(messages.twist_msg(v, w))

    def estimates(self):
        """Pairs of estimated and true poses."""
        both = sorted(self._poses.keys() & self._truth.keys())
        return [(self._poses[ns], self._truth[ns]) for ns in both]

    def driven_m(self):
        path = np.array([true for _, true in self.estimates()]).reshape(-1, 3)
        return float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum())

    def error_m(self):
        """Root mean square error after the drive."""
        # The localizer starts at its initial pose whenever its first scan comes.
        self.graph.until(self.estimates, 'the localizer receives scans')

        def has_arrived():
            self.command()
            return self.driven_m() > DRIVEN_M

        self.graph.until(has_arrived, 'the robot drives, and is localized')
        self.command(0.0, 0.0)
        errors = [se2.between(estimated, true)[:2] for estimated, true in self.estimates()]
        return float(np.sqrt(np.square(errors).sum(axis=1).mean()))


def test_best_effort_odometry_is_received(graph):
    doctor = Doctor(graph)
    best_effort = graph.node.create_publisher(Odometry, 'odom', BEST_EFFORT)
    graph.node.create_subscription(Odometry, 'wheels', best_effort.publish, 50)
    graph.start('localizer', use_sim_time=True, **AT_START)
    assert Drive(graph, remap=('odom:=wheels',)).error_m() < 0.05
    graph.until(
        lambda: 'best_effort' in doctor.value('localizer', 'odom: subscribed'), 'it is reported'
    )


def test_reliable_and_best_effort_publishers_are_both_received(graph):
    graph.start('localizer', use_sim_time=True, **AT_START)
    drive = Drive(graph)
    assert drive.error_m() < 0.05
    doctor = Doctor(graph)
    graph.node.create_publisher(Odometry, 'odom', BEST_EFFORT)
    graph.until(lambda: 'best_effort' in doctor.value('localizer', 'odom: subscribed'), 'it adapts')
    count = len(drive.estimates())
    graph.until(lambda: len(drive.estimates()) > count + 5, 'poses by the reliable odometry')


def test_a_latched_map_is_received_from_a_publisher_that_does_not_latch(graph):
    volatile = graph.node.create_publisher(
        messages.OccupancyGrid, 'map', QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
    )
    doctor = Doctor(graph)
    graph.start('navigator', laser_pose='0,0,0')
    graph.until(lambda: 'volatile' in doctor.value('navigator', 'map: subscribed'), 'it adapts')
    message = messages.OccupancyGrid()
    message.info.resolution = 0.05
    graph.until(
        lambda: volatile.publish(message) or doctor.number('navigator', 'map: received'), 'a map'
    )


def test_odometry_is_taken_from_tf(graph):
    graph.start('localizer', use_sim_time=True, odom_source='tf', **AT_START)
    drive = Drive(graph, remap=('odom:=unheard',))
    client = TransformClient(graph)
    assert drive.error_m() < 0.05
    assert client.chain('map', 'laser') == ['laser', 'base_link', 'odom']
    doctor = Doctor(graph)
    graph.until(
        lambda: doctor.value('localizer', 'odometry by TF') == 'received', 'it reports its source'
    )


def test_what_is_missing_of_odometry_by_tf_is_reported(graph):
    doctor = Doctor(graph)
    graph.start('localizer', laser_pose='0,0,0', odom_source='tf', odom_frame='wheels')
    graph.until(
        lambda: (
            "frame 'wheels', 'base_link' is not on /tf"
            in doctor.value('localizer', 'odometry by TF')
        ),
        'the missing frames by name',
    )


def test_a_robot_without_odometry_is_followed(graph):
    graph.start('localizer', use_sim_time=True, odom_source='none', **AT_START)
    drive = Drive(graph, remap=('odom:=unheard', '/tf:=/wheels_tf'))
    client = TransformClient(graph)
    assert drive.error_m() < 0.10
    assert client.chain('map', 'laser') == ['laser', 'base_link', 'odom'], 'a complete tree'


def test_another_node_may_publish_the_transform(graph):
    graph.start('localizer', use_sim_time=True, publish_tf=False, **AT_START)
    drive = Drive(graph)
    client = TransformClient(graph)
    assert drive.error_m() < 0.05
    assert client.chain('odom', 'laser') and client.chain('map', 'odom') is None


def test_best_effort_transforms_are_received(graph):
    transforms = graph.node.create_publisher(TFMessage, '/tf', BEST_EFFORT)
    graph.node.create_subscription(TFMessage, '/wheels_tf', transforms.publish, 50)
    graph.start('localizer', use_sim_time=True, odom_source='tf', **AT_START)
    assert Drive(graph, remap=('odom:=unheard', '/tf:=/wheels_tf')).error_m() < 0.05


def test_a_quality_of_service_that_does_not_match_is_named(graph):
    doctor = Doctor(graph)
    graph.node.create_publisher(TFMessage, '/tf_static', BEST_EFFORT)
    status = QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )
    graph.node.create_subscription(SlamStatus, 'slam_status', print, status)
    graph.start('localizer', laser_pose='0,0,0')
    graph.until(
        lambda: (
            doctor.value('localizer', 'slam_status: subscribers')
            == '0 (and 1 with incompatible QoS: volatile offered, transient local requested)'
        ),
        'the subscription that receives nothing',
    )
    graph.start('navigator')
    graph.until(
        lambda: (
            doctor.value('navigator', 'tf_static: publishers')
            == '0 (and 1 with incompatible QoS: best effort offered, reliable requested, '
            'volatile offered, transient local requested)'
        ),
        'the publisher that is not received',
    )


@pytest.mark.parametrize('seconds', [15.0, pytest.param(60.0, marks=pytest.mark.slow)])
def test_every_lookup_at_the_present_time_succeeds(graph, seconds):
    """By tf2's rules, every 20 ms: map -> odom now, and map -> laser at the newest odometry.

    The simulation waits for the test, too: it is never more than a scan ahead of what is received.
    """
    graph.start('localizer', use_sim_time=True, **AT_START)
    client = TransformClient(graph)
    # Half as fast: in time for each sample of the odometry, too, while the machine is busy.
    drive = Drive(graph, remap=graph.paced('pose', PoseWithCovarianceStamped), rate=0.5)
    graph.until(drive.estimates, 'poses')
    graph.until(lambda: not client.failure('map', 'odom', drive.now_ns()), 'the first transforms')
    end_ns = drive.now_ns() + round(1e9 * seconds)
    failures = []
    lookups = 0

    def has_ended():
        nonlocal lookups
        drive.command(0.2, 0.3)
        due_s = time.monotonic() + 0.02
        while time.monotonic() < due_s:
            graph.executor.spin_once(timeout_sec=0.005)
        failures.append(client.failure('map', 'odom', drive.now_ns()))
        failures.append(client.failure('map', 'laser', client.newest_ns('base_link')))
        lookups += 1
        return drive.now_ns() > end_ns

    graph.until(has_ended, 'the end of the drive')
    assert lookups > 10 * seconds, 'at least one for each scan'
    assert not any(failures), [failure for failure in failures if failure][:5]


def test_a_late_subscriber_gets_the_last_pose(graph):
    graph.start('localizer', use_sim_time=True, **AT_START)
    drive = Drive(graph)
    assert drive.error_m() < 0.05
    graph.stop('sim')
    late = graph.heard('pose', PoseWithCovarianceStamped, qos.LATCHED)
    graph.until(lambda: late, 'the last pose')
    assert len(late) == 1
