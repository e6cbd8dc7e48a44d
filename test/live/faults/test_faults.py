"""Faults on a live graph: killed nodes, silent topics, a clock set back, bursts, a full disk."""

import resource
import signal
import time

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.srv import GetMap
from rclpy.action import ActionClient
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from support.doctor import Doctor
from support.halls import AT_START, START, empty_hall
from support.slam_room import ROOM, scan_in

from thinmap_msgs.action import Explore
from thinmap_msgs.msg import ExplorationStatus, TopologicalMap
from thinmap_msgs.srv import SaveMap
from thinmap_ros.core.topology.graph import topology_from_msg
from thinmap_ros.files.safe import write_snapshot
from thinmap_ros.ros import messages, qos
from thinmap_ros.sim.robot import after_arc

pytestmark = pytest.mark.live
# While a node is dead, no scan has a result.
LOCKSTEP_S = 2.0
# Includes the start of the node.
RECOVER_S = 1000.0
TICK_NS = 100_000_000
MAPPING = ('localizer', 'grid_mapper', 'topology_builder')


def start_mapping(graph, rate=4.0, lockstep='local_topology'):
    for name in MAPPING:
        start_one(graph, name)
    graph.start(
        'sim',
        remap=graph.paced() if lockstep == 'local_topology' else (),
        start=START,
        wait_for_subscribers=1,
        real_time_factor=rate,
        lockstep=lockstep,
        lockstep_timeout_s=LOCKSTEP_S,
    )


def start_together(graph, *names, **simulation):
    """The same in one process, as it is run on a robot."""
    graph.start(
        'thinmap', arguments=names, use_sim_time=True, recovery_timeout_s=RECOVER_S, **AT_START
    )
    graph.start(
        'sim',
        remap=graph.paced(),
        start=START,
        wait_for_subscribers=len({*names} - {'grid_mapper', 'topology_builder'}),
        real_time_factor=4.0,
        lockstep='local_topology',
        lockstep_timeout_s=LOCKSTEP_S,
        **simulation,
    )


def start_one(graph, name):
    own = {
        'localizer': {**AT_START, 'recovery_timeout_s': RECOVER_S},
        # As in the papers: a graph of larger cells keeps more of its ids.
        'grid_mapper': {'recovery_timeout_s': RECOVER_S, 'resolution_m': 0.1},
        'topology_builder': {'recovery_timeout_s': RECOVER_S},
        'explorer': {'recovery_timeout_s': RECOVER_S},
    }
    graph.start(name, use_sim_time=True, **own.get(name, {}))


def kill(graph, name):
    process = graph.processes.pop(name)
    process.send_signal(signal.SIGKILL)
    process.wait()


class Robot:
    """True and estimated poses of the robot."""

    def __init__(self, graph):
        self.graph = graph
        self.truth = graph.heard('ground_truth', PoseStamped)
        self.poses = graph.heard('pose', PoseWithCovarianceStamped)
        self.commands = graph.node.create_publisher(Twist, 'cmd_vel', 10)

    def drive(self, metres, v=0.3, w=0.0):
        """Drive this straight-line distance."""
        self.graph.until(lambda: self.truth, 'true pose')
        start = self.truth[-1].pose.position
        command = messages.twist_msg(v, w)

        def far_enough():
            self.commands.publish(command)
            place = self.truth[-1].pose.position
            return np.hypot(place.x - start.x, place.y - start.y) > metres

        self.graph.until(far_enough, 'the robot makes its way')

    def spin(self):
        """Rotate in place until the next command."""
        self.commands.publish(messages.twist_msg(0.0, 1.0))

    def settle(self):
        """Stop, and wait for the pose."""
        self.commands.publish(messages.twist_msg(0.0, 0.0))
        said = len(self.poses) + 5
        self.graph.until(lambda: len(self.poses) > said, 'poses of a robot that stands')

    def error_m(self):
        """Error of the last pose, once the true pose of its stamp is received."""
        self.graph.until(self._errors_m, 'a pose, and the true one of its time')
        return self._errors_m()[-1]

    def _errors_m(self):
        truths = {messages.stamp_ns(m.header.stamp): m.pose.position for m in self.truth}
        stamped = [(messages.stamp_ns(m.header.stamp), m.pose.pose.position) for m in self.poses]
        pairs = [(truths[ns], believed) for ns, believed in stamped if ns in truths]
        return [float(np.hypot(place.x - p.x, place.y - p.y)) for place, p in pairs]


