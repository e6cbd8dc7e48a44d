"""map_joiner on a live graph: maps of robots that other programs publish, joined or not."""

import numpy as np
import pytest
from nav_msgs.msg import OccupancyGrid
from support.driven_pieces import driven_piece, true_transform
from tf2_msgs.msg import TFMessage

from thinmap_msgs.msg import JoinStatus, Keyframe, KeyframePoses, RegionArray, TopologicalMap
from thinmap_msgs.srv import JoinMaps, SeparateMaps
from thinmap_ros.core import se2
from thinmap_ros.core.slam.joining.messages import KeyframeMessage, SentEdge
from thinmap_ros.core.topology.graph import topology_from_msg
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
QUICK = {'discovery_rate': 10.0, 'estimation_rate': 10.0, 'merging_rate': 5.0}
# As map_merge's own file has it, but for the names of the robots' poses.
MAP_MERGE = """
map_merge:
  ros__parameters:
    merging_rate: 4.0
    discovery_rate: 0.5
    estimation_rate: 0.5
    estimation_confidence: 0.6
    robot_map_topic: map
    robot_map_updates_topic: map_updates
    robot_namespace: ""
    merged_map_topic: map
    world_frame: world
    known_init_poses: true

    /robot1/map_merge/init_pose_x: 0.0
    /robot1/map_merge/init_pose_y: 0.0
    /robot1/map_merge/init_pose_z: 0.0
    /robot1/map_merge/init_pose_yaw: 0.0

    /robot2/map_merge/init_pose_x: {x:.3f}
    /robot2/map_merge/init_pose_y: {y:.3f}
    /robot2/map_merge/init_pose_z: 0.0
    /robot2/map_merge/init_pose_yaw: {yaw:.3f}
"""


class Robots:
    """Publishes the maps of robots, of drives through a building, and hears of the joint map."""

    def __init__(self, graph):
        self.graph = graph
        self.status = graph.heard('join_status', JoinStatus, qos.LATCHED)
        self.transforms = graph.heard('/tf_static', TFMessage, qos.STATIC_TRANSFORMS)
        self.topologies = graph.heard('merged_topology', TopologicalMap, qos.LATCHED)
        self.regions = graph.heard('merged_regions', RegionArray, qos.LATCHED)
        self.publishers = {}

    def publish(self, name, building, drive, drift=0.0):
        piece = driven_piece(building, drive, drift=drift).piece
        publisher = self.publisher(OccupancyGrid, f'{name}/map', qos.LATCHED)
        publisher.publish(messages.grid_msg(piece.patch, 'map', 1))

    def publish_keyframes(self, name, building, drive, drift=0.0):
        """All keyframes of a drive, and the edges along its path."""
        driven = driven_piece(building, drive, drift=drift)
        publisher = self.publisher(Keyframe, f'{name}/keyframes', qos.KEYFRAMES)
        for number, frame in enumerate(driven.piece.keyframes):
            edges = [SentEdge(e.a, e.b, e.information) for e in driven.edges if e.b == number]
            message = KeyframeMessage(number, 0, frame.T_map_base, frame.scan, tuple(edges))
            publisher.publish(Keyframe(session=7, layout=1, data=message.encode()))

    def publisher(self, kind, topic, profile):
        if topic not in self.publishers:
            self.publishers[topic] = self.graph.node.create_publisher(kind, topic, profile)
        return self.publishers[topic]

    def joined(self):
        return {each.name for each in self.status[-1].maps if each.is_joined} if self.status else {}

    def until_joined(self, *names):
        self.graph.until(lambda: self.joined() == set(names), f'{names} joined')

    def place(self, name):
        """Newest pose (3,) of the map of a robot in the world."""
        (found,) = [each for each in self.status[-1].maps if each.name == name]
        assert found.is_joined
        return messages.pose_from_msg(found.pose)

    def has_transform(self, name):
        """Whether tf has that pose for the frame of the map."""
        T = self.place(name)
        return any(
            each.header.frame_id == 'world'
            and np.allclose((each.transform.translation.x, each.transform.translation.y), T[:2])
            for message in self.transforms
            for each in message.transforms
            if each.child_frame_id == f'{name}/map'.lstrip('/')
        )


@pytest.fixture
def robots(graph):
    return Robots(graph)


def assert_true(T, metres=0.15):
    truth = true_transform(driven_piece(1, 1), driven_piece(1, 2))
    off = se2.between(truth, T)
    assert np.hypot(*off[:2]) < metres and abs(off[2]) < 0.02


