"""One pose kilometres away on a live graph: refused and counted; map and localizer continue."""

import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.srv import GetMap
from sensor_msgs.msg import LaserScan
from support.carmen_log import BEAMS, box_ranges
from support.doctor import Doctor
from support.localized import localized

from thinmap_msgs.msg import LocalGrid, LocalizedScan
from thinmap_ros.core import se2
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
PERIOD_S = 0.05  # of the machine
PERIOD_NS = 200_000_000
LATER_NS = 1_000_000_000_000  # longer than any gap in which odometry may have come far
STEP_M = 0.02


class Robot:
    """A robot that drives slowly in a square room: its scans, odometry, and poses in the map."""

    def __init__(self, graph):
        node = graph.node
        self.publishers = [
            node.create_publisher(Odometry, 'odom', qos.STREAM),
            node.create_publisher(LocalizedScan, 'given_scan', qos.STREAM),
            node.create_publisher(LaserScan, 'scan', qos.SENSOR),
        ]
        self.stamp_ns = 100_000_000_000
        self.steps = 0
        self._stepped_s = 0.0

    @property
    def x(self):
        """True position, m: 1 m there and back again."""
        return STEP_M * abs((self.steps + 50) % 100 - 50)

    def step_in_time(self):
        """Publish the next scan, not faster than busy nodes process them."""
        if time.monotonic() - self._stepped_s > PERIOD_S:
            self.step()

    def step(self, wild_m=0.0):
        """Publish the next scan; its odometry and pose are off by so much."""
        self._stepped_s = time.monotonic()
        self.stamp_ns += PERIOD_NS
        self.steps += 1
        odometry = Odometry()
        scan = LaserScan()
        for message, frame in ((odometry, 'odom'), (scan, 'laser')):
            message.header.stamp = messages.time_msg(self.stamp_ns)
            message.header.frame_id = frame
        odometry.child_frame_id = 'base_link'
        T = se2.pose(self.x + wild_m, wild_m, 0.0)
        odometry.pose.pose = messages.pose_msg(T)
        scan.angle_min = -np.pi / 2
        scan.angle_increment = np.pi / (BEAMS - 1)
        scan.angle_max = np.pi / 2
        scan.range_min = 0.05
        scan.range_max = 20.0
        scan.ranges = box_ranges(self.x, 0.0).astype(np.float32)
        given = localized(messages.scan_from_msg(scan, np.zeros(3)), T)
        for publisher, message in zip(self.publishers, (odometry, given, scan), strict=True):
            publisher.publish(message)


def since(heard, ns):
    return [m for m in heard if messages.stamp_ns(m.header.stamp) > ns]


def test_one_pose_kilometres_away_ends_neither_map_nor_localizer(graph):
    doctor = Doctor(graph)
    robot = Robot(graph)
    windows = graph.heard('local_grid', LocalGrid)
    poses = graph.heard('pose', PoseWithCovarianceStamped)
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    graph.start('localizer', laser_pose='0,0,0')
    graph.start('grid_mapper', ('localized_scan:=given_scan',))

    def mapped(ns):
        robot.step_in_time()
        return len(since(windows, ns)) > 10 and len(since(poses, ns)) > 10 and maps

    graph.until(lambda: mapped(0), 'map and poses')
    before = maps[-1].info
    graph.drain()
    robot.stamp_ns += LATER_NS
    robot.step(wild_m=2e3)
    wild_ns = robot.stamp_ns
    graph.until(lambda: mapped(wild_ns), 'map and poses after the wild pose')
    newest = since(poses, wild_ns)[-1]
    assert abs(newest.pose.pose.position.x) < 1.5
    assert abs(newest.pose.pose.position.y) < 0.2
    later = graph.call(GetMap, 'dynamic_map', GetMap.Request()).map.info
    assert (later.width, later.height) == pytest.approx((before.width, before.height), abs=10)
    graph.until(
        lambda: doctor.number('grid_mapper', 'localized_scan: rejected') == 1, 'the scan is counted'
    )
    assert 'map of' in graph.log('grid_mapper')
    dropped = 'dropped: invalid scans or odometry'

    def counted():
        # Again, where a busy machine has lost the scan of the first one.
        robot.step(wild_m=2e3)
        return doctor.number('localizer', dropped) >= 1

    graph.until(counted, 'the odometry is counted')
