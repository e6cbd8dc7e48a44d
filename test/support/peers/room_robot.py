"""Messages of a robot that stands in a room with another SLAM: map, transforms, scans, clock."""

import math
import signal
from itertools import count

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import pose
from thinmap_ros.ros import messages, qos

AT = pose(2.0, 2.0, 0.0)
ANGLES = np.radians(np.arange(-90.0, 91.0))
PERIOD_NS = 200_000_000
# Ten times real time; the nodes use the simulated time.
SPEAK_S = 0.02
MAP_EVERY = 5
CELL_M = 0.1


def room(known_cols):
    """A closed room of 6 x 4 m, known up to a column."""
    cells = np.zeros((40, 60), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    cells[:, known_cols:] = UNKNOWN
    return GridPatch(GridFrame(0.0, 0.0, CELL_M), cells)


class RoomRobot:
    """Publishes them faster than the clock of the machine, ten times unless speak_s is given.

    topic: of the map; base: frame of the robot; scans, maps: whether these are published; at: pose
    (3,); patch: the map; time_ns: of the clock; timer: which publishes: without it, time stands.
    """

    def __init__(self, graph, topic='map', base='base_link', scans=True, speak_s=SPEAK_S):
        self.node = graph.node
        self.base = base
        self.scans = scans
        self.maps = True
        self.at = AT
        self.time_ns = 0
        self.patch = room(40)
        self._numbers = count(1)
        self.map = self.node.create_publisher(OccupancyGrid, topic, qos.LATCHED)
        self._tf = self.node.create_publisher(TFMessage, '/tf', qos.TRANSFORMS)
        self._scan = self.node.create_publisher(LaserScan, 'scan', qos.STREAM)
        self._clock = self.node.create_publisher(Clock, '/clock', qos.STREAM)
        self.targets = graph.heard('exploration_target', PoseStamped, qos.LATCHED)
        self.timer = self.node.create_timer(speak_s, self._speak)

    def _speak(self):
        number = next(self._numbers)
        ns = number * PERIOD_NS
        self.time_ns = ns
        self._clock.publish(Clock(clock=messages.time_msg(ns)))
        transform = messages.transform_msg(self.at, 'map', self.base, ns)
        self._tf.publish(TFMessage(transforms=[transform]))
        if self.scans:
            self._scan.publish(messages.scan_msg(self._look(ns), 'laser', 0.2))
        if self.maps and number % MAP_EVERY == 0:
            self.map.publish(messages.grid_msg(self.patch, 'map', ns))

    def _look(self, ns):
        opaque = room(60).occupied.astype(np.uint8)
        x, y = self.at[:2] / CELL_M
        ranges = CELL_M * cast_rays(opaque, x, y, ANGLES + self.at[2], 8.0 / CELL_M)
        return Scan.create(ns, ranges, -0.5 * math.pi, math.pi / 180.0, 0.05, 8.0)


def replace_nav2(graph, robot, start):
    """Kill the Nav2 of a robot, and start another one.

    Time stands until that is discovered: to those who wait for an answer, the start of a process
    would be minutes.
    """

    def servers():
        topic = '/navigate_to_pose/_action/status'
        infos = graph.node.get_publishers_info_by_topic(topic)
        return {bytes(info.endpoint_gid) for info in infos}

    before = servers()
    robot.timer.cancel()
    graph.stop('nav2', signal.SIGKILL)
    graph.drain()
    start()
    graph.until(lambda: servers() - before, 'another Nav2')
    robot.timer.reset()
