"""Invalid messages on a live graph: no node dies or publishes NaN."""

import math

import pytest
from action_msgs.msg import GoalStatus
from fuzz.strange_messages import is_plain, is_rejected, made, numbers
from geometry_msgs.msg import Point32, PoseWithCovarianceStamped, Twist
from lifecycle_msgs.srv import GetState
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.action import ActionClient
from sensor_msgs.msg import LaserScan
from support.doctor import Doctor
from tf2_msgs.msg import TFMessage

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import (
    EndNodeArray,
    ExplorationStatus,
    JoinStatus,
    LineFeatureArray,
    LocalGrid,
    LocalizedScan,
    MapTiles,
    ProbabilityGrid,
    RobotMap,
    SlamStatus,
    TeamClaim,
    TopologicalMap,
)
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live


SPOKEN = {
    'pose': PoseWithCovarianceStamped,
    '/tf': TFMessage,
    'line_features': LineFeatureArray,
    'slam_status': SlamStatus,
    'map': OccupancyGrid,
    'grid': ProbabilityGrid,
    'local_grid': LocalGrid,
    'topology': TopologicalMap,
    'local_topology': TopologicalMap,
    'end_nodes': EndNodeArray,
    'exploration_status': ExplorationStatus,
    'cmd_vel': Twist,
    'plan': Path,
    'join_status': JoinStatus,
    'merged_map': OccupancyGrid,
    'merged_topology': TopologicalMap,
}
LISTENERS = {
    'localizer': {
        'odom': Odometry,
        'scan': LaserScan,
        'topology': TopologicalMap,
        'initialpose': PoseWithCovarianceStamped,
    },
    'grid_mapper': {'localized_scan': LocalizedScan},
    'topology_builder': {'local_grid': LocalGrid, 'grid': ProbabilityGrid},
    'explorer': {
        'local_grid': LocalGrid,
        'grid': ProbabilityGrid,
        'topology': TopologicalMap,
        'scan': LaserScan,
    },
    'navigator': {
        'local_grid': LocalGrid,
        'grid': ProbabilityGrid,
        'odom': Odometry,
        'scan': LaserScan,
        'pose': PoseWithCovarianceStamped,
    },
    'map_joiner': {
        '/robot1/map': OccupancyGrid,
        '/robot1/topology': TopologicalMap,
        '/robot2/map': OccupancyGrid,
    },
}
TEAM = {  # in a team also
    'grid_mapper': {'/team/claims': TeamClaim},
    'explorer': {'/team/claims': TeamClaim, '/team/tiles': MapTiles},
    'navigator': {'/team/claims': TeamClaim, '/team/tiles': MapTiles},
}
LATER = {  # converted only when the corresponding message of another topic has arrived
    'localizer': (),
    'grid_mapper': (),
    'topology_builder': (),
    'explorer': ('scan',),
    'navigator': ('pose',),
    'map_joiner': (),
}
ANSWERS = {  # topic that each node publishes after valid messages
    'localizer': 'pose',
    'grid_mapper': 'local_grid',
    'topology_builder': 'local_topology',
    'explorer': 'end_nodes',
    'navigator': 'cmd_vel',
    'map_joiner': 'join_status',
}


class Spoken:
    """Counts the messages of a topic, and keeps none: maps of strange poses are large."""

    def __init__(self, graph, topic, kind):
        self.count = 0
        self.is_finite = True
        graph.node.create_subscription(kind, topic, self._hear, qos.STREAM)

    def _hear(self, message):
        self.count += 1
        self.is_finite &= all(math.isfinite(number) for number in numbers(message))


def set_to_work(graph, name):
    """Send a goal that is not reached to the action servers."""
    if name not in ('explorer', 'navigator'):
        return
    kind, action = (
        (Explore, 'explore') if name == 'explorer' else (NavigateToPose, 'navigate_to_pose')
    )
    client = ActionClient(graph.node, kind, action)
    goal = kind.Goal()
    if name == 'navigator':
        goal.pose.pose.position.x = 1.2
        goal.pose.pose.orientation.w = 1.0
    graph.send_goal(client, goal)


def say(graph, name, publishers, count):
    """Publish a number of strange messages on each topic, as fast as they are processed.

    A response proves that earlier messages were processed. Returns the expected rejections.
    """
    columns = {topic: made(kind, count) for topic, (kind, _) in publishers.items()}
    for row in range(count):
        for topic, (_, publisher) in publishers.items():
            publisher.publish(columns[topic][row])
        graph.call(GetState, f'/{name}/get_state', GetState.Request())
    return {topic: sum(map(is_rejected, column)) for topic, column in columns.items()}


