"""The navigator's actions as clients of Nav2 use them: frames, preemption, feedback, codes."""

import math

import numpy as np
import pytest
from action_msgs.msg import GoalStatus, GoalStatusArray
from geometry_msgs.msg import PoseStamped, Quaternion, Twist, TwistStamped
from nav2_msgs.action import NavigateThroughPoses, NavigateToPose
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.action import ActionClient
from support.doctor import Doctor
from support.halls import AT_START, START
from support.peers.still_robot import StillRobot

from thinmap_msgs.msg import LocalGrid, SlamStatus
from thinmap_msgs.srv import ReleaseStop
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live


def pose_at(x, y, frame='map', ns=0):
    return messages.pose_stamped_msg(np.array([x, y, 0.0]), frame, ns)


class Client:
    """Client of both actions, and what the navigator publishes."""

    def __init__(self, graph):
        self.graph = graph
        self._clients = {
            kind: ActionClient(graph.node, kind, name)
            for kind, name in (
                (NavigateToPose, 'navigate_to_pose'),
                (NavigateThroughPoses, 'navigate_through_poses'),
            )
        }
        self.plans = graph.heard('plan', Path, qos.LATCHED)
        self.commands = graph.heard('cmd_vel', Twist)
        self.feedback = []

    def send(self, goal):
        """Future of the result of an accepted goal."""
        kind = NavigateToPose if isinstance(goal, NavigateToPose.Goal) else NavigateThroughPoses
        self.handle = self.graph.send_goal(
            self._clients[kind], goal, lambda m: self.feedback.append(m.feedback)
        )
        assert self.handle.accepted
        return self.handle.get_result_async()

    def to(self, *place, **where):
        return self.send(NavigateToPose.Goal(pose=pose_at(*place, **where)))

    def through(self, *places):
        return self.send(NavigateThroughPoses.Goal(poses=[pose_at(*place) for place in places]))

    def ended(self, future):
        self.graph.until(future.done, 'the goal ends')
        result = future.result()
        return result.status, result.result.error_code, result.result.error_msg

    def drives_to(self, x, y):
        """Wait for a plan that ends there."""
        self.graph.until(
            lambda: self.plans and math.dist(end_of(self.plans[-1]), (x, y)) < 0.15,
            f'a plan to ({x}, {y})',
        )


def end_of(path):
    position = path.poses[-1].pose.position
    return position.x, position.y


@pytest.fixture
def client(graph):
    graph.start('navigator', laser_pose='0,0,0')
    robot = StillRobot(graph)
    client = Client(graph)
    client.robot = robot
    # A goal before the first pose waits for it.
    first = client.to(-3.0, -3.0)
    client.drives_to(-3.0, -3.0)
    graph.until(lambda: any(abs(c.angular.z) > 0.1 for c in client.commands), 'it turns')
    client.first = first
    return client


def test_a_goal_in_another_frame_is_transformed_when_it_arrives(client):
    for place, where, expected in (
        ((2.0, 1.0), {'frame': ''}, (2.0, 1.0)),
        ((2.2, 1.0), {'frame': '/map'}, (2.2, 1.0)),
        ((2.0, 1.0), {'frame': 'odom'}, (3.0, 3.0)),
        ((2.4, 1.0), {'frame': 'base_link'}, (2.4, 1.0)),
    ):
        client.to(*place, **where)
        client.drives_to(*expected)
    then_ns = client.robot.stamp_ns
    client.graph.until(lambda: client.robot.stamp_ns > then_ns + 2e8, 'later transforms')
    client.to(2.0, 2.0, frame='odom', ns=then_ns)
    client.drives_to(3.0, 4.0)


