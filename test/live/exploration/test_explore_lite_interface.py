"""Topics and parameters of explore_lite, with a robot that stands in a room with another SLAM."""

from array import array

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import Twist
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from rclpy.qos import QoSProfile
from std_msgs.msg import Bool, String
from support.peers.room_robot import AT, RoomRobot, room
from visualization_msgs.msg import Marker, MarkerArray

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import EndNodeArray, ExplorationStatus
from thinmap_ros.core.se2 import pose
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
HERE = {'laser_pose': '0,0,0', 'use_sim_time': True}


class Listener:
    """What is published under explore_lite's names."""

    def __init__(self, graph):
        self.graph = graph
        self.words = graph.heard('explore/status', String, qos.LATCHED)
        self.status = graph.heard('exploration_status', ExplorationStatus, qos.LATCHED)
        self.end_nodes = graph.heard('end_nodes', EndNodeArray, qos.LATCHED)
        self.markers = graph.heard('explore/frontiers', MarkerArray, QoSProfile(depth=10))
        self.resume = graph.node.create_publisher(Bool, 'explore/resume', 10)

    def word_list(self):
        return [message.data for message in self.words]

    def explores(self):
        """An exploration has begun, with a goal of the action."""
        self.graph.send_goal(ActionClient(self.graph.node, Explore, 'explore'), Explore.Goal())
        self.until_word('exploration_in_progress')

    def until_word(self, word):
        self.graph.until(lambda: self.words and self.words[-1].data == word, word)

    def say(self, resume, word):
        """Publish on explore/resume until the status is a word."""
        self.graph.until(self.resume.get_subscription_count, 'a subscriber of explore/resume')
        self.resume.publish(Bool(data=resume))
        self.until_word(word)


@pytest.fixture
def listener(graph):
    return Listener(graph)


def test_it_starts_by_itself_pauses_and_returns_while_somebody_else_drives(graph, listener):
    robot = RoomRobot(graph, topic='slam/map', base='base_footprint')
    graph.start(
        'explorer',
        **HERE,
        autostart_exploration=True,
        drive=False,
        return_to_init=True,
        robot_base_frame='base_footprint',
        costmap_topic='slam/map',
    )
    listener.until_word('exploration_in_progress')
    graph.until(lambda: robot.targets, 'a target')
    goal = messages.pose_from_msg(robot.targets[-1].pose)
    assert robot.targets[-1].header.frame_id == 'map'
    listener.say(False, 'exploration_paused')
    # A target from before may come after the word.
    for _ in range(2):
        seen = len(robot.targets)
        decisions = len(listener.end_nodes)
        graph.until(lambda n=decisions: len(listener.end_nodes) > n + 3, 'observations')
    assert len(robot.targets) == seen
    listener.say(True, 'exploration_in_progress')
    graph.until(lambda: len(robot.targets) > seen, 'the target again')
    assert np.allclose(messages.pose_from_msg(robot.targets[-1].pose), goal, atol=0.2)
    # The other driver has brought the robot there, and the SLAM has seen the rest of the room.
    robot.at = goal
    robot.patch = room(60)
    listener.until_word('returning_to_origin')
    graph.until(
        lambda: np.allclose(messages.pose_from_msg(robot.targets[-1].pose), AT, atol=0.1),
        'the start as target',
    )
    robot.at = pose(AT[0] + 0.1, AT[1], 1.0)
    listener.until_word('returned_to_origin')
    assert listener.word_list() == [
        'exploration_started',
        'exploration_in_progress',
        'exploration_paused',
        'exploration_in_progress',
        'exploration_complete',
        'returning_to_origin',
        'returned_to_origin',
    ]
    assert listener.status[-1].reason_code == ExplorationStatus.ALL_RESOLVED
    # Nothing is paused any more: no word on explore/resume makes the robot drive.
    targets = len(robot.targets)
    listener.resume.publish(Bool(data=True))
    graph.until(lambda: 'no exploration is paused' in graph.log('explorer'), 'a warning')
    assert listener.word_list()[7:] == []
    assert len(robot.targets) == targets


