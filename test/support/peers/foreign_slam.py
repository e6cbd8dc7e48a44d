"""A substitute for the SLAM of somebody else: the true pose, as map and TF, and nothing more.

Publishes map (-1, 0, 100; cells of 5 cm) once a second, whose origin moves with what is known and
by parts of a cell, as with slam_toolbox, and map -> odom on /tf. The map frame is the start pose.
"""

import math
from contextlib import suppress

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from thinmap_ros.core import se2
from thinmap_ros.core.grid import occupancy
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.ros import messages, qos

RESOLUTION_M = 0.05
_PERIOD_NS = 1_000_000_000
_SHIFT_M = 0.02
_KEPT = 200


class ForeignSlam(Node):
    """Parameter laser_range_m: cells up to it are free along beams without return."""

    def __init__(self):
        super().__init__('foreign_slam')
        range_m = self.declare_parameter('laser_range_m', 8.0).value
        config = occupancy.OccupancyConfig(
            resolution_m=RESOLUTION_M, no_return_clear_range_m=range_m
        )
        self._grid = occupancy.OccupancyGrid(config)
        self._start = None
        self._poses = {}
        self._odometry = {}
        self._published_ns = -_PERIOD_NS
        self._maps = 0
        self._map = self.create_publisher(OccupancyGrid, 'map', qos.LATCHED)
        self._tf = self.create_publisher(TFMessage, '/tf', qos.TRANSFORMS)
        self.create_subscription(PoseStamped, 'ground_truth', self._on_truth, qos.STREAM)
        self.create_subscription(Odometry, 'odom', self._on_odometry, qos.STREAM)
        self.create_subscription(LaserScan, 'scan', self._on_scan, qos.STREAM)
        self._scans = []

    def _on_truth(self, message):
        T = messages.pose_from_msg(message.pose)
        self._start = T if self._start is None else self._start
        T_map_base = se2.compose(se2.invert(self._start), T)
        self._keep(self._poses, message, T_map_base)

    def _on_odometry(self, message):
        self._keep(self._odometry, message, messages.pose_from_msg(message.pose.pose))

    def _on_scan(self, message):
        self._scans.append(message)
        self._process()

    def _keep(self, poses, message, T):
        poses[messages.stamp_ns(message.header.stamp)] = T
        while len(poses) > _KEPT:
            del poses[next(iter(poses))]
        self._process()

    def _process(self):
        """Process scans whose pose and odometry have been received, in any order."""
        while self._scans:
            ns = messages.stamp_ns(self._scans[0].header.stamp)
            if ns not in self._poses or ns not in self._odometry:
                return
            self._add_scan(self._scans.pop(0), ns)

    def _add_scan(self, message, ns):
        T_map_base = self._poses[ns]
        self._grid.add_scan(messages.scan_from_msg(message, np.zeros(3)), T_map_base)
        if ns - self._published_ns >= _PERIOD_NS:
            self._published_ns = ns
            self._publish_map(ns)
        T_map_odom = se2.compose(T_map_base, se2.invert(self._odometry[ns]))
        transform = messages.transform_msg(T_map_odom, 'map', 'odom', ns)
        self._tf.publish(TFMessage(transforms=[transform]))

    def _publish_map(self, ns):
        self._maps += 1
        patch = self._grid.known_area()
        cells = np.full(patch.shape, -1, dtype=np.int8)
        cells[patch.free] = 0
        cells[patch.occupied] = 100
        frame = GridFrame(
            patch.frame.origin_x + _SHIFT_M * math.sin(self._maps),
            patch.frame.origin_y + _SHIFT_M * math.cos(self._maps),
            RESOLUTION_M,
        )
        self._map.publish(messages.grid_msg(GridPatch(frame, cells), 'map', ns))


def main():
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(ForeignSlam())


if __name__ == '__main__':
    main()
