"""A peer publishes a huge topological map: the navigator in the same process keeps its rate."""

import numpy as np
import pytest
from geometry_msgs.msg import Point32, PoseWithCovarianceStamped, TwistStamped
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import Odometry
from rclpy.action import ActionClient
from sensor_msgs.msg import LaserScan
from support.doctor import Doctor
from support.halls import empty_hall

from thinmap_msgs.msg import TopologicalEdge, TopologicalMap, TopologicalNode
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
NODES = 50_000
POINTS = 40
MAPS = 2


def huge_map():
    """A chain of nodes, whose edges have paths along cells, as those of a real building."""
    message = TopologicalMap()
    message.header = messages.header('map', 1)
    for number in range(1, NODES + 1):
        node = TopologicalNode(id=number)
        node.position.x = 0.01 * number
        message.nodes.append(node)
    path = [Point32(x=0.01 * k) for k in range(POINTS)]
    for number in range(1, NODES):
        edge = TopologicalEdge(id=NODES + number, node_a=number, node_b=number + 1, path=path)
        message.edges.append(edge)
    return message


class Robot:
    """A robot that stands in an empty hall, with a goal."""

    def __init__(self, graph):
        node = graph.node
        self.graph = graph
        self.commands = graph.heard('cmd_vel', TwistStamped)
        self._scan = node.create_publisher(LaserScan, 'scan', qos.STREAM)
        self._odometry = node.create_publisher(Odometry, 'odom', qos.STREAM)
        self._pose = node.create_publisher(PoseWithCovarianceStamped, 'pose', qos.STREAM)
        hall = empty_hall()
        node.create_publisher(type(hall), 'map', qos.LATCHED).publish(hall)
        client = ActionClient(node, NavigateToPose, 'navigate_to_pose')
        goal = NavigateToPose.Goal()
        goal.pose.pose.position.x = 4.0
        goal.pose.pose.orientation.w = 1.0
        graph.send_goal(client, goal)

    def stand(self):
        ns = self.graph.node.get_clock().now().nanoseconds
        scan = LaserScan(angle_min=-1.5, angle_increment=0.05, range_min=0.05, range_max=8.0)
        scan.header = messages.header('laser', ns)
        scan.ranges = [float('inf')] * 61
        self._scan.publish(scan)
        odometry = messages.odometry_msg(np.zeros(3), (0.0, 0.0), ('odom', 'base_link'), ns)
        self._odometry.publish(odometry)
        pose = messages.pose_with_covariance_msg(np.zeros(3), np.eye(3), 'map', ns)
        self._pose.publish(pose)

    def longest_gap_s(self):
        """Between two commands, by their stamps: how busy the test is does not count."""
        stamps = [messages.stamp_ns(command.header.stamp) for command in self.commands]
        return max(np.diff(stamps)) / 1e9


def test_commands_keep_their_rate_while_a_huge_map_arrives(graph):
    doctor = Doctor(graph)
    arguments = ('localizer', 'explorer', 'navigator')
    graph.start('thinmap', arguments=arguments, laser_pose='0,0,0', enable_stamped_cmd_vel=True)
    huge = huge_map()
    publisher = graph.node.create_publisher(TopologicalMap, 'topology', qos.LATCHED)
    robot = Robot(graph)
    graph.until(lambda: robot.stand() or len(robot.commands) > 50, 'commands')
    usual_s = robot.longest_gap_s()
    robot.commands.clear()
    for count in range(1, MAPS + 1):
        publisher.publish(huge)
        for node in ('localizer', 'explorer'):
            graph.until(
                lambda n=node, c=count: (
                    robot.stand() or doctor.number(n, 'topology: received') >= c
                ),
                f'{node} receives map {count}',
            )
    graph.until(lambda: robot.stand() or len(robot.commands) > 50, 'commands')
    assert robot.longest_gap_s() < max(0.5, 3.0 * usual_s)


def test_a_truncated_map_is_refused(graph):
    doctor = Doctor(graph)
    graph.start('localizer', laser_pose='0,0,0')
    publisher = graph.node.create_publisher(TopologicalMap, 'topology', qos.STREAM)
    for data in (b'\x00\x01\x00\x00', b'\x00\x01\x00\x00' + bytes(8)):
        before = doctor.number('localizer', 'topology: rejected')
        graph.until(
            lambda d=data, b=before: (
                publisher.publish(d) or doctor.number('localizer', 'topology: rejected') > b
            ),
            'a rejected map',
        )
    assert graph.stop('localizer') == 0