def test_an_invalid_goal_is_aborted_with_the_reason_and_the_old_one_goes_on(client):
    now_ns = client.graph.node.get_clock().now().nanoseconds
    cases = (
        ({'x': math.nan}, {}, 9000, 'position'),
        ({'x': math.inf}, {}, 9000, 'position'),
        ({}, {'orientation': Quaternion(w=0.5)}, 9000, 'norm 1'),
        ({}, {'orientation': Quaternion(w=0.0)}, 9000, 'norm 1'),
        ({'frame': 'moon'}, {}, 9002, 'moon'),
        ({'frame': 'odom', 'ns': now_ns + 60 * 10**9}, {}, 9002, 'older than requested'),
        ({'frame': 'odom', 'ns': now_ns - 60 * 10**9}, {}, 9002, 'odom'),
    )
    # Silent, so that the first goal waits: that of a robot that does not move ends after 3 s.
    client.robot.timer.cancel()
    for where, change, code, reason in cases:
        pose = pose_at(where.get('x', 1.0), 1.0, where.get('frame', 'map'), where.get('ns', 0))
        if change:
            pose.pose.orientation = change['orientation']
        for goal in (
            NavigateToPose.Goal(pose=pose),
            NavigateThroughPoses.Goal(poses=[pose_at(1.0, 1.0), pose]),
        ):
            status, error_code, error_msg = client.ended(client.send(goal))
            assert (status, error_code) == (GoalStatus.STATUS_ABORTED, code), error_msg
            assert reason in error_msg and '\n' not in error_msg
    status, code, reason = client.ended(client.through())
    assert (status, code) == (GoalStatus.STATUS_ABORTED, 9000) and '0 poses' in reason
    client.robot.timer.reset()
    client.feedback.clear()
    client.graph.until(lambda: len(client.feedback) > 3, 'feedback of the first goal')
    assert not client.first.done()
    client.drives_to(-3.0, -3.0)


def test_a_newer_goal_replaces_the_running_one_across_both_actions(client):
    old = client.first
    for send, place in (
        (lambda: client.to(2.0, 1.0), (2.0, 1.0)),
        (lambda: client.through((3.0, 1.0), (4.0, 1.0)), (3.0, 1.0)),
        (lambda: client.through((3.0, -1.0), (4.0, 1.0)), (3.0, -1.0)),
        (lambda: client.to(-2.0, 1.0), (-2.0, 1.0)),
    ):
        new = send()
        assert client.ended(old) == (GoalStatus.STATUS_ABORTED, 0, 'replaced by a newer goal')
        client.drives_to(*place)
        assert not new.done()
        old = new
    cancel = client.handle.cancel_goal_async()
    client.graph.until(cancel.done, 'an answer to the cancellation')
    assert len(cancel.result().goals_canceling) == 1
    assert client.ended(old)[:2] == (GoalStatus.STATUS_CANCELED, 0)
    # Commands from before may still be on their way.
    client.graph.drain()
    assert is_stopped(client.commands[-1])
    client.commands.clear()
    status, code, reason = client.ended(client.to(30.0, 1.0))
    assert (status, code) == (GoalStatus.STATUS_ABORTED, 9000)
    assert reason == 'no path to (30.00, 1.00)'
    assert all(is_stopped(command) for command in client.commands)


def knows(message, x, y):
    """Whether a place is known to be free."""
    patch = messages.grid_from_msg(message)
    cell = patch.frame.cells_of(np.array([[x, y]]))[0]
    return bool(patch.contains(np.array([[x, y]]))[0]) and bool(patch.free[tuple(cell)])


def is_stopped(command):
    return command.linear.x == command.angular.z == 0.0