def kept(graph):
    """Wait until each node has written a checkpoint; a stationary robot adds nothing to the map."""
    since_ns = time.time_ns()
    state = graph.folder / 'state'

    def is_kept(name):
        (file,) = state.glob(f'[!.]*.{name}.npz')
        return file.stat().st_mtime_ns > since_ns

    graph.until(lambda: len(list(state.glob('[!.]*.npz'))) == len(MAPPING), 'a file of each')
    graph.until(lambda: all(is_kept(name) for name in MAPPING), 'all is kept')


def places(graph_message):
    return {n.id: (n.x, n.y) for n in topology_from_msg(graph_message).nodes.values()}


def test_mapping_continues_after_each_node_was_killed(graph):
    robot = Robot(graph)
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    graphs = graph.heard('topology', TopologicalMap, qos.LATCHED)
    start_mapping(graph)
    robot.drive(3.2)
    graph.until(lambda: maps and graphs and len(graphs[-1].node_ids) > 2, 'map and graph')
    for name in MAPPING:
        robot.settle()
        kept(graph)
        known = (np.array(maps[-1].data) >= 0).sum()
        before = places(graphs[-1])
        kill(graph, name)
        maps.clear(), robot.poses.clear(), graphs.clear()
        start_one(graph, name)
        graph.until(lambda n=name: 'restored the state' in graph.log(n), 'it remembers')
        # On a curve, so that it turns away from walls.
        robot.drive(0.15, v=0.15, w=0.6)
        graph.until(lambda: maps and len(robot.poses) > 5, 'mapping continues')
        assert (np.array(maps[-1].data) >= 0).sum() > 0.9 * known, name
        assert robot.error_m() < 0.15, name
        if name == 'topology_builder':
            graph.until(lambda: graphs, 'graph')
            after = places(graphs[-1])
            same = [
                k
                for k in before.keys() & after.keys()
                if np.hypot(*np.subtract(before[k], after[k])) < 0.5
            ]
            assert len(same) >= len(before) / 2
    for name in MAPPING:
        assert graph.stop(name) == 0
    assert not list((graph.folder / 'state').iterdir()), 'who ends in order leaves nothing'


def test_a_killed_localizer_resumes_in_the_map_and_does_not_bend_it(graph):
    """The robot drives on during the restart; without the map the error was up to 0.345 m."""
    robot = Robot(graph)
    start_mapping(graph, rate=2.0, lockstep='none')
    graph.until(lambda: robot.poses, 'it maps')
    robot.drive(2.0)
    # A full turn, so that walls to all sides are mapped.
    turned = len(robot.truth) + 130
    graph.until(lambda: robot.spin() or len(robot.truth) > turned, 'it looks round')
    robot.settle()
    assert robot.error_m() < 0.05
    kept(graph)
    kill(graph, 'localizer')
    robot.drive(0.5, w=0.4)
    # Its own map is enough: it waits for no other node.
    graph.processes['grid_mapper'].send_signal(signal.SIGSTOP)
    robot.poses.clear()
    start_one(graph, 'localizer')
    graph.until(lambda: 'restored the state' in graph.log('localizer'), 'it remembers')
    robot.drive(0.7, w=0.3)
    graph.until(lambda: len(robot.poses) > 5, 'it continues')
    graph.processes['grid_mapper'].send_signal(signal.SIGCONT)
    robot.drive(1.0, w=-0.3)
    robot.settle()
    assert robot.error_m() < 0.06


