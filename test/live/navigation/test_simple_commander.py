"""nav2_simple_commander's calls, in the order of its BasicNavigator, against thinmap's nodes.

It makes the documented calls; those that concern costmaps and map files are Nav2's own.
"""

import math
from enum import Enum

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from lifecycle_msgs.srv import GetState
from nav2_msgs.action import NavigateThroughPoses, NavigateToPose
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from support.halls import AT_START, START

from thinmap_ros.logs import decode
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live


class TaskResult(Enum):
    """Results of a task, from the status of its goal."""

    UNKNOWN = GoalStatus.STATUS_UNKNOWN
    SUCCEEDED = GoalStatus.STATUS_SUCCEEDED
    CANCELED = GoalStatus.STATUS_CANCELED
    FAILED = GoalStatus.STATUS_ABORTED


class Commander:
    """Client with the methods of BasicNavigator; `graph` spins instead of its own executor."""

    def __init__(self, graph):
        self._graph = graph
        self._through = ActionClient(graph.node, NavigateThroughPoses, 'navigate_through_poses')
        self._to = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')
        self._initial_pose = graph.node.create_publisher(
            PoseWithCovarianceStamped, 'initialpose', 10
        )
        self.result = None
        self.feedback = None
        self.feedbacks = 0

    def set_initial_pose(self, pose):
        message = PoseWithCovarianceStamped(header=pose.header)
        message.pose.pose = pose.pose
        self._initial_pose.publish(message)

    def wait_until_active(self, *nodes):
        for node in nodes:
            state = ''
            while state != 'active':
                answer = self._graph.call(GetState, f'{node}/get_state', GetState.Request())
                state = answer.current_state.label

    def go_to_pose(self, pose):
        return self._send(self._to, NavigateToPose.Goal(pose=pose, behavior_tree=''))

    def go_through_poses(self, poses):
        return self._send(self._through, NavigateThroughPoses.Goal(poses=poses, behavior_tree=''))

    def is_task_complete(self):
        self._graph.executor.spin_once(timeout_sec=0.1)
        return self.result.done()

    def get_result(self):
        return TaskResult(self.result.result().status)

    def cancel_task(self):
        answer = self._handle.cancel_goal_async()
        self._graph.until(answer.done, 'an answer to the cancellation')

    def _send(self, client, goal):
        self._handle = self._graph.send_goal(client, goal, self._on_feedback)
        self.result = self._handle.get_result_async() if self._handle.accepted else None
        return self._handle.accepted

    def _on_feedback(self, message):
        self.feedback = message.feedback
        self.feedbacks += 1


def pose_at(x, y, theta=0.0):
    return messages.pose_stamped_msg(np.array([x, y, theta]), 'map', 0)


@pytest.mark.cpu_budget(20.0, 'six drives')
def test_its_sequence_of_calls_drives_the_simulated_robot(graph):
    truth = graph.heard('ground_truth', PoseStamped)
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    commander = Commander(graph)
    for name in ('localizer', 'grid_mapper', 'topology_builder'):
        graph.start(name, use_sim_time=True, **(AT_START if name == 'localizer' else {}))
    # The name that BasicNavigator waits for by default.
    fast = {'controller.max_speed_m_s': 0.4}
    graph.start('navigator', use_sim_time=True, remap=('__node:=bt_navigator',), **fast)
    graph.start(
        'sim',
        remap=graph.paced(),
        start=START,
        # Commands that arrive late on a busy machine turn the robot too far: half as far as at 4.
        real_time_factor=2.0,
        lockstep='local_topology',
        wait_for_subscribers=2,
    )
    commander.set_initial_pose(pose_at(2.0, 2.0, 0.9))
    commander.wait_until_active('localizer', 'bt_navigator')
    graph.until(lambda: maps and truth, 'a map, and where the robot is')

    def position():
        return truth[-1].pose.position.x, truth[-1].pose.position.y

    def complete():
        """Distances that remained, until the task ends."""
        remaining = []
        while not commander.is_task_complete():
            if commander.feedback is not None:
                remaining.append(commander.feedback.distance_remaining)
                assert messages.seconds(commander.feedback.navigation_time) < 600.0
        return remaining

    assert commander.go_to_pose(pose_at(3.0, 3.0, math.pi / 2))
    remaining = complete()
    assert commander.get_result() is TaskResult.SUCCEEDED, commander.result.result()
    assert max(remaining) == pytest.approx(math.sqrt(2.0), abs=0.3)
    assert math.dist(position(), (3.0, 3.0)) < 0.3
    yaw = decode.yaw(truth[-1].pose.orientation)
    assert abs(yaw - math.pi / 2) < 0.3, 'the heading of the goal counts'

    assert commander.go_to_pose(pose_at(2.0, 2.0))
    start = position()
    while not commander.is_task_complete():
        if math.dist(position(), start) > 0.4:
            commander.cancel_task()
    assert commander.get_result() is TaskResult.CANCELED
    assert math.dist(position(), (2.0, 2.0)) > 0.3

    truth.clear()
    places = ((2.6, 2.6), (3.2, 2.0), (2.0, 2.0))
    assert commander.go_through_poses([pose_at(*place) for place in places])
    complete()
    assert commander.get_result() is TaskResult.SUCCEEDED, commander.result.result()
    path = np.array([(t.pose.position.x, t.pose.position.y) for t in truth])
    nearest = [np.hypot(*(path - place).T).min() for place in places]
    assert max(nearest) < 0.3
    assert math.dist(position(), places[-1]) < 0.3

    assert commander.go_to_pose(pose_at(60.0, 2.0))
    complete()
    assert commander.get_result() is TaskResult.FAILED
    assert commander.result.result().result.error_msg == 'no path to (60.00, 2.00)'
    assert commander.feedbacks > 50
    for name in ('navigator', 'localizer'):
        assert graph.stop(name) == 0, graph.log(name)
