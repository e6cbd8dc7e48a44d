"""The explorer with the navigation and the SLAM of others, on a live graph."""

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import String, UInt32

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.ros import messages, qos
from thinmap_ros.sim.coverage import observable_cells
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World

pytestmark = pytest.mark.live
PEERS = 'support.peers'
OFFICE = '1.3,1.2,0.0'
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
        self.mode = graph.node.create_publisher(String, 'nav2_mode', qos.LATCHED)

    def start_nav2(self, **values):
        return self.graph.start('nav2', package=PEERS, use_sim_time=True, **values)

    def start_foreign_slam(self):
        """Simulation, SLAM and explorer: none of thinmap's localizer, mapper or graph."""
        self.graph.start('foreign_slam', package=PEERS, use_sim_time=True, laser_range_m=RANGE_M)
        self._start_sim('pose', 3)

    def start_our_slam(self):
        """The same with thinmap's localizer, mapper and graph."""
        names = ('localizer', 'grid_mapper', 'topology_builder')
        x, y, theta = self.start.split(',')
        at = {'initial_x_m': float(x), 'initial_y_m': float(y), 'initial_theta_rad': float(theta)}
        self.graph.start('thinmap', arguments=names, use_sim_time=True, **at)
        self._start_sim('local_topology', 3)

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
        """Have the stand-in behave differently from the next goal on."""
        self.mode.publish(String(data=mode))

    def ended(self, **goal):
        """Final status of an exploration that the action starts."""
        ended = self.graph.act(Explore, 'explore', Explore.Goal(**goal))
        return ended.status, ended.result.status

    def until_word(self, word):
        self.graph.until(lambda: any(m.data == word for m in self.words), word)

    def word_list(self):
        return [message.data for message in self.words]

    def coverage(self, T_world_map):
        """Share of what can be observed that the last map holds as free."""
        world = World.from_patch(*read_world(package_data.world_path(self.world)))
        start = np.array([float(part) for part in self.start.split(',')])
        cells = observable_cells(world, start, PRESETS['2dx'].radius_m, RANGE_M)
        return cells.coverage(messages.grid_from_msg(self.maps[-1]), T_world_map)


@pytest.fixture
def office(graph):
    return Exploration(graph, 'office', OFFICE)


def test_a_foreign_slam_and_nav2_are_enough(graph, office):
    office.start_foreign_slam()
    office.start_nav2()
    office.start_explorer()
    status, end = office.ended(return_home=True)
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert end.reason_code == ExplorationStatus.ALL_RESOLVED, end.reason
    start = np.array([float(part) for part in OFFICE.split(',')])
    print('coverage', office.coverage(start), end)
