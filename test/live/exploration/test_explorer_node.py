"""The explorer as a process on a live graph.

The reasons for the end of an exploration, resuming, and strategies.
"""

import math
from itertools import count

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient, ActionServer
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from support.forks import forked
from support.localized import local_grid
from support.timeouts import PATIENCE_S

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import (
    EndNodeArray,
    ExplorationStatus,
    LocalGrid,
    ProbabilityGrid,
    SlamStatus,
    TopologicalMap,
)
from thinmap_msgs.srv import SaveMap
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import pose
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
AT = pose(2.0, 2.0, 0.0)
ANGLES = np.radians(np.arange(-90.0, 91.0))
PERIOD_NS = 200_000_000
# Ten times real time; the explorer uses the simulated time.
SPEAK_S = 0.02
# A user-defined strategy: one target, finished after two failures.
OWN_STRATEGY = """
import numpy as np
from thinmap_ros.core.exploration.strategy import Decision, EndNode, FinishCode

class TwoAttempts:
    def __init__(self):
        self.attempts = 0

    def step(self, topology, patch, scan, T_map_base):
        goal = T_map_base + np.array([0.5, 0.0, 0.0])
        target = EndNode(7, goal[0], goal[1], 0.5, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, True, goal)
        if self.attempts < 2:
            return Decision(target, False, 'one left', FinishCode.NONE, [target], [], 1.0)
        code = FinishCode.UNREACHABLE
        return Decision(None, True, 'two attempts failed', code, [target], [7], 1.0)

    def target_failed(self, reason):
        self.attempts += 1
"""


