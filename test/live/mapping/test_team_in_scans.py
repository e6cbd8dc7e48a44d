"""Another robot of the team is cut out of the scans that the mapper adds to the map."""

import math

import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from support.doctor import Doctor
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
        self._clock = graph.node.create_publisher(Clock, '/clock', qos.STREAM)
        self._doctor = Doctor(graph)
        self._ns = 0
        graph.start('grid_mapper', **parameters)
        graph.until(self._scans.get_subscription_count, 'the mapper')

    @property
    def now_s(self):
        """Time of the last scan."""
        return self._ns / 1e9

    def tells(self, x, y, is_joined=True):
        """The other robot tells its place until the mapper has it."""
        heard = self._doctor.number('grid_mapper', '/team/claims: received')

        def is_heard():
            if is_joined:
                self.talk.join()
            self.talk.stands_at(x, y)
            return self._doctor.number('grid_mapper', '/team/claims: received') > heard

        self.graph.until(is_heard, 'a place that is heard')

    def sees_robot_at(self, x, y, tells=False):
        """Scans that see the other robot, which tells its place or does not."""
        for _ in range(SCANS):
            if tells:
                self.talk.stands_at(x, y)
            self._ns += 200_000_000
            self._clock.publish(Clock(clock=messages.time_msg(self._ns)))
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
    room.sees_robot_at(4.0, 2.0)
    assert room.has_wall_at(4.0, 2.0)
    room.tells(3.5, 1.0)
    room.sees_robot_at(3.5, 1.0, tells=True)
    assert not room.has_wall_at(3.5, 1.0)


def test_a_robot_that_is_joined_later_is_no_wall_from_then_on(graph):
    room = Room(graph, team=True, team_name=ME)
    room.tells(3.5, 1.0, is_joined=False)
    room.sees_robot_at(3.5, 1.0, tells=True)
    assert room.has_wall_at(3.5, 1.0)

    def is_cut_out():
        room.talk.join()
        room.sees_robot_at(4.5, 3.0, tells=True)  # it has driven on
        return not room.has_wall_at(3.5, 1.0)

    graph.until(is_cut_out, 'a map without the robot')
    assert room.has_wall_at(5.9, 1.0)


def test_a_robot_that_is_silent_for_long_is_a_wall(graph):
    room = Room(graph, team=True, team_name=ME, claim_timeout_s=1.0, use_sim_time=True)
    room.tells(3.5, 3.0)
    room.sees_robot_at(3.5, 3.0, tells=True)
    # What it told last is of the same place.
    told_s = room.now_s

    def is_mapped():
        room.sees_robot_at(3.5, 3.0)
        return room.has_wall_at(3.5, 3.0)

    graph.until(is_mapped, 'a wall')
    assert room.now_s - told_s < SILENCE_S


def test_without_a_team_it_is_a_wall(graph):
    room = Room(graph)
    room.talk.join()
    room.sees_robot_at(3.5, 1.0, tells=True)
    assert room.has_wall_at(3.5, 1.0)
