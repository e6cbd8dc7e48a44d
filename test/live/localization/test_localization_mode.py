"""Localization in a given map on a live graph: AMCL's job."""

import math
from itertools import pairwise

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav2_msgs.msg import ParticleCloud
from nav2_msgs.srv import SetInitialPose
from nav_msgs.msg import OccupancyGrid, Odometry
from std_srvs.srv import Empty
from support.doctor import Doctor
from support.peers.foreign_map import write_foreign_map

from thinmap_msgs.msg import LocalizationStatus, SlamStatus
from thinmap_msgs.srv import LoadMap
from thinmap_ros.core import se2
from thinmap_ros.experiments.drives import world_of
from thinmap_ros.files.occupancy_maps import read_map
from thinmap_ros.ros import messages, qos
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig

pytestmark = pytest.mark.live
START = (2.0, 2.0, 0.0)
WORLD = 'room_10x10'
COVARIANCE = np.diag([0.04, 0.04, 0.01])


class Robot:
    """A robot that drives in circles, with what the localizer publishes."""

    def __init__(self, graph, start=START, real_time_factor=16.0):
        self.graph = graph
        self._travelled_m = 0.0
        self._measured = 0  # number of the last true pose up to which that is
        self.truth = graph.heard('ground_truth', PoseStamped)
        self.poses = graph.heard('pose', PoseWithCovarianceStamped)
        self.status = graph.heard('slam_status', SlamStatus)
        self.odometry = graph.heard('odom', Odometry)
        self.commands = graph.node.create_publisher(Twist, 'cmd_vel', 10)
        self.initial = graph.node.create_publisher(PoseWithCovarianceStamped, 'initialpose', 10)
        graph.start(
            'sim',
            # Paced: otherwise it would drive on with an old command while the test is busy.
            remap=graph.paced('pose', PoseWithCovarianceStamped),
            world=WORLD,
            start=','.join(map(str, start)),
            real_time_factor=real_time_factor,
            lockstep='pose',
        )

    def localize(self, **values):
        self.graph.start('localizer', use_sim_time=True, mode='localization', **values)
        self.graph.until(lambda: self.status and self.truth, 'a first status')

    def drive_until(self, condition, what):
        ahead = Twist()
        ahead.linear.x = 0.25
        ahead.angular.z = 0.2

        def met():
            self.commands.publish(ahead)
            return condition()

        self.graph.until(met, what)

    def travelled_m(self):
        for before, after in pairwise(self.truth[self._measured :]):
            a = before.pose.position
            b = after.pose.position
            self._travelled_m += math.hypot(b.x - a.x, b.y - a.y)
        self._measured = max(len(self.truth) - 1, 0)
        return self._travelled_m

    def is_tracking(self):
        return [s.state for s in self.status[-5:]] == [SlamStatus.TRACKING] * 5

    def is_lost(self, scans=1):
        return [s.state for s in self.status[-scans:]] == [SlamStatus.LOST] * scans

    def lost_share(self, is_counted):
        """Share of its path on which it is lost, where is_counted(T_map_base)."""
        truth = {messages.stamp_ns(m.header.stamp): m.pose for m in self.truth}
        heard = [(s, truth.get(messages.stamp_ns(s.header.stamp))) for s in self.status]
        lost = np.array([s.state == SlamStatus.LOST for s, at in heard if at is not None])
        poses = np.array([messages.pose_from_msg(at) for _, at in heard if at is not None])
        steps_m = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        steps_m[[not is_counted(T) for T in poses[1:]]] = 0.0
        return (lost[1:] * steps_m).sum() / steps_m.sum()

    def states(self):
        return {message.state for message in self.status}

    def pose(self):
        return messages.pose_from_msg(self.poses[-1].pose.pose)

    def true_pose(self):
        return messages.pose_from_msg(self.truth[-1].pose)

    def send_initial_pose(self, T, frame='map'):
        self.graph.until(self.initial.get_subscription_count, 'a subscriber of initialpose')
        self.initial.publish(pose_msg(T, frame))

    def odometry_error_m(self):
        """Distance of the pose by odometry alone from the true one, m."""
        T_odom_base = messages.pose_from_msg(self.odometry[-1].pose.pose)
        dead_reckoned = se2.compose(se2.pose(*START), T_odom_base)
        return np.hypot(*(dead_reckoned - self.true_pose())[:2])

    def errors_m(self):
        """Distance of each pose from the true one at its stamp, m."""
        truth = {messages.stamp_ns(m.header.stamp): m.pose.position for m in self.truth}
        pairs = [
            (m.pose.pose.position, truth[messages.stamp_ns(m.header.stamp)])
            for m in self.poses
            if messages.stamp_ns(m.header.stamp) in truth
        ]
        return np.array([math.hypot(a.x - b.x, a.y - b.y) for a, b in pairs])