def room(known_cols):
    """A closed room of 6 x 4 m, known up to a column."""
    cells = np.zeros((40, 60), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    cells[:, known_cols:] = UNKNOWN
    return GridPatch(GridFrame(0.0, 0.0, 0.1), cells)


class Robot:
    """Publishes the messages of the other nodes, for a stationary robot in a room."""

    def __init__(self, graph):
        self.graph = graph
        self.node = graph.node
        self.numbers = count(1)
        self.hears_scans = self.is_tracked = True
        self.map_id = 0
        self.end_nodes = graph.heard('end_nodes', EndNodeArray, qos.LATCHED)
        self.map = self.node.create_publisher(ProbabilityGrid, 'grid', qos.LATCHED)
        self.graph_map = self.node.create_publisher(TopologicalMap, 'topology', qos.LATCHED)
        self.window = self.node.create_publisher(LocalGrid, 'local_grid', qos.STREAM)
        self.clock = self.node.create_publisher(Clock, '/clock', qos.STREAM)
        self.node.create_timer(SPEAK_S, self.speak)
        self.knows(40)

    def refuses_to_drive(self):
        """From now on, goals fail.

        Until this call there is no navigator, and the explorer waits for it.
        """

        def refuse(handle):
            handle.abort()
            return NavigateToPose.Result(error_code=9000, error_msg='the wheels are chained')

        self.driver = ActionServer(self.node, NavigateToPose, 'navigate_to_pose', refuse)

    def knows(self, cols):
        self.patch = room(cols)
        self.map.publish(messages.probability_grid_msg(self.patch, 'map', 0))
        self.publish_graph()

    def publish_graph(self, map_id=0):
        topology = build(self.patch, (2.0, 2.0), TopologyConfig())
        self.graph_map.publish(messages.topology_msg(topology, 'map', 0, map_id))

    def changes_map(self, map_id):
        """From now on the grid is that of another map, whose graph is not published yet."""
        self.map_id = map_id
        self.map.publish(messages.probability_grid_msg(self.patch, 'map', 0, map_id=map_id))

    def speak(self):
        ns = next(self.numbers) * PERIOD_NS
        self.clock.publish(Clock(clock=messages.time_msg(ns)))
        ranges = 0.1 * cast_rays(
            room(60).occupied.astype(np.uint8), 20.0, 20.0, ANGLES + AT[2], 80.0
        )
        scan = Scan.create(ns, ranges, -0.5 * math.pi, math.pi / 180.0, 0.05, 8.0)
        if self.hears_scans:
            state = SlamStatus.TRACKING if self.is_tracked else SlamStatus.LOST
            self.window.publish(local_grid(self.patch, AT, ns, scan, state, self.map_id))

    def explores(self, **goal):
        """Final status of an exploration, and whether it succeeded."""
        ended = self.graph.act(Explore, 'explore', Explore.Goal(**goal))
        return ended.result.status.reason_code, ended.status

    def evidence(self):
        """Probability and closest distance of counted observations by end node."""
        return {
            n.node_id: (n.position_probability, n.min_distance_m)
            for n in self.end_nodes[-1].end_nodes
        }


@pytest.fixture
def robot(graph):
    robot = Robot(graph)
    graph.start('explorer', laser_pose='0,0,0', use_sim_time=True)
    return robot


def test_it_reports_why_it_ended(robot):
    assert robot.explores(area_limit_m2=1.0) == (
        ExplorationStatus.BUDGET_EXHAUSTED,
        GoalStatus.STATUS_SUCCEEDED,
    )
    robot.is_tracked = False
    assert robot.explores() == (ExplorationStatus.LOCALIZATION_LOST, GoalStatus.STATUS_ABORTED)
    robot.is_tracked = True
    robot.speak()  # the state comes with a scan
    robot.hears_scans = False
    assert robot.explores() == (ExplorationStatus.SENSOR_TIMEOUT, GoalStatus.STATUS_ABORTED)
    robot.hears_scans = True
    robot.refuses_to_drive()
    assert robot.explores() == (ExplorationStatus.UNREACHABLE, GoalStatus.STATUS_ABORTED)
    robot.knows(60)
    assert robot.explores() == (ExplorationStatus.ALL_RESOLVED, GoalStatus.STATUS_SUCCEEDED)


def test_the_time_that_it_took_is_none_of_the_calendar(graph):
    robot = Robot(graph)
    graph.start('explorer', laser_pose='0,0,0')
    status = graph.act(Explore, 'explore', Explore.Goal(area_limit_m2=1.0)).result.status
    assert status.reason_code == ExplorationStatus.BUDGET_EXHAUSTED, status.reason
    assert 0 <= status.elapsed.sec < PATIENCE_S
    assert robot.end_nodes


def test_it_waits_for_the_graph_of_its_map(robot):
    """A goal that comes between grid and graph: end nodes would be resolved without evidence."""
    robot.publish_graph(4)
    robot.changes_map(5)
    ended = robot.graph.act(Explore, 'explore', Explore.Goal(area_limit_m2=1.0)).result.status
    assert ended.reason_code == ExplorationStatus.SENSOR_TIMEOUT
    assert 'topological map of this map on topology' in ended.reason
    assert not robot.end_nodes
    robot.publish_graph(5)
    assert robot.explores(area_limit_m2=1.0)[0] == ExplorationStatus.BUDGET_EXHAUSTED
    robot.graph.until(lambda: robot.end_nodes, 'end nodes')
    assert 1 in robot.evidence()


def test_it_resumes_after_a_cancelled_goal_and_after_a_restart(graph, robot, tmp_path):
    client = ActionClient(graph.node, Explore, 'explore')
    accepted = graph.send_goal(client, Explore.Goal())
    graph.until(lambda: robot.end_nodes and any(robot.evidence().values()), 'end nodes')
    # Nodes are observed in turn, and frontiers once per second: until nothing changes for 30
    # observations.
    seen = [(robot.evidence(), len(robot.end_nodes))]

    def is_settled():
        if robot.evidence() != seen[0][0]:
            seen[0] = (robot.evidence(), len(robot.end_nodes))
        return len(robot.end_nodes) - seen[0][1] > 30

    graph.until(is_settled, 'all looks at end nodes')
    accepted.cancel_goal_async()
    ended = accepted.get_result_async()
    graph.until(ended.done, 'the end')
    assert ended.result().status == GoalStatus.STATUS_CANCELED
    assert ended.result().result.status.reason_code == ExplorationStatus.CANCELLED
    before = robot.evidence()
    stem = tmp_path / 'room'
    assert graph.call(SaveMap, 'save_exploration', SaveMap.Request(path=str(stem))).success
    for session in ({}, {'session_path': str(stem)}):
        if session:
            assert graph.stop('explorer') == 0, graph.log('explorer')
            graph.start('explorer', laser_pose='0,0,0', use_sim_time=True, **session)
        robot.end_nodes.clear()
        assert robot.explores(area_limit_m2=1.0)[0] == ExplorationStatus.BUDGET_EXHAUSTED
        graph.until(lambda: robot.end_nodes, 'what was looked at last')
        # The robot has not moved: there is no new evidence, and the old one is kept.
        assert robot.evidence() == before
    # The evidence of one scheme is not that of another.
    assert graph.stop('explorer') == 0, graph.log('explorer')
    graph.start('explorer', laser_pose='0,0,0', use_sim_time=True, strategy='paper')
    answer = graph.call(SaveMap, 'save_exploration', SaveMap.Request(path=str(stem)))
    assert answer.success and 'paper has nothing to save' in answer.message
    assert not (tmp_path / 'room.exploration.npz').exists()


def test_a_users_own_strategy_explores(graph):
    (graph.folder / 'own_strategy.py').write_text(OWN_STRATEGY)
    robot = Robot(graph)
    robot.refuses_to_drive()
    graph.start(
        'explorer',
        laser_pose='0,0,0',
        use_sim_time=True,
        strategy='own_strategy:TwoAttempts',
    )
    ended = graph.act(Explore, 'explore', Explore.Goal())
    assert ended.status == GoalStatus.STATUS_ABORTED
    assert ended.result.status.reason_code == ExplorationStatus.UNREACHABLE
    failure = 'no target was reached: the wheels are chained'
    assert ended.result.status.reason == f'two attempts failed; {failure}'
    assert list(robot.evidence()) == [7]
    saved = graph.call(SaveMap, 'save_exploration', SaveMap.Request(path='room'))
    assert saved.success
    assert saved.message == 'strategy own_strategy:TwoAttempts has nothing to save'
    assert graph.stop('explorer') == 0, graph.log('explorer')


def test_a_baseline_explores(graph):
    robot = Robot(graph)
    robot.refuses_to_drive()
    graph.start('explorer', laser_pose='0,0,0', use_sim_time=True, strategy='nearest_frontier')
    assert robot.explores() == (ExplorationStatus.UNREACHABLE, GoalStatus.STATUS_ABORTED)
    robot.knows(60)
    assert robot.explores() == (ExplorationStatus.ALL_RESOLVED, GoalStatus.STATUS_SUCCEEDED)
    assert graph.stop('explorer') == 0, graph.log('explorer')


@pytest.mark.parametrize('name', ['nearest', 'nowhere:strategy', 'math:pi'])
def test_a_strategy_that_there_is_not_ends_the_start_with_a_line(ros_domain, name):
    words = ('--ros-args', '-p', f"strategy:='{name}'")
    done = forked.run('thinmap_ros.nodes.explorer', *words)
    assert done.returncode == 2
    assert 'Traceback' not in done.stderr
    line = done.stderr.splitlines()[-1]
    assert line.startswith(f'error: strategy = {name!r}: ')
    assert line.endswith('or package.module:factory')


def test_a_return_begins_when_there_is_a_navigator_at_last(graph, robot):
    client = ActionClient(graph.node, Explore, 'explore')
    accepted = graph.send_goal(client, Explore.Goal(area_limit_m2=1.0, return_home=True))
    status = graph.heard('exploration_status', ExplorationStatus, qos.LATCHED)
    words = graph.heard('explore/status', String, qos.LATCHED)
    graph.until(
        lambda: status and status[-1].state == ExplorationStatus.RETURNING, 'the robot returns'
    )
    robot.refuses_to_drive()
    ended = accepted.get_result_async()
    graph.until(ended.done, 'the end')
    assert ended.result().status == GoalStatus.STATUS_ABORTED
    assert ended.result().result.status.reason_code == ExplorationStatus.BUDGET_EXHAUSTED
    assert ended.result().result.status.reason.endswith('; not home: the wheels are chained')
    graph.until(lambda: words[-1].data == 'exploration_complete', 'its last status')
    assert 'exploration_paused' not in [message.data for message in words]