@pytest.mark.parametrize('name', LISTENERS)
@pytest.mark.parametrize(
    'count', [100, pytest.param(10_000, marks=[pytest.mark.slow, pytest.mark.timeout(1800)])]
)
def test_a_node_lives_through_them_publishes_no_nan_and_counts_what_it_rejected(graph, name, count):
    lives_through(graph, name, count, LISTENERS[name])


@pytest.mark.parametrize('name', TEAM)
def test_a_node_of_a_team_lives_through_them(graph, name):
    joined = [RobotMap(name=each, is_joined=True) for each in ('/me', '/a')]
    for each in joined:
        each.pose.orientation.w = 1.0
    join = graph.node.create_publisher(JoinStatus, '/join_status', qos.LATCHED)
    join.publish(JoinStatus(header=messages.header('world', 0), maps=joined))
    listeners = LISTENERS[name] | TEAM[name]
    lives_through(graph, name, 100, listeners, team=True, team_name='/me')


def lives_through(graph, name, count, listeners, **parameters):
    """A node lives through a number of messages on each topic, and works then as before."""
    spoken = {
        topic: Spoken(graph, topic, kind)
        for topic, kind in SPOKEN.items()
        if topic not in listeners and (topic != 'join_status' or name == 'map_joiner')
    }
    doctor = Doctor(graph)
    mount = (
        {} if name in ('grid_mapper', 'topology_builder', 'map_joiner') else {'laser_pose': '0,0,0'}
    )
    graph.start(name, **mount, **parameters)
    publishers = {}
    for topic, kind in listeners.items():
        profile = (
            qos.LATCHED if kind in (LocalGrid, ProbabilityGrid, TopologicalMap) else qos.STREAM
        )
        publishers[topic] = (kind, graph.node.create_publisher(kind, topic, profile))
    graph.until(
        lambda: all(p.get_subscription_count() for _, p in publishers.values()), 'subscriptions'
    )
    set_to_work(graph, name)
    expected = say(graph, name, publishers, count)
    graph.until(lambda: counted(doctor, name, expected) == [], f'counts {expected}')
    graph.until(
        lambda: all(doctor.number(name, f'{topic}: received') >= 0.7 * count for topic in expected),
        'most messages',
    )
    assert doctor.value(name, 'scan: rejected') == '' or any(
        'rejected: ' in p.key for p in doctor.status(name).values
    )
    assert [topic for topic, said in spoken.items() if not said.is_finite] == []
    # It still works; with later stamps, as earlier messages may have been ahead of time.
    answers = spoken[ANSWERS[name]]
    before = answers.count
    ns = [3 * 10**12]

    def good_again():
        ns[0] += 10**8
        for kind, publisher in publishers.values():
            publisher.publish(good(kind, ns[0]))
        return answers.count > before

    if name in ('explorer', 'navigator'):
        set_to_work(graph, name)
    graph.until(good_again, f'an answer of {name}')
    assert answers.is_finite
    assert graph.processes[name].poll() is None
    assert graph.stop(name) == 0, graph.log(name)


def test_goals_that_are_no_goals_end_with_a_reason(graph):
    for name in ('explorer', 'navigator'):
        graph.start(name, laser_pose='0,0,0')
    for wrong in (math.nan, math.inf, 1e30):
        goal = Explore.Goal()
        goal.area.points = [Point32(x=wrong), Point32(x=1.0), Point32(y=1.0)]
        ended = graph.act(Explore, 'explore', goal)
        assert (
            ended.status == GoalStatus.STATUS_ABORTED
            and 'corner of the area' in ended.result.status.reason
        )
        ended = graph.act(Explore, 'explore', Explore.Goal(time_limit_s=wrong))
        assert ended.status == GoalStatus.STATUS_ABORTED and 'limit' in ended.result.status.reason
        goal = NavigateToPose.Goal()
        goal.pose.pose.position.x = wrong
        ended = graph.act(NavigateToPose, 'navigate_to_pose', goal)
        assert ended.status == GoalStatus.STATUS_ABORTED and 'position' in ended.result.error_msg
    for name in ('explorer', 'navigator'):
        assert graph.stop(name) == 0, graph.log(name)


def counted(doctor, name, expected):
    """Topics with too few counted rejections.

    Some messages are lost at this rate.
    """
    return [
        t
        for t, n in expected.items()
        if doctor.number(name, f'{t}: rejected') < 0.7 * n and t not in LATER[name]
    ]


def good(kind, ns):
    """A message of a type without invalid values."""
    found = next(m for m in made(kind, 40) if not is_rejected(m) and is_plain(m))
    found.header.stamp = messages.time_msg(ns)
    return found