def pose_msg(T, frame='map'):
    return messages.pose_with_covariance_msg(np.array(T), COVARIANCE, frame, 0)


def share_of_fitting_beams(other):
    """Function of a pose: share of beams that have the same range in another world."""
    laser = LaserScanner(LaserScannerConfig(range_noise_m=0.0), seed=0)
    worlds = [world_of(WORLD), world_of(other)]

    def share(T_map_base):
        ranges_m = [laser.scan(world, T_map_base, 0).ranges_m for world in worlds]
        return np.isclose(*ranges_m, rtol=0.0, atol=0.15).mean()

    return share


def load_map(graph, path):
    """By the service of grid_mapper, which also asks the localizer."""
    answer = graph.call(LoadMap, 'load_map', LoadMap.Request(path=path))
    assert answer.success, answer.message
    assert 'local map loaded' in answer.message


@pytest.fixture(autouse=True)
def state_home(tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_STATE_HOME', str(tmp_path / 'home'))


@pytest.mark.cpu_budget(15.0, 'two hundred poses of a drive')
def test_it_tracks_in_a_map_of_another_program_and_remembers_the_last_pose(graph, tmp_path):
    path = write_foreign_map(tmp_path, WORLD)
    robot = Robot(graph)
    amcl = graph.heard('amcl_pose', PoseWithCovarianceStamped, qos.LATCHED)
    start = {f'initial_pose.{key}': v for key, v in zip(('x', 'y', 'yaw'), START, strict=True)}
    robot.localize(map_file_name=str(path), set_initial_pose=True, **start)
    robot.drive_until(lambda: robot.travelled_m() > 12.0, 'a drive')
    clouds = graph.heard('particle_cloud', ParticleCloud, qos.SENSOR)
    robot.drive_until(lambda: clouds, 'a cloud')
    assert robot.states() == {SlamStatus.TRACKING}
    errors = robot.errors_m()
    assert len(errors) > 200
    rms_m = np.sqrt(np.mean(errors**2))
    print(f'{robot.travelled_m():.1f} m, odometry off by {robot.odometry_error_m():.2f} m')
    print(f'rms {rms_m:.4f} m in {len(errors)} poses')
    assert rms_m < 0.05
    assert amcl[-1].header.frame_id == 'map'
    weights = [particle.weight for particle in clouds[-1].particles]
    assert sum(weights) == pytest.approx(1.0)
    graph.call(Empty, 'request_nomotion_update', Empty.Request())

    robot.commands.publish(Twist())
    graph.until(lambda: robot.poses, 'poses')
    assert graph.stop('localizer') == 0
    robot.localize(map_file_name=str(path))
    graph.until(lambda: 'last pose' in graph.log('localizer'), 'it starts at the last pose')
    # What the first localizer has published is received by now.
    robot.status.clear()
    graph.until(robot.is_tracking, 'that it finds itself at the last pose')


@pytest.mark.cpu_budget(15.0, 'a search of the building with each scan')
def test_it_is_lost_in_the_wrong_building(graph, tmp_path):
    path = write_foreign_map(tmp_path, 'office')
    robot = Robot(graph)
    robot.localize(map_file_name=str(path))
    robot.send_initial_pose(START)
    robot.drive_until(lambda: robot.travelled_m() > 10.5, 'more than a round')
    # For three metres, a corner of this building looks like one of the other.
    fitting = share_of_fitting_beams('office')
    assert robot.lost_share(lambda T: fitting(T) < 0.5) > 0.8
    assert robot.lost_share(lambda T: fitting(T) == 0.0) == 1.0
    assert robot.is_lost()


def test_a_loaded_map_of_another_building_leads_to_lost(graph, tmp_path):
    right = write_foreign_map(tmp_path, WORLD)
    write_foreign_map(tmp_path, 'office', 'office')
    robot = Robot(graph)
    graph.start('grid_mapper', use_sim_time=True)
    robot.localize(map_file_name=str(right))
    robot.send_initial_pose(START)
    graph.until(robot.is_tracking, 'tracking')
    load_map(graph, 'office.yaml')
    robot.status.clear()
    end_m = robot.travelled_m() + 1.5
    # On a busy machine it may stand at first, where scans fit both buildings.
    robot.drive_until(lambda: len(robot.status) > 30 and robot.travelled_m() > end_m, '1.5 m')
    assert robot.is_lost(20)
    load_map(graph, 'drawn.yaml')
    robot.send_initial_pose(robot.true_pose())
    robot.drive_until(robot.is_tracking, 'tracking again')


def test_without_a_map_it_says_so_until_one_arrives_and_takes_poses_in_any_frame(graph, tmp_path):
    patch = read_map(write_foreign_map(tmp_path, WORLD))
    robot = Robot(graph)
    doctor = Doctor(graph)
    robot.localize()
    graph.until(lambda: len(robot.status) > 5, 'states')
    assert robot.states() == {SlamStatus.NO_MAP}
    maps = graph.node.create_publisher(OccupancyGrid, 'map', qos.LATCHED)
    maps.publish(messages.grid_msg(patch, 'map', 0))
    graph.until(robot.is_lost, 'lost in the map')
    answer = graph.call(
        SetInitialPose, 'set_initial_pose', SetInitialPose.Request(pose=pose_msg(START))
    )
    assert answer is not None
    graph.until(robot.is_tracking, 'tracking by the service')
    # The odometry starts at 0: the pose of the robot in the frame odom is known.
    robot.send_initial_pose((30.0, 30.0, 0.0))
    robot.status.clear()
    # For some scans, so that the localizer has the transform of the wrong pose, too.
    graph.until(lambda: robot.is_lost(5), 'lost at a wrong pose')
    T_map_odom = se2.pose(30.0, 30.0, 0.0)
    inside = se2.between(T_map_odom, np.array(START))
    robot.send_initial_pose(inside, 'odom')
    graph.until(robot.is_tracking, 'tracking by a pose in the frame odom')
    assert np.hypot(*(robot.pose() - robot.true_pose())[:2]) < 0.1
    robot.send_initial_pose(START, 'nowhere')
    graph.until(lambda: 'nowhere' in graph.log('localizer'), 'a warning')
    graph.call(
        SetInitialPose, 'set_initial_pose', SetInitialPose.Request(pose=pose_msg((1e5, 0.0, 0.0)))
    )
    graph.until(
        lambda: doctor.number('localizer', 'set_initial_pose: rejected') == 1, 'it is counted'
    )
    assert 'set_initial_pose: pose at 100000.0, 0.0 m' in graph.log('localizer')
    robot.status.clear()
    graph.until(lambda: len(robot.status) >= 5, 'scans after it')
    assert robot.is_tracking()


def test_the_global_localizer_finds_a_robot_by_the_service_of_amcl(graph, tmp_path):
    path = write_foreign_map(tmp_path, WORLD)
    # The simulation waits for the localizer alone: the search has to keep up with it, before the
    # lost localizer finds a similar corner, after 25 s of driving.
    robot = Robot(graph, (5.5, 2.0, 1.0), real_time_factor=2.0)
    status = graph.heard('localization_status', LocalizationStatus, qos.LATCHED)
    graph.start('global_localizer', use_sim_time=True, map_path=str(path))
    robot.localize(map_file_name=str(path), set_initial_pose=True)
    graph.until(lambda: status, 'the global localizer')
    assert robot.is_lost()
    graph.call(Empty, 'reinitialize_global_localization', Empty.Request())
    graph.until(lambda: status[-1].state != LocalizationStatus.WAITING, 'a search')
    robot.drive_until(robot.is_tracking, 'that it is found')
    assert robot.errors_m()[-1] < 0.1


def test_contradicting_parameters_end_the_start_in_words(graph):
    process = graph.start('localizer', mode='localization', slam='ekf_ti')
    assert graph.ended(process) == 2
    graph.processes.clear()
    assert 'expected a session_path' in graph.log('localizer')


@pytest.mark.parametrize(
    ('slam', 'unknown', 'own'),
    [
        (
            'scan_matching',
            'association.gate (only with slam: ekf_ti or ekf_full)',
            'matching.noise_m',
        ),
        ('ekf_ti', 'matching.noise_m (only with slam: scan_matching)', 'association.gate'),
    ],
)
def test_parameters_of_another_localizer_are_unknown_with_where_they_belong(
    graph, slam, unknown, own
):
    given = {'slam': slam, 'association.gate': 4.0, 'matching.noise_m': 0.08}
    graph.start('localizer', **given)
    graph.until(lambda: unknown in graph.log('localizer'), 'a warning')
    assert 'ignored parameters that node localizer does not have' in graph.log('localizer')
    assert own not in graph.log('localizer')


def test_parameters_of_another_localizer_are_an_error_where_unknown_ones_are(graph):
    process = graph.start('localizer', **{'association.gate': 4.0, 'strict_parameters': True})
    assert graph.ended(process) == 2
    graph.processes.clear()
    unknown = 'has no parameter association.gate (only with slam: ekf_ti or ekf_full)'
    assert unknown in graph.log('localizer')
