"""An explorer that is killed and started again continues with the goal of its client."""

import json
import signal
import time

import pytest
from action_msgs.msg import GoalStatus, GoalStatusArray
from rclpy.action import ActionClient
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger
from support.peers.room_robot import RoomRobot, replace_nav2

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
AGAIN_S = 1.0
RECOVER_S = 1000.0  # includes the start of the node
TIME_LIMIT_S = 60.0  # simulated: ten times as fast as the machine's


class Exploration:
    """A robot that stands in a room, a substitute for Nav2, and an explorer."""

    def __init__(self, graph, **parameters):
        self.graph = graph
        self.robot = RoomRobot(graph)
        self.status = graph.heard('exploration_status', ExplorationStatus, qos.LATCHED)
        self.words = graph.heard('explore/status', String, qos.LATCHED)
        self.explores = graph.heard('explore/_action/status', GoalStatusArray, qos.LATCHED)
        self.drives = graph.heard('navigate_to_pose/_action/status', GoalStatusArray, qos.LATCHED)
        # It accepts goals and does not report on them: they stay until they are replaced.
        self._mode = graph.node.create_publisher(String, 'nav2_mode', qos.LATCHED)
        self._mode.publish(String(data='stall'))
        self.start_nav2()
        self.start(**parameters)

    def start_nav2(self):
        self.graph.start('nav2', package='support.peers', laser_pose='0,0,0', use_sim_time=True)

    def start(self, recovery_timeout_s=RECOVER_S, **parameters):
        self.graph.start(
            'explorer',
            laser_pose='0,0,0',
            use_sim_time=True,
            progress_timeout=0.0,
            recovery_timeout_s=recovery_timeout_s,
            **parameters,
        )
        if self.robot.timer.is_canceled():
            self.graph.until(lambda: 'ready' in self.graph.log('explorer'), 'the explorer')
            self.robot.timer.reset()

    def kill(self):
        """Kill the explorer once it has saved its present state; time stands until the next one."""
        since_ns = time.time_ns()
        (file,) = (self.graph.folder / 'state').glob('[!.]*.explorer.npz')
        self.graph.until(lambda: file.stat().st_mtime_ns > since_ns, 'a checkpoint')
        self.robot.timer.cancel()
        self.graph.stop('explorer', signal.SIGKILL)
        self.status.clear()
        self.words.clear()
        self.explores.clear()

    def until_elapsed(self, seconds):
        self.graph.until(
            lambda: self.status and messages.seconds(self.status[-1].elapsed) > seconds,
            f'{seconds} s of the exploration',
        )

    def until_driving(self):
        """Id of the last goal of Nav2, when it drives to it."""
        self.graph.until(
            lambda: self.drives and last(self.drives)[1] == GoalStatus.STATUS_EXECUTING,
            'Nav2 drives',
        )
        return last(self.drives)[0]


def last(arrays):
    """Id and status of the last goal."""
    status = arrays[-1].status_list[-1]
    return bytes(status.goal_info.goal_id.uuid), status.status


def test_the_goal_of_a_killed_explorer_ends_with_the_result_of_the_whole_exploration(graph):
    exploration = Exploration(graph)
    result = graph.folder / 'result.json'
    monitor = graph.start(
        'demo_monitor', time_limit_s=TIME_LIMIT_S, result=str(result), use_sim_time=True
    )
    exploration.until_elapsed(10.0)
    graph.until(lambda: exploration.explores, 'the status of the goal')
    goal, _ = last(exploration.explores)
    drive = exploration.until_driving()
    exploration.kill()
    exploration.start()
    graph.until(lambda: 'restored the state' in graph.log('explorer'), 'it remembers')
    graph.until(lambda: exploration.explores, 'the status of its goal')
    assert last(exploration.explores) == (goal, GoalStatus.STATUS_EXECUTING)
    # The last drive of the killed one is its own: it is replaced, and not waited for.
    graph.until(lambda: exploration.until_driving() != drive, 'it drives again')
    graph.until(lambda: monitor.poll() is not None, 'the end of the exploration')
    assert messages.seconds(exploration.status[0].elapsed) > 10.0
    written = json.loads(result.read_text())
    assert written['reason'] == f'time limit of {TIME_LIMIT_S:.0f} s'
    graph.until(
        lambda: last(exploration.explores) == (goal, GoalStatus.STATUS_SUCCEEDED), 'it is public'
    )
    assert 'exploration_paused' not in {word.data for word in exploration.words}


