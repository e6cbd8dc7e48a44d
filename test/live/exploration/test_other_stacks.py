"""The explorer with the navigation and the SLAM of others, on a live graph."""

import math

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from std_msgs.msg import String, UInt32
from support.niches import START, write_niches

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.files import occupancy_maps, package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.ros import messages, qos
from thinmap_ros.sim.coverage import observable_cells
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World

pytestmark = pytest.mark.live
PEERS = 'support.peers'
AT_A_WALL = '0.35,4.0,3.14'
DUNGEON = '42.05,21.05,-1.238'
RANGE_M = 8.0


class Exploration:
    """An exploration of a simulated building, with what is published of it."""

    def __init__(self, graph, world, start):
        self.graph = graph
        self.world = str(world)
        self.start = start
        self.maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
        self.words = graph.heard('explore/status', String, qos.LATCHED)
        self.targets = graph.heard('exploration_target', PoseStamped, qos.LATCHED)
        self.collisions = graph.heard('collisions', UInt32, qos.LATCHED)
        self.status = graph.heard('exploration_status', ExplorationStatus, qos.LATCHED)
        self.client = ActionClient(graph.node, Explore, 'explore')
        self.others = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')
        self.mode = graph.node.create_publisher(String, 'nav2_mode', qos.LATCHED)

    def start_nav2(self, **values):
        return self.graph.start(
            'nav2', package=PEERS, use_sim_time=True, max_speed_m_s=0.4, **values
        )

    def start_foreign_slam(self):
        """Simulation, SLAM and explorer: none of thinmap's localizer, mapper or graph."""
        self.graph.start('foreign_slam', package=PEERS, use_sim_time=True, laser_range_m=RANGE_M)
        self._start_sim('pose', 3)

    def start_our_slam(self):
        """The same with thinmap's localizer, mapper and graph."""
        names = ('localizer', 'grid_mapper', 'topology_builder')
        x, y, theta = self.start.split(',')
        at = {'initial_x_m': float(x), 'initial_y_m': float(y), 'initial_yaw_rad': float(theta)}
        self.graph.start('thinmap', arguments=names, use_sim_time=True, **at)
        self._start_sim('local_topology', 2)

    def _start_sim(self, lockstep, subscribers):
        self.graph.start(
            'sim',
            remap=(f'{lockstep}:=paced',),
            world=self.world,
            start=self.start,
            real_time_factor=20.0,
            lockstep=lockstep,
            wait_for_subscribers=subscribers,
            range_max_m=RANGE_M,
        )

    def start_explorer(self, **values):
        return self.graph.start('explorer', use_sim_time=True, **values)

    def tell(self, mode):
        """Have the substitute for Nav2 behave differently from the next goal on."""
        self.mode.publish(String(data=mode))

    def ended(self, **goal):
        """Final status of an exploration that the action starts."""
        ended = self.graph.act(Explore, 'explore', Explore.Goal(**goal))
        return ended.status, ended.result.status

    def until_logged(self, text):
        self.graph.until(lambda: text in self.graph.log('explorer'), text)

    def drive_home(self):
        """Send a goal to the start to Nav2 as somebody else; returns its handle."""
        goal = NavigateToPose.Goal()
        goal.pose = messages.pose_stamped_msg(pose_of(self.start), 'map', 0)
        return self.graph.send_goal(self.others, goal)

    def drive_to_somewhere_else(self):
        """Send somebody else's goal to Nav2: it pauses the exploration until it is reached."""
        self.graph.until(lambda: self.targets and self.is_in_progress(), 'a target')
        began_m = self.status[-1].distance_m if self.status else 0.0
        self.graph.until(
            lambda: self.status and self.status[-1].distance_m > began_m + 1.5,
            'a place that is not the goal',
        )
        before = len(self.words)
        handle = self.drive_home()
        self.graph.until(lambda: 'exploration_paused' in self.word_list()[before:], 'it pauses')
        ended = self.graph.result(handle, 'the goal of somebody else')
        assert ended.status == GoalStatus.STATUS_SUCCEEDED
        self.graph.until(self.is_in_progress, 'it continues')

    def is_in_progress(self):
        return bool(self.words) and self.words[-1].data == 'exploration_in_progress'

    def word_list(self):
        return [message.data for message in self.words]

    def coverage(self, T_world_map):
        """Share of what can be observed that the last map holds as free."""
        world = World.from_patch(*read_world(package_data.world_path(self.world)))
        cells = observable_cells(world, pose_of(self.start), PRESETS['2dx'].radius_m, RANGE_M)
        return cells.coverage(messages.grid_from_msg(self.maps[-1]), T_world_map)

    def is_complete(self, end, T_world_map, at_least):
        """Check the end: all is resolved, by a robot that touched nothing; prints the coverage."""
        assert end.reason_code == ExplorationStatus.ALL_RESOLVED, end.reason
        coverage = self.coverage(T_world_map)
        print(f'coverage {coverage:.4f}, {end.distance_m:.1f} m, {end.elapsed.sec} s')
        assert coverage >= at_least
        assert self.collisions[-1].data == 0


