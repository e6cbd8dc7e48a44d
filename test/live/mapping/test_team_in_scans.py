"""Another robot of the team is cut out of the scans that the mapper adds to the map."""

import math

import numpy as np
import pytest
from support.localized import localized
from support.team_talk import ME, TeamTalk

from thinmap_msgs.msg import LocalGrid, LocalizedScan
from thinmap_ros.core import se2
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.scan import Scan
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
AT = se2.pose(2.0, 2.0, 0.0)
ANGLES = np.radians(np.arange(-90.0, 91.0))
CELL_M = 0.05
RADIUS_M = 0.25
SILENCE_S = 14.0  # less than the default: the parameter counts
SCANS = 10  # at each place: as many make a wall where they are not cut


class Room:
    """A robot that stands in a room of 6 x 4 m, where another one is here and there."""

    def __init__(self, graph, **parameters):
        self.graph = graph
        self.talk = TeamTalk(graph)
        self.windows = graph.heard('local_grid', LocalGrid, qos.STREAM)
        self._scans = graph.node.create_publisher(LocalizedScan, 'localized_scan', qos.STREAM)
        self._ns = 0
        graph.start('grid_mapper', **parameters)
        graph.until(self._scans.get_subscription_count, 'the mapper')

    def sees_robot_at(self, x, y, tells):
        """Scans that see the other robot, which tells its place or does not."""
        for _ in range(SCANS):
            if tells:
                self.talk.stands_at(x, y)
                for _ in range(5):
                    self.graph.executor.spin_once(timeout_sec=0.01)
            self._ns += 200_000_000
            self._scans.publish(localized(self._look(x, y), AT))
            self.graph.until(self._is_mapped, 'the window of this scan')

    def has_wall_at(self, x, y):
        patch = messages.grid_from_msg(self.windows[-1].grid)
        walls = patch.frame.centres_of(np.argwhere(patch.occupied))
        return bool((np.hypot(*(walls - (x, y)).T) < RADIUS_M + 0.1).any())

    def _is_mapped(self):
        stamps = [messages.stamp_ns(window.header.stamp) for window in self.windows]
        return stamps and stamps[-1] == self._ns

    def _look(self, x, y):
        opaque = np.zeros((80, 120), dtype=np.uint8)
        opaque[[0, -1]] = 1
        opaque[:, [0, -1]] = 1
        rows, cols = np.indices(opaque.shape)
        opaque |= np.hypot(CELL_M * cols - x, CELL_M * rows - y) < RADIUS_M
        ranges = CELL_M * cast_rays(opaque, AT[0] / CELL_M, AT[1] / CELL_M, ANGLES, 160.0)
        return Scan.create(self._ns, ranges, -0.5 * math.pi, math.pi / 180.0, 0.05, 8.0)


def test_a_robot_that_tells_its_place_is_no_wall(graph):
    room = Room(graph, team=True, team_name=ME)
    room.talk.join()
    room.sees_robot_at(4.0, 2.0, tells=False)
    assert room.has_wall_at(4.0, 2.0)
    # What it told may arrive after the first scan: another place then.
    places = iter((3.5, y) for y in (1.0, 3.0, 0.8, 3.2, 1.2, 2.8))

    def is_cut():
        place = next(places)
        room.sees_robot_at(*place, tells=True)
        return not room.has_wall_at(*place)

    graph.until(is_cut, 'a robot that is no wall')


def test_a_robot_that_is_silent_for_long_is_a_wall(graph):
    room = Room(graph, team=True, team_name=ME, claim_timeout_s=1.0)
    room.talk.join()
    room.sees_robot_at(3.5, 3.0, tells=True)
    # What it told last is of the same place.

    def is_mapped():
        room.sees_robot_at(3.5, 3.0, tells=False)
        return room.has_wall_at(3.5, 3.0)

    graph.until(is_mapped, 'a wall', seconds=SILENCE_S)


def test_without_a_team_it_is_a_wall(graph):
    room = Room(graph)
    room.talk.join()
    room.sees_robot_at(3.5, 1.0, tells=True)
    assert room.has_wall_at(3.5, 1.0)
