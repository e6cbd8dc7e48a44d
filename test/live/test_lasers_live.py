"""A robot with two lasers on two topics: both are used, and one that fails is named."""

from array import array

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from sensor_msgs.msg import LaserScan
from support.doctor import Doctor
from tf2_msgs.msg import TFMessage

from thinmap_msgs.msg import LocalizationStatus, LocalizedScan, SlamStatus
from thinmap_ros.core.se2 import pose
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
NODES = ('localizer', 'grid_mapper', 'topology_builder', 'navigator')
TOPICS = ['front/scan', 'rear/scan']
BEAMS = 360
FIELD = slice(45, 316)  # of 270 degrees ahead; beam 0 points backwards
PLACES = ((6.5, 3.6), (2.0, 5.0))


def publish_static(graph, *transforms):
    publisher = graph.node.create_publisher(TFMessage, '/tf_static', qos.STATIC_TRANSFORMS)
    publisher.publish(TFMessage(transforms=transforms))


class TwoLasers:
    """Relay that makes scans of two lasers, one looking back, of those of one all round.

    Each has every second scan. is_rear_silent: the other one has all of them.
    """

    def __init__(self, graph):
        self.is_rear_silent = False
        self._count = 0
        self._scans = [
            graph.node.create_publisher(LaserScan, topic, qos.SENSOR) for topic in TOPICS
        ]
        turns = {'front': 0.0, 'rear': np.pi}
        publish_static(
            graph,
            *(
                messages.transform_msg(pose(0.0, 0.0, turn), 'laser', frame, 0)
                for frame, turn in turns.items()
            ),
        )
        graph.node.create_subscription(LaserScan, 'raw_scan', self._pass_on, qos.STREAM)

    def _pass_on(self, message):
        self._count += 1
        is_rear = 0 if self.is_rear_silent else self._count % 2
        ranges = np.roll(np.array(message.ranges, dtype=np.float32), BEAMS // 2 * is_rear)[FIELD]
        message.header.frame_id = 'rear' if is_rear else 'front'
        message.angle_min += FIELD.start * message.angle_increment
        message.angle_max = message.angle_min + (ranges.size - 1) * message.angle_increment
        message.ranges = array('f', ranges)
        self._scans[is_rear].publish(message)


class Robot:
    """A robot that drives back and forth between two places of a room."""

    def __init__(self, graph):
        self.graph = graph
        self.commands = graph.heard('cmd_vel', Twist)
        self.statuses = graph.heard('slam_status', SlamStatus)
        self.localized = graph.heard('localized_scan', LocalizedScan)
        self.doctor = Doctor(graph)
        self.lasers = TwoLasers(graph)
        self._client = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')
        self._result = None
        self._goals = 0
        start = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.9}
        graph.start('thinmap', arguments=NODES, use_sim_time=True, scan_topic=TOPICS, **start)
        laser = {'beams': BEAMS, 'field_of_view_deg': 360.0, 'scan_rate_hz': 10.0}
        graph.start(
            'sim',
            start='2.0,2.0,0.9',
            remap=('scan:=raw_scan', *graph.paced()),
            wait_for_subscribers=0,
            lockstep='local_topology',
            **laser,
        )
        graph.until(lambda: self.statuses, 'a status')

    def drives(self):
        """Send the next goal where the last one is over; whether the robot moves."""
        if self._result is None or self._result.done():
            x, y = PLACES[self._goals % 2]
            self._goals += 1
            goal = messages.pose_stamped_msg(np.array([x, y, 0.0]), 'map', 0)
            handle = self.graph.send_goal(self._client, NavigateToPose.Goal(pose=goal))
            self._result = handle.get_result_async()
        return bool(self.commands) and self.commands[-1].linear.x > 0.1

    def frames(self):
        """Frames of the lasers of the last scans that are localized."""
        return {message.scan.header.frame_id for message in self.localized[-6:]}

    def is_told(self, node, words):
        return words in self.doctor.status(node).message


def test_both_lasers_are_used_and_one_that_ends_is_named_and_stops_the_robot(graph):
    robot = Robot(graph)
    graph.until(robot.drives, 'it drives')
    graph.until(lambda: robot.frames() == {'front', 'rear'}, 'a pose for each scan of both')
    assert robot.statuses[-1].state == SlamStatus.TRACKING
    robot.lasers.is_rear_silent = True
    graph.until(lambda: robot.is_told('navigator', 'rear/scan silent for'), 'why it stands')
    graph.until(lambda: robot.commands[-1] == Twist(), 'it stands')
    graph.until(lambda: robot.is_told('localizer', 'rear/scan: silent for'), 'which one is silent')
    robot.localized.clear()
    graph.until(lambda: len(robot.localized) > 10, 'poses by the other one')
    assert robot.frames() == {'front'}
    assert robot.statuses[-1].state == SlamStatus.TRACKING
    assert 'rear/scan silent for' in graph.log('thinmap')
    robot.lasers.is_rear_silent = False
    graph.until(robot.drives, 'it drives again')


def test_a_search_waits_for_all_lasers(graph):
    found = graph.heard('localization_status', LocalizationStatus, qos.LATCHED)
    graph.start('global_localizer', scan_topic=TOPICS, start_automatically=True)
    graph.until(lambda: found and 'odom' in found[-1].reason, 'a status')
    assert found[-1].reason == 'waits for map, topology, odom, front/scan, rear/scan'


@pytest.mark.parametrize(
    ('values', 'said'),
    [
        (
            {'scan_topic': 3},
            'scan_topic of node localizer: 3: expected a text, or a list',
        ),
        ({'scan_topic': ['scan', 'scan']}, "['scan', 'scan']: expected a text, or a list of diff"),
        ({'scan_topic': [1, 2]}, '[1, 2]'),
        ({'scan_topic': ['scan', '/scan']}, 'expected different topics'),
        ({'scan_topic': TOPICS, 'laser_pose': '0,0,0'}, 'expected no pose'),
    ],
)
def test_wrong_topics_end_the_start_with_one_clear_line(graph, values, said):
    process = graph.start('localizer', **values)
    assert graph.ended(process) == 2
    assert said in graph.log('localizer').strip().splitlines()[-1]
    assert 'Traceback' not in graph.log('localizer')


def test_two_lasers_in_one_frame_are_refused_by_the_second_topic(graph):
    publish_static(graph, messages.transform_msg(np.zeros(3), 'base_link', 'laser', 0))
    front, rear = (graph.node.create_publisher(LaserScan, each, qos.SENSOR) for each in TOPICS)
    graph.start('localizer', scan_topic=TOPICS)
    message = LaserScan(angle_increment=0.01, range_min=0.05, range_max=8.0, ranges=[2.0] * 99)
    message.header.frame_id = 'laser'

    def until(words, *publishers):
        def publish():
            message.header.stamp.sec += 1
            for publisher in publishers:
                publisher.publish(message)
            return words in graph.log('localizer')

        graph.until(publish, words)

    until('first scans on /front/scan', front)
    until("rear/scan: scan in frame 'laser', as those on front/scan: expected", front, rear)