@pytest.fixture
def niches(graph, tmp_path):
    return Exploration(graph, write_niches(tmp_path), START)


def pose_of(text):
    return np.array([float(part) for part in text.split(',')])


def small_dungeon(shared_data, folder):
    """World file of the part of a dungeon within 12 m of the start, closed by walls."""
    _, patch, _ = read_world(shared_data / 'worlds' / 'dungeon' / 'd114.yaml')
    x, y = pose_of(DUNGEON)[:2]
    low, high = patch.frame.cells_of(np.array([[x - 12.0, y - 12.0], [x + 12.0, y + 12.0]]))
    low = np.maximum(low, 0)
    cells = patch.cells[low[0] : high[0], low[1] : high[1]].copy()
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    frame = patch.frame.with_origin_at(*low.tolist())
    return occupancy_maps.write_map(folder / 'small_dungeon', GridPatch(frame, cells))


@pytest.mark.cpu_budget(20.0, 'a whole exploration, and the path back')
def test_a_foreign_slam_and_nav2_are_enough(graph, niches):
    niches.start_foreign_slam()
    niches.start_nav2()
    niches.start_explorer()
    status, end = niches.ended(return_home=True)
    assert status == GoalStatus.STATUS_SUCCEEDED
    niches.is_complete(end, pose_of(START), 0.99)
    # The result of an action and the topic beside it may come in any order.
    graph.until(lambda: niches.words[-1].data == 'returned_to_origin', 'its last status')
    assert niches.word_list()[-3:] == [
        'exploration_complete',
        'returning_to_origin',
        'returned_to_origin',
    ]


@pytest.mark.cpu_budget(20.0, 'a whole exploration')
def test_nav2_drives_through_rooms_that_our_nodes_map(graph, niches):
    niches.start_our_slam()
    # The simulation waits for the test as well: it must act before everything is explored.
    graph.paced()
    niches.start_nav2(paced_by='heard_too', mode='refuse')
    # From now on the server answers this client. Its first answer can be lost, and it is asked
    # again after a while: an explorer would have given up all targets that are refused meanwhile.
    assert not niches.drive_home().accepted
    niches.start_explorer()
    handle = graph.send_goal(niches.client, Explore.Goal())
    niches.until_logged('goal rejected')
    niches.tell('abort_once')
    niches.until_logged('target not reached: failed to create a plan')
    niches.drive_to_somewhere_else()
    ended = graph.result(handle, 'the exploration')
    assert ended.status == GoalStatus.STATUS_SUCCEEDED
    niches.is_complete(ended.result.status, None, 0.97)


def test_a_robot_that_starts_in_front_of_a_wall_turns_and_explores(graph):
    room = Exploration(graph, 'room_10x10', AT_A_WALL)
    room.start_our_slam()
    room.start_nav2(paced_by='local_topology')
    room.start_explorer()
    status, end = room.ended(area_limit_m2=40.0)
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert end.reason_code == ExplorationStatus.BUDGET_EXHAUSTED
    assert math.dist(
        messages.pose_from_msg(room.targets[0].pose)[:2], pose_of(AT_A_WALL)[:2]
    ) == pytest.approx(0.0, abs=0.1)
    assert room.collisions[-1].data == 0


@pytest.mark.slow
def test_nav2_and_a_foreign_slam_complete_a_dungeon(graph, shared_data, tmp_path):
    dungeon = Exploration(graph, small_dungeon(shared_data, tmp_path), DUNGEON)
    dungeon.start_foreign_slam()
    dungeon.start_nav2()
    dungeon.start_explorer()
    status, end = dungeon.ended()
    assert status == GoalStatus.STATUS_SUCCEEDED
    dungeon.is_complete(end, pose_of(DUNGEON), 0.98)


@pytest.mark.slow
def test_nav2_drives_through_a_dungeon_that_our_nodes_map(graph, shared_data, tmp_path):
    dungeon = Exploration(graph, small_dungeon(shared_data, tmp_path), DUNGEON)
    dungeon.start_our_slam()
    dungeon.start_nav2(paced_by='local_topology')
    dungeon.start_explorer()
    status, end = dungeon.ended()
    assert status == GoalStatus.STATUS_SUCCEEDED
    dungeon.is_complete(end, None, 0.97)