def test_feedback_has_the_fields_of_nav2_several_times_a_second(client):
    def at_least(count):
        client.feedback.clear()
        client.graph.until(lambda: len(client.feedback) > count, 'feedback')
        return client.feedback[1:]

    first = client.to(4.0, 3.0)
    received = at_least(10)
    for feedback in received:
        assert feedback.current_pose.header.frame_id == 'map'
        assert feedback.current_pose.pose.position.x == pytest.approx(0.0, abs=1e-6)
        assert feedback.distance_remaining == pytest.approx(5.0, abs=0.3)
        assert feedback.number_of_recoveries == 0
    times = [messages.seconds(feedback.navigation_time) for feedback in received]
    assert min(np.diff(times)) > 0.0
    goals = [first]

    def is_regular():
        """Whether the last ten came ten times a second: a busy machine holds up some."""
        if goals[-1].done():  # the robot does not move
            goals.append(client.to(4.0, 3.0))
        times = [messages.seconds(feedback.navigation_time) for feedback in client.feedback[-10:]]
        return float(np.median(np.diff(times))) == pytest.approx(0.1, abs=0.05)

    client.graph.until(is_regular, 'ten in a row, ten times a second')
    # The commanded speed is that of a robot that does not move: nothing to estimate while it turns.
    client.to(4.0, 0.0)
    client.graph.until(
        lambda: client.feedback[-1].estimated_time_remaining.sec > 0, 'an estimate when it drives'
    )
    latest = client.feedback[-1]
    assert messages.seconds(latest.estimated_time_remaining) > 4.0 / 0.25
    client.graph.until(first.done, 'the end of the goal that was replaced')
    client.through((1.0, 0.0), (1.0, 3.0), (4.0, 3.0))
    for feedback in at_least(3):
        assert feedback.number_of_poses_remaining == 3
        assert feedback.distance_remaining == pytest.approx(7.0, abs=0.3)


def test_goal_pose_of_rviz_is_a_goal_of_the_action(client):
    graph = client.graph
    statuses = graph.heard('navigate_to_pose/_action/status', GoalStatusArray, qos.LATCHED)
    doctor = Doctor(graph)
    publisher = graph.node.create_publisher(PoseStamped, 'goal_pose', 10)
    client.robot.timer.cancel()  # the first goal waits
    graph.until(publisher.get_subscription_count, 'a subscription')
    client.robot.timer.reset()
    publisher.publish(pose_at(2.0, 2.0, 'odom'))
    client.drives_to(3.0, 4.0)
    assert client.ended(client.first) == (GoalStatus.STATUS_ABORTED, 0, 'replaced by a newer goal')
    graph.until(
        lambda: (
            [s.status for m in statuses[-1:] for s in m.status_list][-1:]
            == [GoalStatus.STATUS_EXECUTING]
        ),
        'the goal is the one of the action',
    )
    publisher.publish(pose_at(2.0, 2.0, 'moon'))
    graph.until(lambda: doctor.number('navigator', 'goal_pose: rejected') == 1, 'it is counted')
    assert "goal_pose: frame 'moon'" in graph.log('navigator')


def test_after_a_protective_stop_it_drives_on_only_when_it_is_told_to(graph):
    graph.start('navigator', laser_pose='0,0,0', resume_after_stop=False)
    StillRobot(graph)
    client = Client(graph)
    states = graph.node.create_publisher(SlamStatus, 'slam_status', 10)
    graph.until(states.get_subscription_count, 'a subscription')
    first = client.to(-3.0, -3.0)
    graph.until(lambda: any(abs(c.angular.z) > 0.1 for c in client.commands), 'it turns')
    states.publish(SlamStatus(state=SlamStatus.LOST))
    status, _, reason = client.ended(first)
    assert status == GoalStatus.STATUS_ABORTED
    assert 'lost' in reason and reason.endswith('until it is released: ~/release_stop')
    states.publish(SlamStatus(state=SlamStatus.TRACKING))
    _, _, reason = client.ended(client.to(-2.0, -2.0))
    assert reason == 'goal: the robot is stopped: /stop: /navigator'
    answer = graph.call(ReleaseStop, 'navigator/release_stop', ReleaseStop.Request())
    assert answer.success and answer.message == 'released: /navigator'
    client.to(-2.0, -2.0)
    client.drives_to(-2.0, -2.0)