def test_maps_of_one_building_are_joined_separated_and_joined_by_hand(graph, robots):
    maps = graph.heard('merged_map', OccupancyGrid, qos.LATCHED)
    robots.publish('/robot1', 1, 1)
    robots.publish('/robot2', 1, 2)
    robots.publish('/elsewhere', 3, 1)
    graph.start('map_joiner', **QUICK)
    robots.until_joined('/robot1', '/robot2')
    assert_true(robots.place('/robot2'))
    graph.until(lambda: robots.has_transform('/robot2'), 'the transform')
    assert robots.status[-1].header.frame_id == 'world'
    graph.until(lambda: maps and robots.topologies and robots.regions, 'the joint map')
    patch = messages.grid_from_msg(maps[-1])
    assert maps[-1].header.frame_id == 'world'
    own = driven_piece(1, 2).piece.patch
    points = own.frame.centres_of(np.argwhere(own.free))
    rows, cols = patch.frame.cells_of(se2.transform_points(robots.place('/robot2'), points)).T
    assert patch.free[rows, cols].mean() > 0.9
    assert len(topology_from_msg(robots.topologies[-1]).nodes) > 10
    assert robots.regions[-1].regions
    assert 'joined with /robot1' in graph.log('map_joiner')

    count = len(maps)
    done = graph.call(SeparateMaps, 'separate_maps', SeparateMaps.Request(name='/robot2'))
    assert done.success, done.message
    robots.until_joined()
    robots.publish('/robot1', 1, 1)  # a new map: it is not searched for
    refused = graph.call(SeparateMaps, 'separate_maps', SeparateMaps.Request(name='/nobody'))
    assert not refused.success and '/elsewhere, /robot1, /robot2' in refused.message
    assert robots.joined() == set()

    truth = true_transform(driven_piece(1, 1), driven_piece(1, 2))
    by_hand = messages.pose_msg(truth + (0.3, 0.3, 0.03))
    request = JoinMaps.Request(first='/robot1', second='/robot2', pose=by_hand)
    done = graph.call(JoinMaps, 'join_maps', request)
    assert done.success, done.message
    graph.until(lambda: robots.joined() and robots.status[-1].maps[-1].matches > 0, 'matches')
    assert_true(robots.place('/robot2'))
    graph.until(lambda: len(maps) > count, 'the joint map again')


def test_the_joint_map_bends_by_keyframes_that_were_sent_before(graph, robots):
    drift = 0.01
    maps = graph.heard('merged_map', OccupancyGrid, qos.LATCHED)
    for name, *drive in (('/robot1', 1, 1), ('/robot2', 1, 2, drift)):
        robots.publish(name, *drive)
        robots.publish_keyframes(name, *drive)
    # Bytes that are no message, and a correction of another session: both are left out.
    broken = robots.publisher(Keyframe, '/robot1/keyframes', qos.KEYFRAMES)
    broken.publish(Keyframe(session=7, layout=1, data=b'nothing'))
    poses = robots.publisher(KeyframePoses, '/robot1/keyframe_poses', qos.LATCHED)
    poses.publish(KeyframePoses(session=6, revision=1, poses=[1.0, 2.0, 3.0]))
    graph.start('map_joiner', **QUICK)
    robots.until_joined('/robot1', '/robot2')
    driven = driven_piece(1, 2, drift=drift)
    last = driven.piece.keyframes[-1].T_map_base
    straight = driven_piece(1, 2).piece
    truth = true_transform(driven_piece(1, 1), driven_piece(1, 2))
    T_true = se2.compose(truth, straight.keyframes[-1].T_map_base)

    def error_m():
        return float(np.hypot(*(se2.compose(robots.place('/robot2'), last) - T_true)[:2]))

    graph.until(lambda: error_m() < 0.1, f'the robot where it is, not {error_m():.2f} m beside')
    graph.until(lambda: robots.has_transform('/robot2'), 'the transform')
    graph.until(lambda: maps, 'the joint map')
    assert 'keyframe: ' in graph.log('map_joiner')


def test_a_parameter_file_of_map_merge_starts_it_unchanged(graph, robots, tmp_path):
    truth = true_transform(driven_piece(1, 1), driven_piece(1, 2))
    x, y, yaw = (truth + (-0.2, 0.3, 0.02)).tolist()
    file = tmp_path / 'params.yaml'
    file.write_text(MAP_MERGE.format(x=x, y=y, yaw=yaw))
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    robots.publish('/robot1', 1, 1)
    robots.publish('/robot2', 1, 2)
    graph.start(
        'map_joiner',
        remap=('__node:=map_merge',),
        arguments=('--ros-args', '--params-file', str(file), '--'),
    )
    robots.until_joined('/robot1', '/robot2')
    graph.until(lambda: robots.status[-1].maps[-1].matches > 0, 'matches')
    assert_true(se2.between(robots.place('/robot1'), robots.place('/robot2')))
    graph.until(lambda: maps, 'the joint map')
    log = graph.log('map_joiner')
    assert 'estimation_confidence is not used: join_odds' in log
    assert 'ignored parameters' not in log