def test_frontiers_are_published_and_short_ones_are_not(graph, listener):
    robot = RoomRobot(graph, scans=False)
    robot.patch.cells[1:36, 40] = 100  # leaves an opening of 3 cells, 0.3 m
    graph.start('explorer', **HERE, drive=False, min_frontier_size=0.2, robot_radius_m=0.1)
    listener.explores()

    def points():
        return [
            (point.x, point.y)
            for message in listener.markers
            for marker in message.markers
            if marker.type == Marker.POINTS
            for point in marker.points
        ]

    graph.until(points, 'frontiers')
    found = np.array(points())
    assert found[:, 0].min() > 3.7
    assert found[:, 1].min() > 3.5
    graph.stop('explorer')
    graph.start('explorer', **HERE, drive=False, min_frontier_size=0.5, robot_radius_m=0.1)
    ended = graph.act(Explore, 'explore', Explore.Goal())
    assert ended.result.status.reason_code == ExplorationStatus.ALL_RESOLVED


def test_updates_of_a_costmap_are_processed(graph, listener):
    robot = RoomRobot(graph, topic='global_costmap/costmap')
    robot.patch.cells[1:-1, 1:40] = 80  # inflated: free space
    graph.start(
        'explorer',
        **HERE,
        drive=False,
        costmap_topic='global_costmap/costmap',
        costmap_updates_topic='global_costmap/costmap_updates',
    )
    updates = graph.node.create_publisher(
        OccupancyGridUpdate, 'global_costmap/costmap_updates', qos.STREAM
    )
    listener.explores()
    graph.until(lambda: robot.targets, 'a target')
    robot.maps = False
    rest = room(60).cells[:, 40:]
    message = OccupancyGridUpdate(x=40, y=0, width=rest.shape[1], height=rest.shape[0])
    message.header.frame_id = 'map'
    message.data = array('b', rest.tobytes())
    updates.publish(message)
    listener.until_word('exploration_complete')


def test_a_map_that_is_not_latched_is_heard(graph, listener):
    robot = RoomRobot(graph)
    graph.node.destroy_publisher(robot.map)
    robot.map = graph.node.create_publisher(OccupancyGrid, 'map', qos.SENSOR)
    graph.start('explorer', **HERE, drive=False)
    listener.explores()


@pytest.mark.slow
def test_what_is_missing_ends_an_exploration_with_its_name(graph):
    robot = RoomRobot(graph)
    robot.maps = False
    graph.start('explorer', **HERE)
    ended = graph.act(Explore, 'explore', Explore.Goal())
    assert ended.status == GoalStatus.STATUS_ABORTED
    assert ended.result.status.reason_code == ExplorationStatus.SENSOR_TIMEOUT
    assert ended.result.status.reason == 'no map on map for 60 s'
    robot.maps = True
    robot.base = 'elsewhere'
    graph.stop('explorer')
    graph.start('explorer', **HERE)
    ended = graph.act(Explore, 'explore', Explore.Goal())
    assert ended.result.status.reason_code == ExplorationStatus.SENSOR_TIMEOUT
    assert "'base_link'" in ended.result.status.reason


def test_two_names_for_the_robots_frame_must_agree(graph):
    process = graph.start('explorer', base_frame='base', robot_base_frame='base_footprint')
    assert graph.ended(process) == 2
    del graph.processes['explorer']
    line = graph.log('explorer').splitlines()[-1]
    assert line.endswith("expected the same as base_frame = 'base'")


def test_the_robot_stands_still_where_somebody_else_drives(graph, listener):
    commands = graph.heard('cmd_vel', Twist)
    robot = RoomRobot(graph)
    graph.start('nav2', package='support.peers', **HERE)
    graph.start('explorer', **HERE, drive=False, progress_timeout=5.0)
    listener.explores()
    start_ns = robot.time_ns
    graph.until(lambda: robot.time_ns - start_ns > 10e9, 'ten seconds')
    assert not commands
    assert 'not reached' not in graph.log('explorer')
