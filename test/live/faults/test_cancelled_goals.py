"""A goal for which a cancel was accepted ends CANCELED, also when a newer goal replaces it."""

import signal

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.ros import messages

pytestmark = pytest.mark.live
ACTIONS = {'explorer': (Explore, 'explore'), 'navigator': (NavigateToPose, 'navigate_to_pose')}
# Cancel requests are processed within 1 s by the explorer, within 0.1 s by the navigator.
DELAYS_S = (0.0, 0.001, 0.004, 0.01, 0.03, 0.06, 0.09, 0.12, 0.2, 0.3, 0.6, 0.9)


class Client:
    """Client of a node without map and scans: its goals wait."""

    def __init__(self, graph, name):
        self.graph = graph
        self.process = graph.start(name, laser_pose='0,0,0')
        self._kind, action = ACTIONS[name]
        self.is_explorer = self._kind is Explore
        self._client = ActionClient(graph.node, self._kind, action)
        # A first goal proves that the server has discovered its client: no later answer is lost.
        first = graph.send_goal(self._client, self._goal())
        graph.cancel(first)
        graph.result(first, 'the first goal')

    def send(self):
        """Future of the handle of a new goal."""
        return self._client.send_goal_async(self._goal())

    def _goal(self):
        goal = self._kind.Goal()
        if self._kind is NavigateToPose:
            goal.pose = messages.pose_stamped_msg(np.zeros(3), 'map', 0)
        return goal

    def accepted(self, sent):
        """Handle of a goal, and the future of its result."""
        self.graph.until(sent.done, 'an answer to the goal')
        assert sent.result().accepted
        return sent.result(), sent.result().get_result_async()

    def wait(self, seconds):
        """Let the graph run for a time of the machine."""
        end_ns = self.now_ns() + round(1e9 * seconds)
        self.graph.until(lambda: self.now_ns() >= end_ns, 'the end of a delay')

    def now_ns(self):
        return self.graph.node.get_clock().now().nanoseconds

    def ended(self, canceling, result):
        """Whether the cancel was accepted, and how the goal ended."""
        self.graph.until(lambda: canceling.done() and result.done(), 'the end of the goal')
        return len(canceling.result().goals_canceling) == 1, result.result().status


@pytest.mark.parametrize('name', ACTIONS)
def test_a_goal_ends_cancelled_if_its_cancel_was_accepted_and_else_aborted_by_a_newer_one(
    graph, name
):
    client = Client(graph, name)
    cancelled_before_its_replacement(client)
    cancelled_in_the_moment_of_its_replacement(client)
    cancelled_after_its_replacement(client)


def cancelled_before_its_replacement(client):
    endings = []
    handle, result = client.accepted(client.send())
    for delay_s in DELAYS_S:
        canceling = handle.cancel_goal_async()
        client.graph.until(canceling.done, 'an answer to the cancel')
        client.wait(delay_s)
        newer = client.send()
        endings.append(client.ended(canceling, result))
        if client.is_explorer:
            status = result.result().result.status
            assert (status.reason_code, status.reason) == (
                ExplorationStatus.CANCELLED,
                'cancelled',
            )
        handle, result = client.accepted(newer)
    assert endings == len(DELAYS_S) * [(True, GoalStatus.STATUS_CANCELED)]


def cancelled_in_the_moment_of_its_replacement(client):
    """Both requests wait in the node at its continuation; it may process either first."""
    endings = []
    for cancels_first in (True, False):
        handle, result = client.accepted(client.send())
        client.process.send_signal(signal.SIGSTOP)
        newer = None if cancels_first else client.send()
        canceling = handle.cancel_goal_async()
        newer = newer or client.send()
        client.process.send_signal(signal.SIGCONT)
        endings.append(client.ended(canceling, result))
        client.accepted(newer)
    assert set(endings) <= {
        (True, GoalStatus.STATUS_CANCELED),
        (False, GoalStatus.STATUS_ABORTED),
    }


def cancelled_after_its_replacement(client):
    handle, result = client.accepted(client.send())
    _, newer = client.accepted(client.send())
    client.graph.until(result.done, 'the end of the replaced goal')
    assert client.ended(handle.cancel_goal_async(), result) == (False, GoalStatus.STATUS_ABORTED)
    assert not newer.done()
