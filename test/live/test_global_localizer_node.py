"""The global localizer as a process on a live graph."""

import itertools

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped, Twist
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import LaserScan

from thinmap_msgs.msg import LocalizationStatus, TopologicalMap
from thinmap_msgs.srv import LocalizeGlobally
from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.topology.graph import TopologicalMap as TopologicalGraph
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.files import occupancy_maps, package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
START = (2.0, 2.0, 0.0)


# Two identical rooms, which a rotation in place cannot distinguish, and the corridor at their
# doors, which continues to one side.
TWINS = """
name: twins
resolution: 0.02
wall_thickness: 0.10
start: [1.7, 2.0, -1.57]
walls:
  - [[0, 0], [3.5, 0], [3.5, 4], [2.2, 4]]
  - [[1.2, 4], [0, 4], [0, 0]]
  - [[4.5, 0], [8, 0], [8, 4], [6.7, 4]]
  - [[5.7, 4], [4.5, 4], [4.5, 0]]
  - [[3.5, 4], [4.5, 4]]
  - [[0, 4], [0, 6], [11, 6], [11, 4], [8, 4]]
solids:
  - [[2.7, 0], [3.5, 0], [3.5, 1.2], [2.7, 1.2]]
  - [[7.2, 0], [8, 0], [8, 1.2], [7.2, 1.2]]
"""