def test_a_killed_node_with_other_parameters_is_reset_and_reports_why(graph):
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    local = graph.heard('local_topology', TopologicalMap, qos.LATCHED)
    start_mapping(graph)
    graph.until(lambda: maps and local, 'map and graph')
    state = graph.folder / 'state'
    graph.until(lambda: len(list(state.glob('[!.]*.npz'))) == 3, 'all is kept')
    changed = {
        'grid_mapper': ({'resolution_m': 0.05}, 'expected 0.05 m (resolution_m)'),
    }
    for name, (values, said) in changed.items():
        kill(graph, name)
        maps.clear()
        graph.start(name, use_sim_time=True, recovery_timeout_s=RECOVER_S, **values)
        graph.until(lambda n=name: 'starting empty' in graph.log(n), 'it says so')
        assert said in graph.log(name), graph.log(name)
    kill(graph, 'localizer')
    (kept,) = state.glob('*.localizer.npz')
    wrong = {'stamp_ns': np.array(1), 'T_map_odom': np.zeros(4), 'T_odom_base': np.zeros(3)}
    wrong['map_id'] = np.array(1)
    with kept.open('wb') as stream:
        write_snapshot(stream, 'checkpoint', wrong)
    start_one(graph, 'localizer')
    graph.until(lambda: 'T_map_odom: (4,)' in graph.log('localizer'), 'it says so')
    assert 'checkpoint rejected' in graph.log('localizer')
    graph.until(lambda: maps and maps[-1].info.resolution < 0.06, 'a map with the new cells')
    for name in MAPPING:
        assert graph.stop(name) == 0


@pytest.mark.slow
def test_a_whole_robot_that_was_killed_and_reset_is_not_mixed_with_earlier_data(graph):
    robot = Robot(graph)
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    start_together(graph, *MAPPING)
    robot.drive(1.5)
    kept(graph)
    for name in ('thinmap', 'sim'):
        kill(graph, name)
    graph.drain()
    robot.poses.clear(), robot.truth.clear(), maps.clear()
    start_together(graph, *MAPPING)
    graph.until(lambda: len(robot.poses) > 10 and maps, 'a new map')
    assert graph.log('thinmap').count('restored the state') == 3
    assert 'odometry was reset' in graph.log('thinmap')
    assert robot.error_m() < 0.1
    # The robot is at its start: the map is what it observes from there, and nothing of the drive is
    # left.
    place = robot.truth[-1].pose.position
    assert np.hypot(place.x - 2.0, place.y - 2.0) < 0.05
    patch = messages.grid_from_msg(graph.call(GetMap, 'dynamic_map', GetMap.Request()).map)
    behind = patch.frame.cells_of(np.array([[1.0, 1.0]]))[0]
    inside = np.all((behind >= 0) & (behind < patch.shape))
    assert not inside or patch.cells[tuple(behind)] == -1


def test_a_clock_set_back_resets_all_nodes(graph):
    robot = Robot(graph)
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    graphs = graph.heard('topology', TopologicalMap, qos.LATCHED)
    names = (*MAPPING, 'explorer', 'navigator')
    start_together(graph, *names)
    robot.drive(1.5)
    graph.until(lambda: maps and graphs and graphs[-1].node_ids, 'map and graph')
    assert graph.stop('sim') == 0
    graph.drain()
    robot.poses.clear(), robot.truth.clear(), maps.clear()
    graph.start(
        'sim',
        start=START,
        wait_for_subscribers=3,
        real_time_factor=4.0,
        lockstep='local_topology',
        seed=3,
    )
    notices = [f'[{name}]: clock jumped back' for name in names]
    graph.until(
        lambda: all(notice in graph.log('thinmap') for notice in notices), 'all of them notice'
    )
    robot.poses.clear(), maps.clear()
    graph.until(lambda: len(robot.poses) > 10 and robot.truth, 'new poses')
    assert robot.error_m() < 0.1
    robot.spin()  # a map is published when it has changed
    graph.until(lambda: len(maps) > 3, 'new maps')
    # Each node reports the jump once.
    assert all(graph.log('thinmap').count(notice) == 1 for notice in notices)
    assert graph.stop('thinmap') == 0, graph.log('thinmap')