def test_an_ordinary_client_has_feedback_again_can_cancel_and_asks_again_for_the_result(graph):
    exploration = Exploration(graph)
    feedback = []
    client = ActionClient(graph.node, Explore, 'explore')
    handle = graph.send_goal(client, Explore.Goal(), feedback.append)
    lost = handle.get_result_async()
    graph.until(lambda: feedback, 'feedback')
    exploration.until_elapsed(10.0)
    exploration.kill()
    feedback.clear()
    exploration.start()
    # Several, so that all endpoints of the new explorer are discovered.
    graph.until(lambda: len(feedback) > 10, 'feedback on the same goal')
    assert messages.seconds(feedback[-1].feedback.status.elapsed) > 10.0
    # Nav2 is killed before it has reported on its goal: the server in its place gets it again.
    drive = exploration.until_driving()
    replace_nav2(graph, exploration.robot, exploration.start_nav2)
    graph.until(lambda: exploration.until_driving() != drive, 'Nav2 has the goal again')
    assert len(graph.cancel(handle, AGAIN_S).goals_canceling) == 1
    ended = graph.result(handle, 'the goal', AGAIN_S)
    assert (ended.status, ended.result.status.reason) == (
        GoalStatus.STATUS_CANCELED,
        'cancelled',
    )
    assert not lost.done(), 'what was asked for before is lost: the client has to ask again'
    # Without recovery the goal is not known any more, and a client that asks gets status UNKNOWN.
    exploration.kill()
    exploration.start(recovery_timeout_s=0.0)
    assert graph.result(handle, 'the goal', AGAIN_S).status == GoalStatus.STATUS_UNKNOWN


def test_whatever_explores_is_a_goal_that_cancel_and_stop_end_for_good(graph):
    """One that started by itself is paused, killed and cancelled; one of a client is stopped."""
    stop = graph.node.create_publisher(Bool, 'stop', qos.LATCHED)
    resume = graph.node.create_publisher(Bool, 'explore/resume', qos.STREAM)
    own = {'autostart_exploration': True}
    exploration = Exploration(graph, **own)
    exploration.until_driving()
    graph.until(lambda: exploration.explores, 'the status of its own goal')
    goal, _ = last(exploration.explores)
    resume.publish(Bool(data=False))
    graph.until(lambda: exploration.words[-1].data == 'exploration_paused', 'a pause')
    exploration.kill()
    exploration.start(**own)
    graph.until(lambda: exploration.explores, 'the status of the same goal')
    assert last(exploration.explores) == (goal, GoalStatus.STATUS_EXECUTING)
    assert graph.call(Trigger, 'explorer/cancel', Trigger.Request()).message == 'exploration ended'
    graph.until(lambda: last(exploration.explores) == (goal, GoalStatus.STATUS_ABORTED), 'its end')
    assert graph.call(Trigger, 'explorer/cancel', Trigger.Request()).message == 'none to end'
    client = ActionClient(graph.node, Explore, 'explore')
    driven = graph.send_goal(client, Explore.Goal())
    exploration.until_driving()
    stop.publish(Bool(data=True))
    ended = graph.result(driven, 'the goal')
    stopped = 'the robot is stopped: /stop: /test_client'
    assert (ended.status, ended.result.status.reason) == (GoalStatus.STATUS_ABORTED, stopped)
    refused = graph.act(Explore, 'explore', Explore.Goal())
    assert (refused.status, refused.result.status.reason) == (GoalStatus.STATUS_ABORTED, stopped)
    graph.until(
        lambda: last(exploration.drives)[1] == GoalStatus.STATUS_CANCELING,
        'Nav2 has the cancellation',
    )
    stop.publish(Bool(data=False))
    resume.publish(Bool(data=True))
    graph.until(lambda: 'no exploration is paused' in graph.log('explorer'), 'a warning')
    assert exploration.status[-1].state == ExplorationStatus.FINISHED
    assert last(exploration.drives)[1] == GoalStatus.STATUS_CANCELING