def map_of(world, folder):
    """A map of a world of the simulator, in cells of 10 cm."""
    _, patch, _ = read_world(package_data.world_path(str(world)))
    rows, cols = (size // 5 * 5 for size in patch.shape)
    cells = patch.cells[:rows, :cols].reshape(rows // 5, 5, cols // 5, 5).max(axis=(1, 3))
    occupancy_maps.write_map(
        folder / 'map', GridPatch(GridFrame(patch.frame.origin_x, patch.frame.origin_y, 0.1), cells)
    )
    return folder / 'map.yaml'


@pytest.fixture
def map_file(tmp_path):
    return map_of('room_10x10', tmp_path)


class Pace:
    """Lets a simulation in lockstep wait for the status of each scan while a search is under way.

    Otherwise the robot would drive on, unseen, while a busy machine searches.
    """

    def __init__(self, graph):
        self._is_searching = False
        self._paced = graph.node.create_publisher(LocalizationStatus, 'paced', qos.STREAM)
        graph.node.create_subscription(LaserScan, 'scan', self._on_scan, qos.STREAM)
        graph.node.create_subscription(
            LocalizationStatus, 'localization_status', self._on_status, qos.STREAM
        )

    def _on_scan(self, message):
        if not self._is_searching:
            self._paced.publish(LocalizationStatus(header=message.header))

    def _on_status(self, message):
        if message.state != LocalizationStatus.IDLE:
            self._paced.publish(message)
        ended = (LocalizationStatus.IDLE, LocalizationStatus.LOCALIZED)
        self._is_searching = message.state not in ended


def test_a_robot_that_drives_about_finds_itself_when_asked(graph, map_file):
    status = graph.heard('localization_status', LocalizationStatus, qos.LATCHED)
    poses = graph.heard('initialpose', PoseWithCovarianceStamped)
    samples = graph.heard('localization_samples', PoseArray, qos.LATCHED)
    truth = graph.heard('ground_truth', PoseStamped)
    graph.start('global_localizer', map_path=str(map_file), use_sim_time=True)
    commands = graph.node.create_publisher(Twist, 'cmd_vel', 10)
    Pace(graph)
    graph.start(
        'sim',
        remap=('localization_status:=paced',),
        start=','.join(map(str, START)),
        real_time_factor=3.0,
        lockstep='localization_status',
        wait_for_subscribers=2,
    )
    graph.until(lambda: status and truth, 'status and the robot')
    assert status[-1].state == LocalizationStatus.IDLE
    answer = graph.call(
        LocalizeGlobally, 'localize_globally', LocalizeGlobally.Request(discard_hypotheses=True)
    )
    assert answer.success, answer.message
    ahead = Twist()
    ahead.linear.x = 0.25
    ahead.angular.z = 0.35

    def found():
        commands.publish(ahead)
        return poses

    graph.until(found, 'a pose')
    graph.until(lambda: samples, 'samples')
    pose = poses[-1]
    ns = messages.stamp_ns(pose.header.stamp)
    graph.until(lambda: messages.stamp_ns(truth[-1].header.stamp) >= ns, 'where it was then')
    at = min(truth, key=lambda message: abs(messages.stamp_ns(message.header.stamp) - ns))
    off = se2.between(messages.pose_from_msg(at.pose), messages.pose_from_msg(pose.pose.pose))
    assert np.hypot(off[0], off[1]) < 0.3
    assert abs(off[2]) < np.radians(10.0)
    covariance = messages.covariance_from_msg(pose)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert len(samples[-1].poses) == 5000
    assert all(
        np.isfinite([p.position.x, p.position.y, p.orientation.z]).all()
        for p in samples[-1].poses[:100]
    )
    graph.until(
        lambda: status[-1].state == LocalizationStatus.IDLE, 'idle after the pose is published'
    )
    said = [message for message in status if message.state == LocalizationStatus.LOCALIZED]
    assert len(said) == len(poses) == 1
    assert said[0].weights[0] > 0.9
    assert graph.stop('global_localizer') == 0, graph.log('global_localizer')


def test_it_reports_missing_inputs_and_waits(graph):
    status = graph.heard('localization_status', LocalizationStatus, qos.LATCHED)
    graph.start('global_localizer', start_automatically=True, laser_pose='0.0,0.0,0.0')
    graph.until(lambda: status and status[-1].state == LocalizationStatus.WAITING, 'waiting')
    assert status[-1].reason == 'waits for map, topology, odom, scan'
    graph.until(lambda: 'waits for map' in graph.log('global_localizer'), 'a warning in words')
    assert graph.stop('global_localizer') == 0


def test_a_robot_that_may_drive_finds_itself_alone_and_stops(graph, tmp_path):
    (tmp_path / 'twins.yaml').write_text(TWINS)
    map_file = map_of(tmp_path / 'twins.yaml', tmp_path)
    poses = graph.heard('initialpose', PoseWithCovarianceStamped)
    truth = graph.heard('ground_truth', PoseStamped)
    commands = graph.heard('cmd_vel', Twist)
    graph.start(
        'global_localizer',
        map_path=str(map_file),
        start_automatically=True,
        drive=True,
        use_sim_time=True,
    )
    graph.start(
        'sim',
        world=str(tmp_path / 'twins.yaml'),
        real_time_factor=4.0,
        lockstep='localization_status',
    )
    graph.until(lambda: poses and truth and commands, 'a pose, the true one and commands')
    ns = messages.stamp_ns(poses[-1].header.stamp)
    graph.until(lambda: messages.stamp_ns(truth[-1].header.stamp) >= ns, 'where it was then')
    at = min(truth, key=lambda message: abs(messages.stamp_ns(message.header.stamp) - ns))
    off = se2.between(messages.pose_from_msg(at.pose), messages.pose_from_msg(poses[-1].pose.pose))
    assert np.hypot(off[0], off[1]) < 0.3
    assert abs(off[2]) < np.radians(10.0)
    assert any(command.linear.x > 0.1 for command in commands)
    graph.until(lambda: not commands[-1].linear.x and not commands[-1].angular.z, 'a stop')
    assert graph.stop('global_localizer') == 0, graph.log('global_localizer')


def scan_msg(ns, ranges):
    scan = Scan.create(ns, ranges, -np.pi / 2.0, np.pi / 180.0, 0.1, 20.0, np.zeros(3))
    return messages.scan_msg(scan, 'laser', 0.1)


def test_invalid_input_is_reported_and_gives_no_pose(graph, map_file):
    status = graph.heard('localization_status', LocalizationStatus, qos.LATCHED)
    poses = graph.heard('initialpose', PoseWithCovarianceStamped)
    samples = graph.heard('localization_samples', PoseArray, qos.LATCHED)
    say = {
        name: graph.node.create_publisher(kind, name, profile)
        for name, kind, profile in (
            ('map', OccupancyGrid, qos.LATCHED),
            ('topology', TopologicalMap, qos.LATCHED),
            ('odom', Odometry, qos.STREAM),
            ('scan', LaserScan, qos.SENSOR),
        )
    }
    graph.start('global_localizer', start_automatically=True, laser_pose='0.0,0.0,0.0')
    good = occupancy_maps.read_map(map_file)
    topology = build(good, None, TopologyConfig())
    seconds = itertools.count(1)

    def until_it_says(words, ranges, T=(0.0, 0.0, 0.0)):
        before = len(status)

        def said():
            ns = 10**8 * next(seconds)
            say['odom'].publish(
                messages.odometry_msg(np.array(T), (0.0, 0.0), ('odom', 'base_link'), ns)
            )
            say['scan'].publish(scan_msg(ns, ranges))
            return any(words in message.reason for message in status[before:])

        graph.until(said, words)

    wall = np.full(181, 3.0)
    nothing = np.full(181, np.nan)
    walls = GridPatch(good.frame, np.full(good.shape, 100, dtype=np.int8))
    open_field = GridPatch(good.frame, np.zeros(good.shape, dtype=np.int8))
    for patch, nodes, words in (
        (good, TopologicalGraph(), 'topology without nodes'),
        (walls, topology, 'no free place'),
        (open_field, topology, 'without an occupied one'),
    ):
        say['map'].publish(messages.grid_msg(patch, 'map', 0))
        say['topology'].publish(messages.topology_msg(nodes, 'map', 0))
        until_it_says(words, wall)
    say['map'].publish(messages.grid_msg(good, 'map', 0))
    until_it_says('laser blind', nothing)
    until_it_says('places explain', wall)
    until_it_says('has jumped', wall, (50.0, 0.0, 0.0))
    assert not poses
    heard = [
        [p.position.x, p.position.y, p.orientation.z, p.orientation.w]
        for s in samples
        for p in s.poses[:50]
    ]
    heard += [
        [p.position.x, p.position.y, p.orientation.z, p.orientation.w]
        for s in status
        for p in s.hypotheses
    ]
    assert np.isfinite(heard).all()
    assert graph.stop('global_localizer') == 0


def test_a_map_that_cannot_be_read_ends_the_start_in_words(graph, tmp_path):
    process = graph.start('global_localizer', map_path=str(tmp_path / 'nowhere.yaml'))
    assert graph.ended(process) == 2
    graph.processes.clear()
    assert 'nowhere.yaml' in graph.log('global_localizer')
