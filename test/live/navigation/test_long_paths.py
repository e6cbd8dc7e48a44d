"""A distant goal is planned on the graph that somebody publishes."""

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import Path
from rclpy.action import ActionClient
from support.peers.still_robot import StillRobot

from thinmap_msgs.msg import TopologicalMap
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live

GOAL = (25.0, 0.0)
LONG_WAY_Y = 9.0


def ring(wall):
    """Corridors around a block; the robot and its goal are in the lower one."""
    cells = np.full((120, 300), 100, dtype=np.int8)
    cells[6:24, 6:294] = 0
    cells[96:114, 6:294] = 0
    cells[6:114, 6:24] = 0
    cells[6:114, 276:294] = 0
    if wall:
        cells[6:24, 130:150] = 100
    return GridPatch(GridFrame(-1.5, -1.5, 0.1), cells)


def highest(plan):
    return max(pose.pose.position.y for pose in plan.poses)


def test_a_distant_goal_is_planned_on_the_graph(graph):
    # The graph does not know the short way, which the map has: the path shows which one was used.
    topology = build(ring(wall=True), (0.0, 0.0), TopologyConfig())
    graph.start('navigator', laser_pose='0,0,0')
    StillRobot(graph, hall=messages.grid_msg(ring(wall=False), 'map', 0))
    plans = graph.heard('plan', Path, qos.LATCHED)
    commands = graph.heard('cmd_vel', Twist)
    client = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')

    def send():
        pose = messages.pose_stamped_msg(np.array([*GOAL, 0.0]), 'map', 0)
        graph.send_goal(client, NavigateToPose.Goal(pose=pose))

    send()
    graph.until(lambda: plans and highest(plans[-1]) < 1.0, 'a plan without a graph')
    publisher = graph.node.create_publisher(TopologicalMap, 'topology', qos.LATCHED)
    publisher.publish(messages.topology_msg(topology, 'map', 0))
    # Again and again: a robot that does not move as commanded gives up each goal.
    graph.until(lambda: send() or highest(plans[-1]) > LONG_WAY_Y - 1.0, 'a plan on the graph')
    graph.until(lambda: any(abs(command.angular.z) > 0.1 for command in commands), 'it turns')
    send()
    graph.until(lambda: highest(plans[-1]) > LONG_WAY_Y - 1.0, 'a plan of another goal')
