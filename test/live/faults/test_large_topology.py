"""A peer publishes a huge topological map: the navigator in the same process keeps its rate."""

import time

import numpy as np
import pytest
from geometry_msgs.msg import Point32, TwistStamped
from rclpy.serialization import deserialize_message, serialize_message
from support.doctor import Doctor
from support.peers.standing_robot import StandingRobot

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


def longest_gap_s(robot):
    """Between two commands, by their stamps: how busy the test is does not count."""
    stamps = [messages.stamp_ns(command.header.stamp) for command in robot.commands]
    return max(np.diff(stamps)) / 1e9


def decoding_s(message):
    """Time in which rclpy decodes a message: reading it so stopped commands for a fifth of that."""
    data = serialize_message(message)
    started = time.monotonic()
    deserialize_message(data, type(message))
    return time.monotonic() - started


@pytest.mark.slow
def test_commands_keep_their_rate_while_a_huge_map_arrives(graph):
    doctor = Doctor(graph)
    arguments = ('localizer', 'explorer', 'navigator')
    graph.start('thinmap', arguments=arguments, laser_pose='0,0,0', enable_stamped_cmd_vel=True)
    huge = huge_map()
    publisher = graph.node.create_publisher(TopologicalMap, 'topology', qos.LATCHED)
    robot = StandingRobot(graph, command=TwistStamped)
    robot.drive_to(4.0)
    graph.until(lambda: robot.stand() or len(robot.commands) > 50, 'commands')
    usual_s = longest_gap_s(robot)
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
    assert longest_gap_s(robot) < max(0.5, 3.0 * usual_s, decoding_s(huge) / 12.0)


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