@pytest.mark.parametrize('is_stamped', [False, True])
def test_commands_have_the_type_of_the_parameter(graph, is_stamped):
    kind = TwistStamped if is_stamped else Twist
    commands = graph.heard('cmd_vel', kind)
    graph.start(
        'navigator',
        laser_pose='0,0,0',
        enable_stamped_cmd_vel=is_stamped,
        base_frame='base_footprint',
    )
    StillRobot(graph, base_frame='base_footprint')
    client = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')
    before_ns = graph.node.get_clock().now().nanoseconds
    graph.send_goal(client, NavigateToPose.Goal(pose=pose_at(4.0, 0.0)))
    graph.until(lambda: len(commands) > 5, 'commands')
    twists = [c.twist if is_stamped else c for c in commands]
    graph.until(lambda: commands[-1].twist.linear.x > 0.1 if is_stamped else True, 'it drives')
    assert all(twist.linear.x >= 0.0 for twist in twists)
    if is_stamped:
        assert {c.header.frame_id for c in commands} == {'base_footprint'}
        stamps = [messages.stamp_ns(c.header.stamp) for c in commands]
        assert before_ns < stamps[0] and stamps == sorted(set(stamps))
    assert graph.stop('navigator') == 0


def test_the_simulated_robot_obeys_commands_of_both_types(graph):
    odometry = graph.heard('odom', Odometry)
    doctor = Doctor(graph)
    graph.start('sim', start='2.0,2.0,0.0', real_time_factor=4.0)

    def drives(publisher, command, v):
        def is_driving():
            publisher.publish(command)
            return odometry and odometry[-1].twist.twist.linear.x == pytest.approx(v)

        graph.until(is_driving, f'it drives at {v} m/s')

    twist = graph.node.create_publisher(Twist, 'cmd_vel', 10)
    drives(twist, messages.twist_msg(0.1, 0.0), 0.1)
    graph.node.destroy_publisher(twist)
    stamped = graph.node.create_publisher(TwistStamped, 'cmd_vel', 10)
    drives(stamped, TwistStamped(twist=messages.twist_msg(0.2, 0.0)), 0.2)
    graph.node.destroy_publisher(stamped)
    twist = graph.node.create_publisher(Twist, 'cmd_vel', 10)
    drives(twist, messages.twist_msg(0.3, 0.0), 0.3)
    twist.publish(messages.twist_msg(math.nan, 0.0))
    graph.until(lambda: doctor.number('sim', 'cmd_vel: rejected') == 1, 'NaN is counted')
    assert graph.stop('sim') == 0, graph.log('sim')


@pytest.mark.parametrize('source', ['tf', 'none'])
def test_the_robot_reaches_its_goal_with_odometry_by_tf_and_without_any(graph, source):
    truth = graph.heard('ground_truth', PoseStamped)
    graph.start('localizer', use_sim_time=True, odom_source=source, **AT_START)
    graph.start('grid_mapper', use_sim_time=True)
    graph.start('navigator', use_sim_time=True, odom_source=source)
    tf = '/tf:=/tf' if source == 'tf' else '/tf:=/unheard_tf'
    graph.start(
        'sim',
        remap=('odom:=unheard', tf, *graph.paced('local_grid', LocalGrid)),
        start=START,
        wait_for_subscribers=2,
        real_time_factor=2.0,
        lockstep='local_grid',
    )
    goal = pose_at(3.0, 2.6)
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    graph.until(lambda: maps and knows(maps[-1], 3.0, 2.6), 'a map that knows the goal')
    client = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')
    ended = graph.result(graph.send_goal(client, NavigateToPose.Goal(pose=goal)), 'the goal')
    assert ended.status == GoalStatus.STATUS_SUCCEEDED, ended
    place = truth[-1].pose.position
    assert math.dist((place.x, place.y), (3.0, 2.6)) < 0.3
