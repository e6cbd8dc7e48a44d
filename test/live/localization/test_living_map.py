"""A localizer that begins again while the other nodes keep their map: never two maps in one."""

import signal

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from std_srvs.srv import Trigger
from support.halls import AT_START, START

from thinmap_msgs.msg import ProbabilityGrid, SlamStatus, TopologicalMap
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
NODES = ('grid_mapper', 'topology_builder', 'localizer')
RECOVER_S = 1000.0


class Robot:
    """A robot that drives in a curve, and what is published of it."""

    def __init__(self, graph):
        self.graph = graph
        self.truth = graph.heard('ground_truth', PoseStamped)
        self.status = graph.heard('slam_status', SlamStatus)
        self.poses = graph.heard('pose', PoseWithCovarianceStamped)
        self.grids = graph.heard('grid', ProbabilityGrid, qos.LATCHED)
        self.graphs = graph.heard('topology', TopologicalMap, qos.LATCHED)
        self.commands = graph.node.create_publisher(Twist, 'cmd_vel', 10)
        for name in NODES:
            self.start(name)
        graph.start(
            'sim',
            remap=graph.paced(),
            start=START,
            wait_for_subscribers=1,
            real_time_factor=4.0,
            lockstep='local_topology',
            lockstep_timeout_s=2.0,
        )

    def start(self, name):
        values = AT_START if name == 'localizer' else {}
        self.graph.start(name, use_sim_time=True, recovery_timeout_s=RECOVER_S, **values)

    def drive_until(self, condition, what):
        ahead = Twist()
        ahead.linear.x = 0.25
        ahead.angular.z = 0.25

        def met():
            self.commands.publish(ahead)
            return self.status and self.grids and self.truth and condition()

        self.graph.until(met, what)

    def drive_for(self, seconds):
        end_s = self.seconds() + seconds
        self.drive_until(lambda: self.seconds() > end_s, f'{seconds} s')

    def seconds(self):
        return messages.stamp_ns(self.truth[-1].header.stamp) / 1e9

    def known(self):
        return known(self.grids[-1])


def known(grid):
    return int((np.array(grid.data) >= 0).sum())


def test_a_localizer_that_is_reset_takes_mapper_and_graph_along(graph):
    robot = Robot(graph)
    robot.drive_until(lambda: robot.truth and robot.seconds() > 20.0, 'a map')
    before = robot.status[-1].map_id
    all_round = robot.known()
    assert before == robot.grids[-1].map_id != 0
    robot.grids.clear(), robot.graphs.clear()
    assert graph.call(Trigger, '/localizer/reset', Trigger.Request()).success
    robot.drive_until(lambda: robot.status[-1].map_id != before, 'another map')
    after = robot.status[-1].map_id
    assert robot.status[-1].replaced_map_id == before
    robot.drive_until(lambda: robot.grids[-1].map_id == after, 'the mapper follows')
    robot.drive_until(lambda: robot.graphs and robot.graphs[-1].map_id == after, 'the graph, too')
    assert 'the localizer was reset: state reset' in graph.log('grid_mapper')
    assert 'grid is of another map: state reset' in graph.log('topology_builder')
    first = next(grid for grid in robot.grids if grid.map_id == after)
    assert known(first) < 0.75 * all_round, 'one view of the room, and nothing of the old map'
    assert [graph.stop(name) for name in NODES] == [0] * 3


@pytest.mark.cpu_budget(15.0, 'a robot that is lost searches with each scan')
def test_a_localizer_without_memory_stays_lost_in_the_living_map_until_a_pose_is_given(graph):
    robot = Robot(graph)
    # From 15.2 to 17.1 s the view is like none near the start pose; at 12.1 s it is like a corner.
    robot.drive_until(lambda: robot.truth and robot.seconds() > 15.6, 'a map')
    graph.stop('localizer', signal.SIGKILL)
    for kept in (graph.folder / 'state').glob('*.localizer.npz'):
        kept.unlink()
    killed_s = robot.seconds()
    # Of the simulation: the map is published once a second, if it has changed.
    graph.until(lambda: robot.seconds() > killed_s + 2.0, 'the last map before that')
    graph.drain()
    before = robot.grids[-1].map_id
    map_before = robot.known()
    robot.status.clear()
    robot.start('localizer')
    # At rest: after a whole turn, scans would match at the start pose.
    graph.until(lambda: robot.status and robot.status[-1].map_id == before, 'it finds the map')
    robot.drive_for(4.0)
    lost = (SlamStatus.LOST, SlamStatus.MAPPING_APART)
    assert {status.state for status in robot.status[-10:]} <= set(lost)
    assert robot.known() == map_before, 'nothing is drawn meanwhile'
    given = graph.node.create_publisher(PoseWithCovarianceStamped, 'initialpose', 10)
    graph.until(given.get_subscription_count, 'the localizer')
    # In the frame of the map, in which the robot has started at its true pose.
    place = messages.pose_from_msg(robot.truth[-1].pose)
    given.publish(messages.pose_with_covariance_msg(place, np.diag([0.05, 0.05, 0.02]), 'map', 0))
    robot.drive_until(lambda: robot.status[-1].state == SlamStatus.TRACKING, 'it is found')
    assert robot.status[-1].map_id == before
    robot.drive_until(lambda: robot.known() != map_before, 'mapping continues')
    assert [graph.stop(name) for name in NODES] == [0] * 3
