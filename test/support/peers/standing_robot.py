"""Sensors and pose of a robot that stands in an empty hall, with a goal for its navigator."""

import math
from array import array
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import Odometry
from rclpy.action import ActionClient
from sensor_msgs.msg import LaserScan
from support.halls import empty_hall
from support.live_graph import Graph

from thinmap_ros.ros import messages, qos

BEAMS = 61


class StandingRobot:
    """Publishes what a robot measures that stands at the origin of an empty hall.

    commands: velocity commands that its navigator publishes.
    """

    def __init__(self, graph: Graph, namespace: str = '', command: type = Twist) -> None:
        """command: type of cmd_vel."""
        node = graph.node
        self.graph = graph
        self._prefix = f'{namespace}/' if namespace else ''
        self.commands = graph.heard(f'{self._prefix}cmd_vel', command)
        self._scan = node.create_publisher(LaserScan, f'{self._prefix}scan', qos.STREAM)
        self._odometry = node.create_publisher(Odometry, f'{self._prefix}odom', qos.STREAM)
        self._pose = node.create_publisher(
            PoseWithCovarianceStamped, f'{self._prefix}pose', qos.STREAM
        )
        hall = empty_hall()
        node.create_publisher(type(hall), f'{self._prefix}map', qos.LATCHED).publish(hall)
        self._client = ActionClient(node, NavigateToPose, f'{self._prefix}navigate_to_pose')

    def drive_to(self, x: float) -> Any:
        """Send a goal at (x, 0), m; returns its handle."""
        goal = NavigateToPose.Goal()
        goal.pose.pose.position.x = x
        goal.pose.pose.orientation.w = 1.0
        return self.graph.send_goal(self._client, goal)

    def stand(self, ranges: Any = math.inf) -> None:
        """Publish a scan with these ranges, m, odometry and pose of the present time."""
        ns = self.graph.node.get_clock().now().nanoseconds
        still = messages.odometry_msg(np.zeros(3), (0.0, 0.0), ('odom', 'base_link'), ns)
        self._odometry.publish(still)
        message = LaserScan(angle_min=-1.5, angle_increment=0.05, range_min=0.05, range_max=8.0)
        message.header = messages.header('laser', ns)
        message.ranges = array('f', np.broadcast_to(np.asarray(ranges, dtype=np.float32), BEAMS))
        self._scan.publish(message)
        self._pose.publish(messages.pose_with_covariance_msg(np.zeros(3), np.eye(3), 'map', ns))
