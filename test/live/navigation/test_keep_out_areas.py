"""Keep-out areas on a live graph: set, driven around, published for Nav2, saved and loaded."""

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav2_msgs.action import NavigateToPose
from nav2_msgs.msg import CostmapFilterInfo
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import KeepOut
from thinmap_msgs.srv import AddKeepOut, EraseArea, LoadMap, RemoveKeepOut, SaveMap
from thinmap_ros.core.exploration.strategy import FinishCode
from thinmap_ros.core.grid.edits import inside
from thinmap_ros.core.grid.patch import UNKNOWN
from thinmap_ros.logs import decode
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
AT_START = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.785}
# Between the start and the goal behind it.
AREA = [(1.5, 2.9), (2.5, 2.9), (2.5, 3.7), (1.5, 3.7)]
GOAL = (2.0, 4.6)
SEEN = [(2.7, 2.0), (3.3, 2.0), (3.3, 3.0), (2.7, 3.0)]


class Robot:
    """A simulated robot with its nodes, and what the test hears of it."""

    def __init__(self, graph):
        self.graph = graph
        self.truth = graph.heard('ground_truth', PoseStamped)
        self.maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
        self.areas = graph.heard('keep_out', KeepOut, qos.LATCHED)
        self.masks = graph.heard('keepout_filter_mask', OccupancyGrid, qos.LATCHED)
        self.infos = graph.heard('costmap_filter_info', CostmapFilterInfo, qos.LATCHED)
        self.client = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')
        graph.start('localizer', use_sim_time=True, **AT_START)
        for name in ('grid_mapper', 'topology_builder', 'explorer'):
            graph.start(name, use_sim_time=True)
        graph.start('navigator', use_sim_time=True, **{'controller.max_speed_m_s': 0.4})
        graph.start(
            'sim',
            remap=graph.paced(),
            start='2.0,2.0,0.785',
            real_time_factor=2.0,
            lockstep='local_topology',
            wait_for_subscribers=1,
        )
        graph.until(lambda: self.maps and self.areas, 'a map')

    def add(self, corners, is_wall=False):
        request = AddKeepOut.Request(corners=messages.polygon_msg(corners), is_wall=is_wall)
        return self.graph.call(AddKeepOut, 'add_keep_out', request)

    def send(self, x, y):
        goal = messages.pose_stamped_msg(np.array([x, y, 1.57]), 'map', 0)
        return self.graph.send_goal(self.client, NavigateToPose.Goal(pose=goal))

    def drive(self, x, y):
        return self.graph.result(self.send(x, y), 'a drive')

    def path(self):
        return np.array([[p.pose.position.x, p.pose.position.y] for p in self.truth])

    def ids(self):
        return [area.id for area in self.areas[-1].areas]


def value_at(message, x, y):
    patch = messages.grid_from_msg(message)
    row, col = patch.frame.cells_of(np.array([[x, y]]))[0]
    return patch.cells[row, col]


@pytest.mark.cpu_budget(15.0, 'four drives and an exploration')
def test_areas_are_driven_around_published_saved_and_loaded(graph):
    robot = Robot(graph)
    assert not robot.areas[-1].areas and robot.masks[-1].data.tolist() == [0]
    info = robot.infos[-1]
    assert (info.type, info.base, info.multiplier) == (0, 0.0, 1.0)
    assert info.filter_mask_topic == '/keepout_filter_mask'

    added = robot.add(AREA)
    assert added.success and added.id == 1, added.message
    graph.until(lambda: robot.ids() == [1] and len(robot.masks[-1].data) > 1, 'an area')
    assert decode.keep_out(robot.areas[-1]).areas[0].corners == pytest.approx(np.array(AREA))
    assert value_at(robot.masks[-1], 2.0, 3.3) == 100

    inner = robot.drive(2.0, 3.3)
    assert inner.status == GoalStatus.STATUS_ABORTED
    assert '2.00, 3.30 is in keep-out area 1' in inner.result.error_msg
    there = robot.drive(*GOAL)
    assert there.status == GoalStatus.STATUS_SUCCEEDED, there.result.error_msg
    path = robot.path()
    assert np.hypot(*(path[-1] - GOAL)) < 0.3
    assert not inside(path, np.array(AREA)).any()

    # An area on the goal of a robot that is on its way.
    way = robot.send(3.2, 1.0)
    robot.add([(2.9, 0.6), (3.45, 0.6), (3.45, 1.4), (2.9, 1.4)])
    ended = graph.result(way, 'a drive')
    assert ended.status == GoalStatus.STATUS_ABORTED and 'area 2' in ended.result.error_msg

    # Closed in by walls, there is nothing that an exploration can reach.
    x, y = robot.path()[-1]
    ring = [(x - 0.9, y - 0.9), (x + 0.9, y - 0.9), (x + 0.9, y + 0.9), (x - 0.9, y + 0.9)]
    assert robot.add([*ring, ring[0]], is_wall=True).success
    robot.truth.clear()
    explored = graph.act(Explore, 'explore', Explore.Goal())
    assert explored.result.status.reason_code == int(FinishCode.UNREACHABLE)
    assert inside(robot.path(), np.array(ring)).all()

    assert graph.call(SaveMap, 'save_map', SaveMap.Request(path='floor')).success
    assert (graph.folder / 'floor.edits.npz').exists()
    assert graph.call(RemoveKeepOut, 'remove_keep_out', RemoveKeepOut.Request(id=1)).success
    graph.until(lambda: robot.ids() == [2, 3], 'two areas left')
    assert value_at(robot.masks[-1], 2.95, 1.0) == 100
    unknown = graph.call(RemoveKeepOut, 'remove_keep_out', RemoveKeepOut.Request(id=1))
    assert not unknown.success and 'expected the id of one (2, 3)' in unknown.message
    assert not robot.add(AREA[:2]).success
    assert graph.call(LoadMap, 'load_map', LoadMap.Request(path='floor')).success
    graph.until(lambda: robot.ids() == [1, 2, 3], 'the areas of the session')

    # Cells that are known, and are unknown for a moment: the laser shows them again.
    graph.until(lambda: value_at(robot.maps[-1], 3.0, 2.5) == 0, 'a known cell')
    robot.maps.clear()
    erased = graph.call(
        EraseArea, 'erase_area', EraseArea.Request(corners=messages.polygon_msg(SEEN))
    )
    assert erased.success, erased.message
    graph.until(
        lambda: any(value_at(each, 3.0, 2.5) == UNKNOWN for each in robot.maps), 'an unknown cell'
    )