def test_what_waited_while_the_clock_was_set_back_does_not_begin_the_new_map(graph):
    poses = graph.heard('pose', PoseWithCovarianceStamped)
    doctor = Doctor(graph)
    graph.start('localizer', laser_pose='0,0,0', use_sim_time=True)
    clock = graph.node.create_publisher(Clock, '/clock', qos.STREAM)
    scan = graph.node.create_publisher(LaserScan, 'scan', qos.STREAM)
    odometry = graph.node.create_publisher(Odometry, 'odom', qos.STREAM)
    now = [100.0]

    def say(seconds, x):
        ns = int(1e9 * seconds)
        odometry.publish(
            messages.odometry_msg(np.array([x, 0.0, 0.0]), (0.0, 0.0), ('odom', 'base_link'), ns)
        )
        scan.publish(scan_of_nothing_near(ns))

    def go_on(x):
        now[0] += 0.1
        clock.publish(Clock(clock=messages.time_msg(int(1e9 * now[0]))))
        say(now[0], x)

    graph.until(lambda: go_on(4.0) or len(poses) > 5, 'poses')
    last = now[0]
    now[0] = 1.0
    set_back = Clock(clock=messages.time_msg(10**9))
    graph.until(
        lambda: clock.publish(set_back) or 'clock jumped back' in graph.log('localizer'),
        'it notices',
    )
    said = 0

    def left_over():
        nonlocal said
        said += 1
        say(last + 0.1 * said, 4.0)
        cause = 'dropped: scan: from before the clock jumped back'
        return doctor.number('localizer', cause) > 0

    graph.until(left_over, 'it is counted')
    graph.drain()
    poses.clear()
    graph.until(lambda: go_on(0.0) or len(poses) > 5, 'poses of the new time')
    newest_ns = max(messages.stamp_ns(pose.header.stamp) for pose in poses)
    assert newest_ns <= int(1e9 * now[0]) < 50 * 10**9
    assert all(
        np.hypot(pose.pose.pose.position.x, pose.pose.pose.position.y) < 0.05 for pose in poses
    )


