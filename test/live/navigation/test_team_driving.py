"""The navigator beside another robot of its team: right of way, and ground that only that knows."""

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Twist
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import Path
from rclpy.action import ActionClient
from support.doctor import Doctor
from support.peers.still_robot import PERIOD_S, StillRobot
from support.team_talk import ME, T_ME_OTHER, TeamTalk

from thinmap_ros.core import se2
from thinmap_ros.core.grid.moved import overlaid
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live


class Driver:
    """A navigator of a team, and a client of it."""

    def __init__(self, graph):
        graph.start('navigator', laser_pose='0,0,0', team=True, team_name=ME, blocked_timeout_s=1.0)
        self.graph = graph
        self.robot = StillRobot(graph)
        self.talk = TeamTalk(graph)
        self.doctor = Doctor(graph)
        self.commands = graph.heard('cmd_vel', Twist)
        self.plans = graph.heard('plan', Path, qos.LATCHED)
        self._client = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')

    def goes_to(self, x, y):
        """Future of the result of a goal."""
        pose = messages.pose_stamped_msg(np.array([x, y, 0.0]), 'map', 0)
        handle = self.graph.send_goal(self._client, NavigateToPose.Goal(pose=pose))
        return handle.get_result_async()

    def hears_robot(self):
        """Wait until the navigator has heard more of the other robot."""
        topics = ('/join_status', '/team/claims')

        def received():
            return [self.doctor.number('navigator', f'{topic}: received') for topic in topics]

        _, before = received()

        def is_heard():
            joined, claims = received()
            # Those after the first were told since.
            return joined and claims > before + 20

        self.graph.until(is_heard, 'the other robot is heard')

    def ended(self, future):
        self.graph.until(future.done, 'the goal ends')
        return future.result().status, future.result().result.error_msg


@pytest.fixture
def driver(graph):
    return Driver(graph)


def test_it_does_not_drive_into_a_robot_that_stands(graph, driver):
    place = [0.6, 0.0]
    graph.node.create_timer(PERIOD_S, lambda: driver.talk.stands_at(*place))
    driver.talk.join()
    driver.hears_robot()
    # The laser shows nothing there.
    status, reason = driver.ended(driver.goes_to(3.0, 0.0))
    assert status == GoalStatus.STATUS_ABORTED, reason
    # It may turn, to drive around, but this robot does not move.
    assert {each.linear.x for each in driver.commands} == {0.0}

    place[1] = 1.5
    driver.hears_robot()
    driver.goes_to(3.0, 0.0)
    graph.until(lambda: any(each.linear.x > 0.0 for each in driver.commands), 'it drives')


def test_it_plans_over_ground_that_only_another_robot_knows(graph, driver):
    free = GridPatch(GridFrame(5.0, -2.0, 0.1), np.zeros((40, 60), dtype=np.int8))
    base = GridPatch(GridFrame(0.02, 0.05, 0.1), np.full((1, 1), UNKNOWN, dtype=np.int8))
    goal = (9.0, 0.0)
    status, reason = driver.ended(driver.goes_to(*goal))
    assert status == GoalStatus.STATUS_ABORTED
    assert reason.startswith('no path')
    driver.talk.join()
    driver.talk.knows(overlaid(base, free, se2.invert(T_ME_OTHER)))

    def has_plan():
        if not driver.plans:
            return False
        end = driver.plans[-1].poses[-1].pose.position
        return abs(end.x - goal[0]) < 0.2 and abs(end.y - goal[1]) < 0.2

    attempt = driver.goes_to(*goal)

    def tries():
        nonlocal attempt
        if attempt.done():
            attempt = driver.goes_to(*goal)
        return has_plan()

    graph.until(tries, 'a plan to the goal')
