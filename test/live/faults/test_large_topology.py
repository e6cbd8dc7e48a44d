"""A peer publishes a huge topological map: the navigator in the same process keeps its rate."""

import time

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from support.doctor import Doctor
from support.peers.standing_robot import StandingRobot

from thinmap_msgs.msg import TopologicalMap as TopologicalMapMsg
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
NODES = 50_000
POINTS = 40
MAPS = 2


def huge_map():
    """A chain of nodes, whose edges have paths along cells, as those of a real building."""
    nodes = [Node(i, NodeKind.END, 0.01 * i, 0.0, 0.0) for i in range(1, NODES + 1)]
    path = np.column_stack([0.01 * np.arange(POINTS), np.zeros(POINTS)])
    edges = [Edge(NODES + i, i, i + 1, path, 0.0, 0.0) for i in range(1, NODES)]
    return messages.topology_msg(TopologicalMap(nodes, edges), 'map', 1)


def longest_gap_s(robot):
    """Between two commands, by their stamps: how busy the test is does not count."""
    stamps = [messages.stamp_ns(command.header.stamp) for command in robot.commands]
    return max(np.diff(stamps)) / 1e9


class Robot(StandingRobot):
    """A robot that stands, and is given its goal again before the navigator gives it up."""

    def __init__(self, graph):
        super().__init__(graph, command=TwistStamped)
        self._due_s = 0.0

    def drives(self):
        self.stand()
        if time.monotonic() > self._due_s:
            self._due_s = time.monotonic() + 1.0
            self.drive_to(4.0)


@pytest.mark.slow
def test_commands_keep_their_rate_while_a_huge_map_arrives(graph):
    doctor = Doctor(graph)
    arguments = ('localizer', 'explorer', 'navigator')
    graph.start('thinmap', arguments=arguments, laser_pose='0,0,0', enable_stamped_cmd_vel=True)
    huge = huge_map()
    publisher = graph.node.create_publisher(TopologicalMapMsg, 'topology', qos.LATCHED)
    robot = Robot(graph)
    graph.until(lambda: robot.drives() or len(robot.commands) > 50, 'commands')
    usual_s = longest_gap_s(robot)
    robot.commands.clear()
    for count in range(1, MAPS + 1):
        publisher.publish(huge)
        for node in ('localizer', 'explorer'):
            graph.until(
                lambda n=node, c=count: (
                    robot.drives() or doctor.number(n, 'topology: received') >= c
                ),
                f'{node} receives map {count}',
            )
    graph.until(lambda: robot.drives() or len(robot.commands) > 50, 'commands')
    assert longest_gap_s(robot) < max(0.5, 3.0 * usual_s)


def test_a_map_that_contradicts_itself_is_refused_and_a_truncated_one_disturbs_nobody(graph):
    doctor = Doctor(graph)
    graph.start('localizer', laser_pose='0,0,0')
    publisher = graph.node.create_publisher(TopologicalMapMsg, 'topology', qos.STREAM)
    wrong = TopologicalMapMsg(node_ids=[1, 2])
    for data in (b'\x00\x01\x00\x00', b'\x00\x01\x00\x00' + bytes(8)):
        before = doctor.number('localizer', 'topology: rejected')
        graph.until(
            lambda d=data, b=before: (
                publisher.publish(d)
                or publisher.publish(wrong)
                or doctor.number('localizer', 'topology: rejected') > b
            ),
            'a rejected map',
        )
    refusal = 'topology: topological map: node_kinds: (0,): expected uint8 (n); n = 2'
    assert refusal in graph.log('localizer')
    assert graph.stop('localizer') == 0
