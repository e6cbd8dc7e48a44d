"""One path: a log through `replay`, as a bag, and that bag played into live nodes give the same.

Equal means: poses to 1e-9 m and rad (a live pose travels as a quaternion), and maps equal cell by
cell.
"""

from dataclasses import replace as replace_fields

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path
from std_srvs.srv import SetBool
from support.doctor import Doctor
from support.slam_room import drive_round_the_block
from support.timeouts import PATIENCE_S

from thinmap_msgs.msg import Keyframe, KeyframePoses, SlamStatus, TopologicalMap
from thinmap_msgs.srv import SaveMap
from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid
from thinmap_ros.core.slam.joining.messages import KeyframeMessage, checked_poses
from thinmap_ros.core.slam.joining.pieces import ReceivedKeyframes
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.files import occupancy_maps, package_data, sessions
from thinmap_ros.files.worlds import read_world
from thinmap_ros.logs.log import LaserOptions, OdometryEvent, ScanEvent, SkippedRecords
from thinmap_ros.logs.readers.bag import BagLog
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.pipeline import PipelineConfig
from thinmap_ros.replaying import replay
from thinmap_ros.ros import messages, qos
from thinmap_ros.sim.laser import LaserScannerConfig
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.simulation import Simulation
from thinmap_ros.sim.world import World
from thinmap_ros.tools.carmen_to_bag import convert

pytestmark = pytest.mark.live
# Cells of 10 cm, which take a quarter of the time.
COARSE = PipelineConfig(grid=PAPER_GRID)
MAPPERS = ('localizer', 'grid_mapper', 'topology_builder')
# The test subscribes to the poses, too, and to the local graph, which it passes on to the player.
CONNECTIONS = {
    'bag_player': {'scan: subscribers': 1, 'odom: subscribers': 1, 'heard_too: publishers': 1},
    'localizer': {
        'scan: publishers': 1,
        'odom: publishers': 1,
        'topology: publishers': 1,
        'pose: subscribers': 1,
        'localized_scan: subscribers': 1,
    },
    'grid_mapper': {
        'localized_scan: publishers': 1,
        'trajectory: publishers': 1,
        'local_grid: subscribers': 1,
        'grid: subscribers': 2,
    },
    'topology_builder': {
        'local_grid: publishers': 1,
        'grid: publishers': 1,
        'topology: subscribers': 1,
        'local_topology: subscribers': 1,
    },
}


class SimulatedLog:
    """Scans and odometry of a robot that drives in circles through the room."""

    is_sorted = True

    def __init__(self):
        self.skipped = SkippedRecords()

    def events(self):
        world = World.from_patch(*read_world(package_data.world_path('room_10x10')))
        simulation = Simulation(world, world.start, PRESETS['2dx'], LaserScannerConfig(), 5)
        moment = simulation.read_sensors()
        for _ in range(400):
            yield OdometryEvent(moment.stamp_ns, moment.T_odom_base)
            for scan in moment.scans:
                yield ScanEvent(scan)
            moment = simulation.step(0.2, 0.25)