def scan_of_nothing_near(ns):
    message = LaserScan(angle_min=-1.5, angle_increment=0.05, range_min=0.05, range_max=8.0)
    message.header = messages.header('laser', ns)
    # No laser measures the same twice.
    message.ranges = 61 * [5.0 + 0.01 * (ns // TICK_NS % 2)]
    return message


def test_a_silent_laser_stops_the_robot_until_scans_return(graph):
    commands = graph.heard('cmd_vel', Twist)
    doctor = Doctor(graph)
    graph.start('navigator', laser_pose='0,0,0', use_sim_time=True)
    scan = graph.node.create_publisher(LaserScan, 'scan', qos.STREAM)
    odometry = graph.node.create_publisher(Odometry, 'odom', qos.STREAM)
    pose = graph.node.create_publisher(PoseWithCovarianceStamped, 'pose', qos.STREAM)
    free = graph.node.create_publisher(OccupancyGrid, 'map', qos.LATCHED)
    clock = graph.node.create_publisher(Clock, '/clock', qos.STREAM)
    silent = set()
    now_ns = [10**12]
    here = [np.zeros(3)]
    answered = [-1]
    said_at = [0.0]

    def speak():
        """A robot in an empty hall, the next 0.1 s after each command.

        Until the first command, time advances by itself.
        """
        waits = len(commands) == answered[0] if commands else time.monotonic() - said_at[0] < 0.1
        if waits:
            return
        answered[0] = len(commands)
        said_at[0] = time.monotonic()
        now_ns[0] += TICK_NS
        ns = now_ns[0]
        if commands:
            here[0] = after_arc(here[0], 0.1 * commands[-1].linear.x, 0.1 * commands[-1].angular.z)
        clock.publish(Clock(clock=messages.time_msg(ns)))
        if 'odometry' not in silent:
            frames = ('odom', 'base_link')
            odometry.publish(messages.odometry_msg(here[0], (0.0, 0.0), frames, ns))
        if 'laser' not in silent:
            scan.publish(scan_of_nothing_near(ns))
        if 'localizer' not in silent:
            pose.publish(messages.pose_with_covariance_msg(here[0], np.eye(3), 'map', ns))

    free.publish(empty_hall())
    client = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')
    goal = NavigateToPose.Goal()
    goal.pose.pose.position.x = 4.0
    goal.pose.pose.orientation.w = 1.0
    graph.send_goal(client, goal)

    def drives():
        speak()
        return commands and commands[-1].linear.x > 0.02

    def stands():
        speak()
        return commands and commands[-1].linear.x == commands[-1].angular.z == 0.0

    for who, limit_s in (('laser', 0.5), ('odometry', 0.5), ('localizer', 3.5)):
        silent.clear()
        graph.until(drives, f'it drives before the {who} falls silent')
        silent.add(who)
        since_ns = now_ns[0]
        graph.until(stands, f'it stops without {who}')
        assert now_ns[0] - since_ns < (limit_s + 0.3) * 1e9
        # The clock is stopped meanwhile.
        graph.until(lambda w=who: f'{w} silent' in doctor.status('navigator').message, 'it says so')
    silent.clear()
    graph.until(drives, 'it drives on')


def test_a_robot_that_stands_for_minutes_is_as_sure_of_its_pose_as_before(graph):
    """The standard deviation once grew to 0.10 m and 0.06 rad in 600 s."""
    poses = graph.heard('pose', PoseWithCovarianceStamped)
    graph.start('localizer', laser_pose='0,0,0', initial_x_m=2.0, initial_y_m=2.0)
    scan = graph.node.create_publisher(LaserScan, 'scan', qos.STREAM)
    odometry = graph.node.create_publisher(Odometry, 'odom', qos.STREAM)
    rng = np.random.default_rng(5)
    stamp = [0]
    here = np.array([2.0, 2.0, 0.0])

    def say(T_map_base):
        stamp[0] += 200_000_000
        T_odom_base = T_map_base - here
        odometry.publish(
            messages.odometry_msg(T_odom_base, (0.0, 0.0), ('odom', 'base_link'), stamp[0])
        )
        seen = scan_in(ROOM, T_map_base, rng, stamp[0])
        scan.publish(messages.scan_msg(seen, 'laser', 0.2))

    def answered(T_map_base, count):
        """Publish scans until there is a pose `count` periods later; returns its sigmas."""
        wanted = stamp[0] + count * 200_000_000

        def is_answered():
            say(T_map_base)
            return poses and messages.stamp_ns(poses[-1].header.stamp) >= wanted

        graph.until(is_answered, f'{count} poses')
        return np.sqrt(np.diag(messages.covariance_from_msg(poses[-1])))

    answered(here, 5)
    for k in range(20):
        answered(here + (0.05 * k, 0.0, 0.0), 1)
    there = here + (1.0, 0.0, 0.0)
    before = answered(there, 10)
    began = poses[-1].pose.pose.position
    after = answered(there, 500)
    assert np.abs(after - before).max() < 1e-6
    place = poses[-1].pose.pose.position
    assert np.hypot(place.x - began.x, place.y - began.y) < 0.02, 'it does not wander'
    # The number of received scans, and so the accuracy, depends on the machine.
    assert np.hypot(place.x - there[0], place.y - there[1]) < 0.04
    assert (answered(there + (0.5, 0.0, 0.0), 1) > after).any(), 'driving adds'


def test_a_burst_of_scans_leaves_no_queue_and_what_is_lost_is_counted(graph):
    poses = graph.heard('pose', PoseWithCovarianceStamped)
    doctor = Doctor(graph)
    graph.start('localizer', laser_pose='0,0,0')
    scan = graph.node.create_publisher(LaserScan, 'scan', qos.STREAM)
    odometry = graph.node.create_publisher(Odometry, 'odom', qos.STREAM)
    graph.until(
        lambda: scan.get_subscription_count() and odometry.get_subscription_count(), 'localizer'
    )
    period_ns = 25_000_000
    now = [10**12]
    message = LaserScan(angle_min=-1.5, angle_increment=0.05, range_min=0.05, range_max=8.0)
    message.ranges = 61 * [3.0]

    def say():
        now[0] += period_ns
        odometry.publish(
            messages.odometry_msg(np.zeros(3), (0.0, 0.0), ('odom', 'base_link'), now[0])
        )
        message.header = messages.header('laser', now[0])
        scan.publish(message)

    def steadily():
        say()
        time.sleep(0.02)
        return len(poses) > 40

    def all_told():
        """Received and lost scans in the localizer's diagnostics, once the last one is counted."""
        graph.until(lambda: messages.stamp_ns(poses[-1].header.stamp) == now[0], 'the last pose')
        so_far = doctor.times('localizer')
        graph.until(lambda: doctor.times('localizer') >= so_far + 2, 'diagnostics')
        keys = ('scan: received', 'dropped: scan: lost in transport or in a full queue')
        return [doctor.number('localizer', key) for key in keys]

    graph.until(steadily, 'poses at 40 Hz')
    before = all_told()
    first_ns = now[0]
    for _ in range(400):
        say()
    last_ns = now[0]

    def newest():
        steadily()
        return messages.stamp_ns(poses[-1].header.stamp) >= last_ns

    graph.until(newest, 'the newest scan')
    after = all_told()
    assert after[1] > before[1], 'the queue is short'
    assert sum(after) - sum(before) == (now[0] - first_ns) / period_ns, 'each is accounted for'
    assert doctor.number('localizer', 'dropped: scan: gaps between the stamps') == 0.0, (
        'each was sent'
    )


def test_a_full_disk_leaves_the_old_session_as_it_was(graph, tmp_path):
    robot = Robot(graph)
    start_mapping(graph)
    robot.drive(0.3)
    stem = tmp_path / 'maps' / 'room'

    def save():
        return graph.call(SaveMap, 'save_map', SaveMap.Request(path=str(stem)))

    parts = ('.topology.npz', '.slam.npz')
    graph.until(
        lambda: all(part in save().message for part in parts), 'a session with all its parts'
    )
    before = {file.name: file.read_bytes() for file in stem.parent.iterdir()}
    assert sorted(before) == [
        'room.grid.npz',
        'room.keyframes.npz',
        'room.pgm',
        'room.regions.npz',
        'room.slam.npz',
        'room.topology.npz',
        'room.yaml',
    ]
    robot.drive(0.5)
    for name in ('grid_mapper', 'topology_builder'):
        pid = graph.processes[name].pid
        for size in (0, 300):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
            response = save()
            told = (name, size, response.message)
            assert not response.success and 'room' in response.message, told
            if name == 'grid_mapper':
                assert {file.name: file.read_bytes() for file in stem.parent.iterdir()} == before
        resource.prlimit(
            pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
        )
    assert (stem.parent / 'room.topology.npz').read_bytes() == before['room.topology.npz']
    response = save()
    assert response.success, response.message
    assert sorted(file.name for file in stem.parent.iterdir()) == sorted(before)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_an_exploration_finishes_though_every_node_is_killed_once(graph):
    robot = Robot(graph)
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    status = graph.heard('exploration_status', ExplorationStatus, qos.LATCHED)
    names = [*MAPPING, 'navigator', 'explorer']
    for name in names[3:]:
        start_one(graph, name)
    start_mapping(graph, rate=5.0)
    client = ActionClient(graph.node, Explore, 'explore')

    goal = graph.send_goal(client, Explore.Goal())
    ended = goal.get_result_async()
    for name in names:
        metres = status[-1].distance_m + 1.0 if status else 1.0
        graph.until(
            lambda m=metres: status and status[-1].distance_m > m,
            f'a metre before {name} is killed',
        )
        assert not ended.done()
        kill(graph, name)
        time.sleep(1.0)
        start_one(graph, name)
        if name == 'explorer':
            graph.until(lambda: 'restored the state' in graph.log('explorer'), 'it remembers')
            graph.until(client.server_is_ready, 'a new explorer')
    # The explorer that has accepted it was killed.
    ended = goal.get_result_async()
    graph.until(ended.done, 'the exploration ends', 600.0)
    result = ended.result().result.status
    good = (ExplorationStatus.ALL_RESOLVED, ExplorationStatus.UNREACHABLE)
    assert result.reason_code in good, result.reason
    assert robot.error_m() < 0.3
    patch = messages.grid_from_msg(maps[-1])
    assert patch.free.sum() * patch.frame.resolution**2 > 80.0, 'nearly all of a room of 10 x 10 m'
    assert max(patch.shape) * patch.frame.resolution < 11.5, 'and nothing double'
