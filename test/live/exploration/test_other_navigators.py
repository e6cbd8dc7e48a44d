"""The explorer as a client of a navigator that answers late, never, refuses, or is replaced."""

import signal

import numpy as np
import pytest
from action_msgs.msg import GoalStatus, GoalStatusArray
from geometry_msgs.msg import Twist
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from std_msgs.msg import String
from support.peers.room_robot import SPEAK_S, RoomRobot, replace_nav2

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
UNREACHABLE = (GoalStatus.STATUS_ABORTED, ExplorationStatus.UNREACHABLE)


class Scene:
    """A robot in a room, a substitute for Nav2 with a mode, and an exploration."""

    def __init__(self, graph, mode='drive', speak_s=SPEAK_S, **values):
        self.graph = graph
        self.robot = RoomRobot(graph, speak_s=speak_s)
        self.mode = graph.node.create_publisher(String, 'nav2_mode', qos.LATCHED)
        self.tell(mode)
        self.words = graph.heard('explore/status', String, qos.LATCHED)
        self.commands = graph.heard('cmd_vel', Twist)
        self.goals = graph.heard('navigate_to_pose/_action/status', GoalStatusArray, qos.LATCHED)
        self.nav2 = self.start_nav2()
        graph.start('explorer', laser_pose='0,0,0', use_sim_time=True, **values)
        self.client = ActionClient(graph.node, Explore, 'explore')
        self.others = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')
        graph.until(self.others.server_is_ready, 'Nav2')

    def start_nav2(self):
        return self.graph.start(
            'nav2', package='support.peers', laser_pose='0,0,0', use_sim_time=True
        )

    def tell(self, mode):
        self.mode.publish(String(data=mode))

    def explore(self):
        self.handle = self.graph.send_goal(self.client, Explore.Goal())
        return self.handle.get_result_async()

    def end(self, result):
        self.graph.until(result.done, 'the exploration ends')
        return result.result().status, result.result().result.status.reason_code

    def until_it_drives(self):
        self.commands.clear()
        self.graph.until(lambda: len(self.commands) > 5, 'Nav2 drives')

    def until_logged(self, text):
        self.graph.until(lambda: text in self.graph.log('explorer'), text)

    def cancel(self, result):
        """Cancel the exploration; returns the state of Nav2's last goal."""
        self.handle.cancel_goal_async()
        assert self.end(result) == (GoalStatus.STATUS_CANCELED, ExplorationStatus.CANCELLED)
        self.graph.until(lambda: self.goal_state() not in (1, 2, 3), 'Nav2 has ended its goal')
        return self.goal_state()

    def goal_state(self):
        return self.goals[-1].status_list[-1].status


def test_a_goal_that_nav2_never_answers_fails(graph):
    scene = Scene(graph)
    result = scene.explore()
    scene.until_it_drives()
    scene.tell('mute')
    assert scene.end(result) == UNREACHABLE
    assert 'target not reached: no answer for 20 s' in graph.log('explorer')


def test_a_late_answer_counts_and_a_cancelled_exploration_cancels_the_goal(graph):
    scene = Scene(graph)
    scene.nav2.send_signal(signal.SIGSTOP)
    result = scene.explore()
    graph.until(lambda: scene.robot.targets, 'a target')
    clock_ns = scene.robot.time_ns
    graph.until(lambda: scene.robot.time_ns - clock_ns > 12e9, 'twelve seconds without an answer')
    assert 'not reached' not in graph.log('explorer')
    # Time stands until a busy machine has run Nav2 again: it must not become twenty seconds.
    scene.robot.timer.cancel()
    scene.nav2.send_signal(signal.SIGCONT)
    graph.until(lambda: scene.goals and scene.goals[-1].status_list, 'the goal is taken')
    scene.robot.timer.reset()
    scene.until_it_drives()
    assert scene.cancel(result) == GoalStatus.STATUS_CANCELED


@pytest.mark.slow
def test_goals_that_are_aborted_or_rejected_or_make_no_progress_end_in_unreachable(graph):
    scene = Scene(graph, mode='abort', progress_timeout=10.0)
    assert scene.end(scene.explore()) == UNREACHABLE
    assert 'target not reached: failed to create a plan' in graph.log('explorer')
    scene.tell('stall')
    assert scene.end(scene.explore()) == UNREACHABLE
    assert 'target not reached: no progress for 10 s' in graph.log('explorer')
    scene.tell('refuse')
    assert scene.end(scene.explore()) == UNREACHABLE
    assert 'target not reached: goal rejected' in graph.log('explorer')


def test_a_nav2_that_takes_the_place_of_another_gets_the_goal_again(graph):
    scene = Scene(graph)
    result = scene.explore()
    scene.until_it_drives()
    replace_nav2(graph, scene.robot, scene.start_nav2)
    scene.until_it_drives()
    assert scene.cancel(result) == GoalStatus.STATUS_CANCELED


def test_somebody_elses_goal_pauses_the_exploration_until_it_has_ended(graph):
    # Slower: at ten times, two seconds of a busy machine are the 20 s after which a goal fails.
    scene = Scene(graph, speak_s=3.0 * SPEAK_S)
    result = scene.explore()
    scene.until_it_drives()
    assert scene.words[-1].data == 'exploration_in_progress'
    goal = NavigateToPose.Goal()
    goal.pose = messages.pose_stamped_msg(np.array([1.0, 1.0, 0.0]), 'map', 0)
    other = graph.send_goal(scene.others, goal)
    graph.until(lambda: scene.words[-1].data == 'exploration_paused', 'the exploration waits')
    ended = other.get_result_async()
    seen = len(scene.commands)
    graph.until(lambda: len(scene.commands) > seen + 20, 'Nav2 drives for somebody else')
    assert not ended.done()
    assert scene.words[-1].data == 'exploration_paused'
    other.cancel_goal_async()
    graph.until(ended.done, 'the end of the other goal')
    assert ended.result().status == GoalStatus.STATUS_CANCELED
    graph.until(lambda: scene.words[-1].data == 'exploration_in_progress', 'it continues')
    scene.until_it_drives()
    assert 'not reached' not in graph.log('explorer')
    assert scene.cancel(result) == GoalStatus.STATUS_CANCELED
