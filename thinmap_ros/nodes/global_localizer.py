"""Global localization: finds the pose of a robot anywhere in the map, on request or when lost."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from sensor_msgs.msg import LaserScan

from thinmap_msgs.msg import LocalizationStatus, SlamStatus, TopologicalMap
from thinmap_msgs.srv import LocalizeGlobally
from thinmap_ros import kernels
from thinmap_ros.core.config import Config, parameter
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.places.active_search import ActiveSearch
from thinmap_ros.core.places.global_localizer import GlobalLocalization, Result, SearchState
from thinmap_ros.core.places.place_database import GlobalLocalizationConfig
from thinmap_ros.core.planning.navigator import CONTROL_PERIOD_S, NavigatorConfig
from thinmap_ros.core.planning.path_follower import PathFollowerConfig
from thinmap_ros.core.planning.wavefront import WavefrontConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer
from thinmap_ros.core.topology.graph import TopologicalMap as Topology
from thinmap_ros.core.topology.graph import TopologyConfig, topology_from_msg
from thinmap_ros.core.topology.topology import build
from thinmap_ros.files import occupancy_maps
from thinmap_ros.logs.frames import NONE
from thinmap_ros.nodes.parts.driving import RobotState
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.maps import subscribe_to_map
from thinmap_ros.ros.services import offer
from thinmap_ros.ros.stop_topic import StopTopic
from thinmap_ros.ros.subscription import WARN_PERIOD_S, subscribe_guarded
from thinmap_ros.ros.tf import OdometrySource
from thinmap_ros.ros.velocity import VelocityPublisher, declare_stamped

# Margins added to the radius of the robot: for paths, and for stops in front of obstacles.
_PATH_MARGIN_M = 0.05
_STOP_MARGIN_M = 0.04
_STATES = {
    SearchState.WAITING: LocalizationStatus.WAITING,
    SearchState.SEARCHING: LocalizationStatus.SEARCHING,
    SearchState.AMBIGUOUS: LocalizationStatus.AMBIGUOUS,
    SearchState.LOCALIZED: LocalizationStatus.LOCALIZED,
    SearchState.NOT_IN_MAP: LocalizationStatus.NOT_IN_MAP,
}


@dataclass(frozen=True)
class GlobalLocalizerConfig(Config):
    """Parameters of the node besides those of the search."""

    seed: int = parameter(
        0,
        'Seed of the samples: the same seed and scans give the same answers. Another value for '
        'another sequence of samples.',
        low=0,
        high=2**31 - 1,
    )
    start_automatically: bool = parameter(
        False, 'Start at once, and when the localizer has reported LOST for lost_timeout_s.'
    )
    lost_timeout_s: float = parameter(
        3.0,
        'Time for which the localizer must report LOST (s). Raise it if the localizer recovers by '
        'itself.',
        low=0.0,
    )
    drive: bool = parameter(
        False, 'Drive towards disambiguating viewpoints while localizing. Publishes cmd_vel.'
    )
    drive_speed_m_s: float = parameter(
        0.3,
        'Speed of that drive (m/s). Set it to that of the navigator: lower among people, higher in '
        'halls.',
        low=0.01,
        high=5.0,
    )
    map_path: str = parameter(
        '', 'map_server YAML file. Empty: map and topology are taken from their topics.'
    )


class _SearchDriver:
    """Drives the robot to where the pose candidates can be told apart best.

    search: None while there is nothing to search; robot: what is known of it now.
    """

    def __init__(
        self, new_robot: Callable[[], RobotState], velocity: VelocityPublisher | None
    ) -> None:
        """velocity: None for a node that does not drive."""
        self._new_robot = new_robot
        self._velocity = velocity
        self._is_driving = False
        self._is_held = False
        self.reset()

    def reset(self) -> None:
        """Forget scans, odometry and search."""
        self.search: ActiveSearch | None = None
        self.robot = self._new_robot()

    def add_result(self, result: Result, T_odom_base: Array) -> None:
        """Add the result of a step of the localization at an odometry pose (3,)."""
        if self.search is not None:
            self.search.take(result, T_odom_base)

    def hold(self, stop: StopTopic) -> None:
        """Stand while the stop has a reason."""
        self._is_held = bool(stop.reason)
        self.stop()
        if self._velocity is not None:
            self._velocity.hold(self._is_held)

    def step(self) -> None:
        """Publish the next command, or stop while inputs are missing or too old."""
        robot = self.robot
        can_drive = not (self._is_held or robot.awaited_scans or robot.stop_reason())
        if self.search is None or robot.T_odom_base is None or not can_drive:
            self.stop()
            return
        command = self.search.step(robot.T_odom_base, robot.scans, CONTROL_PERIOD_S)
        if command.state == 'idle':
            self.stop()
            return
        self._is_driving = True
        if self._velocity is not None:
            self._velocity.publish(command.v, command.w)

    def stop(self) -> None:
        """Stop the robot, if it was driven."""
        if self._is_driving and self._velocity is not None:
            self._velocity.publish(0.0, 0.0)
        self._is_driving = False

    def close(self) -> None:
        """Stop the robot, if it was driven, before the node is gone."""
        if self._is_driving and self._velocity is not None:
            self._velocity.stop()


class GlobalLocalizerNode(ThinmapNode):
    """/scan, /odom, /map and /topology in.

    /initialpose, /localization_samples and /localization_status out. Service localize_globally.
    The search uses the map as it is at its start. Once the pose is certain, it is published once,
    and the node waits for the next request. With `active` it drives meanwhile: /cmd_vel out.
    """

    def __init__(self) -> None:
        super().__init__('global_localizer')
        self._search = parameters.declare_config(self, GlobalLocalizationConfig)
        self._config = parameters.declare_config(self, GlobalLocalizerConfig)
        self._lost_ns = round(SECOND_NS * self._config.lost_timeout_s)
        self._map_frame = parameters.declare_map_frame(self)
        is_stamped = declare_stamped(self)
        self._laser_transform = LaserTransform(self)
        base_frame = self._laser_transform.base_frame
        self._odometry = OdometrySource(self, base_frame, self._on_odometry)
        parameters.reject_unknown(self)
        self._patch: GridPatch | None = None
        self._topology: Topology | None = None
        if self._config.map_path:
            file = Path(self._config.map_path)
            self._patch = occupancy_maps.read_map(file, report=self.get_logger().warning)
            self._topology = build(self._patch, None, TopologyConfig())
        kernels.global_localizer()
        if self._config.drive:
            kernels.active_search()
        self._pose = self.create_publisher(PoseWithCovarianceStamped, 'initialpose', qos.STREAM)
        self._samples = self.create_publisher(PoseArray, 'localization_samples', qos.LATCHED)
        self._samples_ns = -SECOND_NS
        self._status = self.create_publisher(LocalizationStatus, 'localization_status', qos.LATCHED)
        self._driver = self._create_driver(is_stamped)
        self.reset_state()
        if not self._config.map_path:
            subscribe_to_map(self, 'map', self._on_map)
            subscribe_guarded(self, TopologicalMap, 'topology', self._on_topology, qos.LATCHED)
        subscribe_guarded(self, SlamStatus, 'slam_status', self._on_slam_status, qos.STREAM)
        self._odometry.subscribe()
        self._laser_transform.subscribe(self, self._on_scan)
        offer(self.create_active_service, LocalizeGlobally, 'localize_globally', self._on_request)
        self.create_active_timer(1.0, self._report_missing_inputs)

    def _create_driver(self, is_stamped: bool) -> _SearchDriver:
        new_robot = partial(
            RobotState,
            self.elapsed_time,
            self._odometry.source != NONE,
            self._laser_transform.scan_topics,
        )
        if not self._config.drive:
            return _SearchDriver(new_robot, None)
        velocity = VelocityPublisher(self, self._laser_transform.base_frame, is_stamped)
        self.create_active_timer(CONTROL_PERIOD_S, lambda: self._driver.step())
        driver = _SearchDriver(new_robot, velocity)
        StopTopic(self, driver.hold)
        return driver

    def reset_state(self) -> None:
        """Discard the search and all inputs but the map."""
        self._localization: GlobalLocalization | None = None
        self._is_requested = self._config.start_automatically
        self._lost_since_ns: int | None = None
        self._found_ns = -1  # stamp of the last pose that was found
        self._pairing = ScanOdometrySynchronizer()
        self._odometry.reset()
        self._received: set[str] = set()
        self._driver.reset()

    def stop(self) -> None:
        """Stop the robot, if it is this node that drives it."""
        self._driver.stop()

    def close(self) -> None:
        """Stop the robot: the last thing the node does."""
        self._driver.close()
        super().close()

    def _on_map(self, patch: GridPatch) -> None:
        self._patch = patch

    def _on_topology(self, message: TopologicalMap) -> None:
        self._topology = topology_from_msg(message)

    def _on_slam_status(self, message: SlamStatus) -> None:
        """Start when the localizer reports that it is lost (kidnapped robot)."""
        stamp_ns = messages.stamp_ns(message.header.stamp)
        # Up to the pose that was found last, the localizer had not received that.
        is_new = stamp_ns > self._found_ns
        if not (is_new and messages.is_lost(message)) or self._is_requested:
            self._lost_since_ns = None
        elif self._lost_since_ns is None:
            self._lost_since_ns = stamp_ns
        elif self._config.start_automatically and stamp_ns - self._lost_since_ns >= self._lost_ns:
            self.get_logger().info('the localizer is lost: searching the whole map')
            self._start(clear=True)

    def _on_request(self, request: LocalizeGlobally.Request) -> str:
        self._start(request.discard_hypotheses)
        missing = self._missing()
        return f'waits for {missing}' if missing else 'searching the whole map'

    def _start(self, clear: bool) -> None:
        self._is_requested = True
        self._lost_since_ns = None
        if clear:
            self._discard_search()

    def _discard_search(self) -> None:
        self._localization = None
        self._driver.search = None

    def _on_odometry(self, stamp_ns: int, T_odom_base: Array) -> None:
        self._received.add('odom')
        self._driver.robot.add_odometry(stamp_ns, T_odom_base)
        tilt_rad = self._odometry.tilt_rad
        self._process(self._pairing.add_odometry(stamp_ns, T_odom_base, tilt_rad))

    def _on_scan(self, topic: str, message: LaserScan) -> None:
        scan = self._laser_transform.to_scan(topic, message)
        self._received.add(topic)
        self._driver.robot.add_scan(scan, topic)
        self._odometry.add_scan_stamp(scan.odometry_ns)
        self._process(self._pairing.add_scan(scan))

    def _process(self, ready: list[tuple[Scan, Array]]) -> None:
        for scan, T_odom_base in ready:
            localization = self._create_localization() if self._is_requested else None
            if localization is not None:
                with self.diagnostics.time_step('global localization'):
                    result = localization.step(scan, T_odom_base)
                self._driver.add_result(result, T_odom_base)
                self._publish_samples(scan.stamp_ns, localization.samples)
                self._publish_result(scan.stamp_ns, result)
                if result.pose is not None:
                    self._finish(scan.stamp_ns)

    def _finish(self, stamp_ns: int) -> None:
        """The pose is found: wait for the next request."""
        self._is_requested = False
        self._found_ns = stamp_ns
        self._discard_search()
        self.stop()

    def _create_localization(self) -> GlobalLocalization | None:
        """The search under way, or a new one; None while the map is missing or unusable."""
        if self._localization is not None or self._patch is None or self._topology is None:
            return self._localization
        try:
            localization = GlobalLocalization(
                self._patch, self._topology, self._search, self._config.seed
            )
        except InputError as error:
            self._publish_state(LocalizationStatus.WAITING, str(error))
            return None
        self._localization = localization
        if self._config.drive:
            driving = _driving(self._search.robot_radius_m, self._config.drive_speed_m_s)
            self._driver.search = ActiveSearch(localization.places, self._search, driving)
        return localization

    def _missing(self) -> str:
        """Names of the missing inputs; '' for none."""
        maps = {'map': self._patch, 'topology': self._topology}
        missing = [name for name, value in maps.items() if value is None]
        topics = ('odom', *self._laser_transform.scan_topics)
        missing += [name for name in topics if name not in self._received]
        return ', '.join(missing)

    def _report_missing_inputs(self) -> None:
        missing = self._missing()
        if not self._is_requested:
            self._publish_state(LocalizationStatus.IDLE, 'no request')
        elif missing:
            self._publish_state(LocalizationStatus.WAITING, f'waits for {missing}')

    def _publish_state(self, state: int, reason: str) -> None:
        """Publish a state without candidates, at the present time."""
        header = messages.header(self._map_frame, self.now_ns)
        self._publish_status(LocalizationStatus(header=header, state=state, reason=reason))

    def _publish_result(self, stamp_ns: int, result: Result) -> None:
        """Publish a result at a scan's stamp, with its pose if it has one."""
        self._publish_status(
            LocalizationStatus(
                header=messages.header(self._map_frame, stamp_ns),
                state=_STATES[result.state],
                reason=result.reason,
                hypotheses=[messages.pose_msg(found.T_map_base) for found in result.hypotheses],
                weights=[found.weight for found in result.hypotheses],
                inlier_ratios=[found.explained for found in result.hypotheses],
            )
        )
        pose = result.pose
        if pose is not None:
            self._pose.publish(
                messages.pose_with_covariance_msg(
                    pose.T_map_base, pose.covariance, self._map_frame, stamp_ns
                )
            )
            self.get_logger().info(f'localized: {result.reason}')

    def _publish_samples(self, stamp_ns: int, samples: Array) -> None:
        """Publish the samples (N, 3), at most once a second: it takes longer than a step."""
        if not 0 <= stamp_ns - self._samples_ns < SECOND_NS:
            self._samples_ns = stamp_ns
            poses = [messages.pose_msg(T) for T in samples]
            header = messages.header(self._map_frame, stamp_ns)
            self._samples.publish(PoseArray(header=header, poses=poses))

    def _publish_status(self, status: LocalizationStatus) -> None:
        self._status.publish(status)
        if status.state == LocalizationStatus.WAITING:
            self.get_logger().warning(status.reason, throttle_duration_sec=WARN_PERIOD_S)


def _driving(robot_radius_m: float, speed_m_s: float) -> NavigatorConfig:
    """How a robot is driven while it searches."""
    return NavigatorConfig(
        planner=WavefrontConfig(robot_radius_m=robot_radius_m + _PATH_MARGIN_M),
        controller=PathFollowerConfig(max_speed_m_s=speed_m_s),
        stop_radius_m=robot_radius_m + _STOP_MARGIN_M,
    )


main = node_main.program(GlobalLocalizerNode)

if __name__ == '__main__':
    main()