class CheapLaserLog(SimulatedLog):
    """The same drive with a laser that states the times of its beams, and drops half of them."""

    def events(self):
        rng = np.random.default_rng(1)
        for event in super().events():
            if isinstance(event, OdometryEvent):
                yield event
                continue
            scan = event.scan
            kept = np.repeat(rng.random(-(-scan.ranges_m.size // 6)) < 0.5, 6)[: scan.ranges_m.size]
            beam_s = np.float32(0.2 * scan.angle_increment_rad / (2.0 * np.pi))
            yield ScanEvent(
                replace_fields(
                    scan,
                    ranges_m=np.where(kept, scan.ranges_m, np.inf),
                    beam_period_s=float(beam_s),
                )
            )


class LoopLog:
    """Scans and odometry of a robot that returns to its start after its map has drifted."""

    is_sorted = True

    def __init__(self, first=0, end=None, every=1):
        """first, end: of the scans, all without them. every: of how many scans one is kept."""
        self.skipped = SkippedRecords()
        self.steps = list(drive_round_the_block())[first:end]
        self.every = every

    def events(self):
        for number, (scan, odom, _) in enumerate(self.steps):
            yield OdometryEvent(scan.stamp_ns, odom)
            if number % self.every == 0:
                yield ScanEvent(scan)

    def count(self):
        """Number of its scans."""
        return len(self.steps[:: self.every])


def assert_same(one, other):
    assert one.stamps_ns == other.stamps_ns
    assert np.abs(np.array(one.poses) - np.array(other.poses)).max() <= 1e-9
    patches = one.pipeline.grid.known_area(), other.pipeline.grid.known_area()
    assert np.array_equal(patches[0].cells, patches[1].cells)


def connections(doctor):
    """Number of discovered connections on the path from a scan to the player's acknowledgement.

    Nodes discover each other one by one, and messages to undiscovered ones are lost. A localizer
    that discovers the graph late works without it until then.
    """
    return {
        f'{node}: {topic}': doctor.number(node, topic)
        for node, topics in CONNECTIONS.items()
        for topic in topics
    }


class Poses:
    """Hears the poses, and passes the graph of each scan on to the player once it has its pose.

    The topic pose keeps one message alone: a player that did not wait for a busy test could make it
    miss some.
    """

    def __init__(self, graph):
        self.heard = graph.heard('pose', PoseWithCovarianceStamped)
        self._waiting = []
        node = graph.node
        self._passed_on = node.create_publisher(TopologicalMap, 'heard_too', qos.STREAM)
        node.create_subscription(TopologicalMap, 'local_topology', self._waiting.append, qos.STREAM)

    def are(self, count):
        """Whether there are so many; to be asked again and again while a bag is played."""
        last_ns = messages.stamp_ns(self.heard[-1].header.stamp) if self.heard else -1
        while self._waiting and messages.stamp_ns(self._waiting[0].header.stamp) <= last_ns:
            self._passed_on.publish(self._waiting.pop(0))
        return len(self.heard) == count


def play(graph, bag, count, poses, **own):
    """Play a bag of a number of scans into nodes until there are the poses of all.

    own: parameters by the name of the node.
    """
    doctor = Doctor(graph)
    resume = graph.client(SetBool, '/bag_player/pause')
    for name in MAPPERS:
        graph.start(name, use_sim_time=True, **own.get(name, {}))
    player = graph.start(
        'bag_player',
        remap=('local_topology:=heard_too',),
        bag=str(bag),
        rate=1000.0,
        start_paused=True,
        lockstep='local_topology',
        lockstep_timeout_s=PATIENCE_S,
        wait_for_subscribers=1,
    )
    wanted = {f'{n}: {t}': c for n, topics in CONNECTIONS.items() for t, c in topics.items()}
    graph.until(lambda: connections(doctor) == wanted, f'connections {wanted}')
    assert graph.call(SetBool, resume.srv_name, SetBool.Request(data=False)).success
    graph.until(lambda: poses.are(count) and player.poll() == 0, 'a pose for each scan')
    assert 'continuing without it' not in graph.log('bag_player')


def assert_live_is_same(graph, bag, expected, tmp_path, **localizer):
    poses = Poses(graph)
    grid = {'resolution_m': expected.pipeline.grid.frame.resolution}
    play(graph, bag, len(expected.poses), poses, localizer=localizer, grid_mapper=grid)
    assert [messages.stamp_ns(pose.header.stamp) for pose in poses.heard] == expected.stamps_ns
    live = np.array([messages.pose_from_msg(pose.pose.pose) for pose in poses.heard])
    assert np.abs(live - expected.poses).max() <= 1e-9
    response = graph.call(SaveMap, 'save_map', SaveMap.Request(path=str(tmp_path / 'live')))
    assert response.success, response.message
    occupancy_maps.write_map(tmp_path / 'replayed', expected.pipeline.grid.known_area())
    assert (tmp_path / 'live.pgm').read_bytes() == (tmp_path / 'replayed.pgm').read_bytes()


def test_simulated_log_bag_and_live_graph_agree(graph, tmp_path):
    from_log = replay(SimulatedLog(), PipelineConfig())
    convert(SimulatedLog(), tmp_path / 'bag')
    from_bag = replay(BagLog(tmp_path / 'bag'), PipelineConfig())
    assert len(from_log.poses) == 100
    assert_same(from_log, from_bag)
    assert_live_is_same(graph, tmp_path / 'bag', from_log, tmp_path)


def test_the_filter_of_the_paper_gives_the_same_live_and_replayed(graph, tmp_path):
    config = replace_fields(COARSE, localizer=EkfConfig(slam='ekf_ti'))
    expected = replay(SimulatedLog(), config)
    assert len(expected.pipeline.localizer.features) > 3
    convert(SimulatedLog(), tmp_path / 'bag')
    assert_live_is_same(graph, tmp_path / 'bag', expected, tmp_path, slam='ekf_ti')


def test_a_laser_that_sweeps_and_drops_out_is_treated_alike(graph, tmp_path):
    expected = replay(CheapLaserLog(), COARSE)
    free = expected.pipeline.grid.known_area().free
    assert free.sum() < 1.05 * replay(SimulatedLog(), COARSE).pipeline.grid.known_area().free.sum()
    convert(CheapLaserLog(), tmp_path / 'bag')
    statuses = graph.heard('slam_status', SlamStatus)
    assert_live_is_same(graph, tmp_path / 'bag', expected, tmp_path)
    assert not statuses[0].no_return_is_unknown and statuses[-1].no_return_is_unknown
    assert 'taken as unknown, not as free' in graph.log('localizer')


def places(topology):
    """Kinds and places of nodes, and of both ends of edges; the live grid's origin is rounded."""
    nodes = {n.id: (n.kind, round(n.x, 6), round(n.y, 6)) for n in topology.nodes.values()}
    edges = [sorted((nodes[e.a], nodes[e.b])) for e in topology.edges.values()]
    return sorted(nodes.values()), sorted(edges)


@pytest.mark.cpu_budget(25.0, 'a lap that is long enough to drift')
def test_a_closed_loop_corrects_the_live_map_as_it_does_the_replayed_one(graph, tmp_path):
    start = {'initial_x_m': 3.0, 'initial_y_m': 1.2}
    config = replace_fields(COARSE, localizer=LocalizerConfig(**start))
    expected = replay(LoopLog(every=3), config)
    assert 'rebuild' in expected.pipeline.stage_seconds
    convert(LoopLog(every=3), tmp_path / 'bag')
    trajectories = graph.heard('trajectory', Path, qos.LATCHED)
    assert_live_is_same(graph, tmp_path / 'bag', expected, tmp_path, **start)
    assert len(trajectories) == expected.pipeline.corrections
    stamps, _ = messages.trajectory_from_msg(trajectories[-1])
    assert set(stamps.tolist()) <= set(expected.stamps_ns)
    live = sessions.TOPOLOGY.load(str(tmp_path / 'live')).map
    offline = expected.pipeline.topology.map
    # The map is that of the grid. Ids depend on the windows, which are other ones offline.
    assert places(live) == places(offline)
    assert_told(graph, expected.pipeline.localizer.saved_keyframes())


def assert_told(graph, saved):
    """A subscriber that comes late gets all keyframes, at their corrected poses, and edges."""
    keyframes = []
    poses = []
    node = graph.node
    node.create_subscription(Keyframe, 'keyframes', keyframes.append, qos.KEYFRAMES)
    node.create_subscription(KeyframePoses, 'keyframe_poses', poses.append, qos.LATCHED)
    graph.until(lambda: len(keyframes) >= len(saved.frames) and poses, 'keyframes and poses')
    received = ReceivedKeyframes()
    for message in keyframes:
        received.add(message.session, message.map_id, KeyframeMessage.decode(bytes(message.data)))
    (newest,) = poses
    assert newest.revision > 0
    received.correct(newest.session, newest.revision, checked_poses(np.array(newest.poses)))
    known = received.known()
    np.testing.assert_allclose(known.poses, [frame.T_map_base for frame in saved.frames], atol=1e-5)
    # Edges that came after the last keyframe are sent with the next one.
    told = {(edge.a, edge.b) for edge in known.edges}
    assert {(step.a, step.b) for step in saved.steps} <= told
    assert told & {(edge.a, edge.b) for edge in saved.edges}, 'those of the loop'
    assert max(len(message.data) for message in keyframes) < 1000


def numbers_of(frames, scans):
    """Number of the scan that each keyframe of a session was made of; -1: of none of them.

    A session numbers its scans anew, and leaves out keyframes that others show as well.
    """
    ranges = np.array([np.where(scan.hit, scan.ranges_m, 0.0) for scan in scans])
    numbers = []
    for frame in frames:
        own = np.where(frame.scan.hit, frame.scan.ranges_m, 0.0)
        off = np.abs(ranges - own).max(axis=1)
        numbers.append(int(off.argmin()) if off.min() < 0.002 else -1)
    return numbers


def errors(stem, scans, truths):
    """Distances (N,) of those keyframes of a session that are of some scans from their places."""
    frames = sessions.KEYFRAMES.load(stem).frames
    found = [
        (frame, k) for frame, k in zip(frames, numbers_of(frames, scans), strict=True) if k >= 0
    ]
    return np.array([np.hypot(*(frame.T_map_base[:2] - truths[k])) for frame, k in found])


@pytest.mark.cpu_budget(35.0, 'a lap that is long enough to drift, in two halves')
def test_a_loop_that_closes_in_a_loaded_session_corrects_it(graph, tmp_path):
    """The first half of a lap is saved, and the nodes are started again for the second."""
    halves = LoopLog(end=420, every=3), LoopLog(first=420)
    for name, half in zip(('one', 'two'), halves, strict=True):
        convert(half, tmp_path / name)
    stem = str(tmp_path / 'block')
    keyframes = graph.heard('trajectory', Path, qos.LATCHED)
    start = {'initial_x_m': 3.0, 'initial_y_m': 1.2}
    poses = Poses(graph)
    grid = {'resolution_m': COARSE.grid.resolution_m}
    play(graph, tmp_path / 'one', halves[0].count(), poses, localizer=start, grid_mapper=grid)

    def save():
        return graph.call(SaveMap, 'save_map', SaveMap.Request(path=stem))

    graph.until(lambda: 'block.slam.npz and .keyframes.npz' in save().message, 'all parts')
    x, y, yaw = messages.pose_from_msg(poses.heard[-1].pose.pose).tolist()
    for name in MAPPERS:
        assert graph.stop(name) == 0
    before = sessions.KEYFRAMES.load(stem).frames
    offline = LocalizerConfig(**start)
    replayed = replay(halves[0], replace_fields(COARSE, localizer=offline)).pipeline.localizer
    truth_at = {scan.stamp_ns: truth[:2] for scan, _, truth in halves[0].steps}
    truths = np.array([truth_at[frame.scan.stamp_ns] for frame in replayed.keyframes])
    assert len(truths) == len(before)
    scans = [frame.scan for frame in before]
    drifted = errors(stem, scans, truths)
    assert len(drifted) == len(before)
    keyframes.clear()
    poses.heard.clear()
    graph.processes.pop('bag_player')
    there = {'initial_x_m': x, 'initial_y_m': y, 'initial_yaw_rad': yaw}
    own = {name: {'session_path': stem} for name in MAPPERS}
    own['localizer'] |= there
    own['grid_mapper'] |= grid
    play(graph, tmp_path / 'two', halves[1].count(), poses, **own)
    for name in MAPPERS:
        assert 'not corrected' not in graph.log(name)
    assert save().success
    assert drifted.max() > 0.5 and errors(stem, scans, truths).max() < 0.95 * drifted.max()
    # The mapper has drawn the loaded scans again where the localizer has them now.
    stamps, corrected = messages.trajectory_from_msg(keyframes[-1])
    assert stamps[: len(before)].tolist() == list(range(1, len(before) + 1))
    saved = sessions.KEYFRAMES.load(stem).frames
    numbers = numbers_of(saved, scans)
    assert np.count_nonzero(np.array(numbers) >= 0) > 0.8 * len(before)
    for frame, number in zip(saved, numbers, strict=True):
        if number >= 0:
            np.testing.assert_allclose(corrected[number], frame.T_map_base, atol=1e-6)
    grid = sessions.load_grid(stem)
    again = OccupancyGrid(grid.config, grid.frame)
    for scan, T_map_base in sessions.load_scans(stem):
        again.add_scan(scan, T_map_base)
    walls = [each.known_area().occupied.sum() for each in (grid, again)]
    assert walls[0] < 1.25 * walls[1], 'each wall once'


@pytest.mark.slow
def test_real_log_bag_and_live_graph_agree(graph, shared_data, tmp_path):
    log = CarmenLog(shared_data / 'logs' / 'sena' / 'log.clf', LaserOptions(offset_m=0.78))
    from_log = replay(log, COARSE)
    convert(log, tmp_path / 'bag')
    from_bag = replay(BagLog(tmp_path / 'bag'), COARSE)
    assert_same(from_log, from_bag)
    assert_live_is_same(graph, tmp_path / 'bag', from_log, tmp_path)
