"""A navigator that is stopped: its last command is zero, and arrives before the node is gone."""

import signal

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import Odometry
from rclpy.action import ActionClient
from sensor_msgs.msg import LaserScan
from support.halls import empty_hall

from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live


class Robots:
    """Robots in namespaces of their own, in an empty hall: one drives, the other turns first."""

    def __init__(self, graph, count):
        self.graph = graph
        self.names = [f'robot_{k}' for k in range(count)]
        self.commands = {}
        self.publishers = {}
        for k, name in enumerate(self.names):
            remap = (f'__ns:=/{name}',)
            # The last one is beside other nodes, in one process.
            program = 'navigator' if k < count - 1 else 'thinmap'
            nodes = () if program == 'navigator' else ('explorer', 'navigator')
            graph.start(program, label=name, remap=remap, arguments=nodes, laser_pose='0,0,0')
            self.commands[name] = graph.heard(f'{name}/cmd_vel', Twist)
            node = graph.node
            self.publishers[name] = (
                node.create_publisher(LaserScan, f'{name}/scan', qos.STREAM),
                node.create_publisher(Odometry, f'{name}/odom', qos.STREAM),
                node.create_publisher(PoseWithCovarianceStamped, f'{name}/pose', qos.STREAM),
            )
            hall = empty_hall()
            node.create_publisher(type(hall), f'{name}/map', qos.LATCHED).publish(hall)
            client = ActionClient(node, NavigateToPose, f'{name}/navigate_to_pose')
            goal = NavigateToPose.Goal()
            goal.pose.pose.position.x = 4.0 if k % 2 else -4.0
            goal.pose.pose.orientation.w = 1.0
            graph.send_goal(client, goal)

    def stand(self):
        """Publish the sensors of robots that do not move."""
        ns = self.graph.node.get_clock().now().nanoseconds
        scan = LaserScan(angle_min=-1.5, angle_increment=0.05, range_min=0.05, range_max=8.0)
        scan.header = messages.header('laser', ns)
        scan.ranges = [float('inf')] * 61
        odometry = messages.odometry_msg(np.zeros(3), (0.0, 0.0), ('odom', 'base_link'), ns)
        pose = messages.pose_with_covariance_msg(np.zeros(3), np.eye(3), 'map', ns)
        for publishers in self.publishers.values():
            for publisher, message in zip(publishers, (scan, odometry, pose), strict=True):
                publisher.publish(message)

    def is_driven(self, name):
        last = self.commands[name][-1] if self.commands[name] else Twist()
        return abs(last.linear.x) + abs(last.angular.z) > 0.02


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_the_last_command_of_a_navigator_is_zero(graph, number):
    robots = Robots(graph, 4)
    for name in robots.names:
        graph.until(lambda n=name: robots.stand() or robots.is_driven(n), f'{name} is driven')
        assert graph.stop(name, number) == 0
        graph.until(lambda n=name: not robots.is_driven(n), f'{name} stands', seconds=20.0)
