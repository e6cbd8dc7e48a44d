"""Where the robot is.

Each scan, with the odometry at its stamp, through one step of the localizer.
"""

from dataclasses import replace
from time import monotonic, perf_counter

from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from rclpy.clock import Clock, ClockType
from rclpy.subscription import Subscription
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from thinmap_msgs.msg import LineFeature, LineFeatureArray, SlamStatus, TopologicalMap
from thinmap_msgs.srv import LoadMap, SaveMap
from thinmap_ros.core import se2
from thinmap_ros.core.ekf_slam.features import LineFeature as Feature
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.estimate import Estimate
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.odometry import LastPose, ScanPairing
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import ScanLocalizerConfig
from thinmap_ros.core.slam.localizers import (
    AnyLocalizer,
    line_features,
    localizer_class,
    set_topology,
)
from thinmap_ros.core.snapshot import State
from thinmap_ros.core.topology.graph import TopologicalMap as Graph
from thinmap_ros.files.sessions import LOCALIZER
from thinmap_ros.kernels import warm_up
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.diagnostics import ERROR, OK
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.save_directory import SaveDirectory
from thinmap_ros.ros.services import fill_response
from thinmap_ros.ros.subscription import subscribe_guarded

_MAP_WAIT_S = 3.0  # after a restart; the navigator drives on for so long without a new pose
_HEALTH = {
    SlamStatus.TRACKING: (OK, 'tracking'),
    SlamStatus.LOST: (ERROR, 'lost: scans do not fit the map'),
    SlamStatus.BLIND: (ERROR, 'laser blind (too few valid beams): odometry alone'),
}


class LocalizerNode(ThinmapNode):
    """/scan and /odom in; /pose, map -> odom on /tf, /line_features, /slam_status out.

    /trajectory after a loop closure.

    Services ~/pause, ~/reset, save_localizer, load_localizer. In the map of a session it is lost
    until /initialpose arrives or a scan matches at its start pose.
    """

    def __init__(self) -> None:
        super().__init__('localizer', recovers=True)
        self._config = parameters.declare_config(self, ScanLocalizerConfig)
        self._map_frame = parameters.declare_parameter(self, 'map_frame', 'map', 'frame of the map')
        self._odom_frame = parameters.declare_parameter(
            self, 'odom_frame', 'odom', 'frame of the odometry'
        )
        self._laser_transform = LaserTransform(self)
        self._session = parameters.declare_session(self)
        self._save_directory = SaveDirectory(self)
        parameters.reject_unknown(self)
        warm_up.localizer()
        self._map_topic: Subscription | None = None
        # Of a localizer that was killed: its last pose, the map, and the newest scan, that waits
        # for it.
        self._restored_pose: LastPose | None = None
        self._latched_map: GridPatch | None = None
        self.reset_state()
        self.enable_checkpoint(
            lambda: None if self._last is None else self._last.state(), self._restore_checkpoint
        )
        self.create_pause_service()
        self.diagnostics.check_sole_publisher('pose')
        self._pose = self.create_publisher(PoseWithCovarianceStamped, 'pose', qos.STREAM)
        self._tf = self.create_publisher(TFMessage, '/tf', qos.STREAM)
        self._features = self.create_publisher(LineFeatureArray, 'line_features', qos.LATCHED)
        self._status = self.create_publisher(SlamStatus, 'slam_status', qos.STREAM)
        self._trajectory = self.create_publisher(Path, 'trajectory', qos.LATCHED)
        # Before the scans: of messages that wait together, the executor takes the graph of the last
        # scan first.
        subscribe_guarded(self, TopologicalMap, 'topology', self._on_topology, qos.LATCHED)
        subscribe_guarded(self, Odometry, 'odom', self._on_odometry, qos.STREAM)
        subscribe_guarded(self, LaserScan, 'scan', self._on_scan, qos.SENSOR)
        subscribe_guarded(
            self, PoseWithCovarianceStamped, 'initialpose', self._on_initial_pose, qos.STREAM
        )
        self.create_service(SaveMap, 'save_localizer', self._on_save)
        self.create_service(LoadMap, 'load_localizer', self._on_load)

    def reset_state(self) -> None:
        """Forget all features, or go back to the session that the node was started with.

        The robot is at its start.
        """
        self._localizer = self._create_localizer(self._config)
        self._pairing = ScanPairing()
        self._last: LastPose | None = None
        self._topology: Graph | None = None
        self._restored_pose = self._latched_map = None
        self._pending_scan: list[tuple[Scan, Array]] = []
        self._waiting_since = monotonic()

    def _restore_checkpoint(self, left: State) -> None:
        """Go on from the last pose of a killed localizer. Raises InputError where it is none."""
        self._restored_pose = LastPose.from_state(left)
        self._subscribe_map_once()

    def _create_localizer(self, config: ScanLocalizerConfig) -> AnyLocalizer:
        """A localizer that begins at its start, in the map of the session if there is one."""
        loaded = LOCALIZER.load_optional(self._session, config) if self._session else None
        return loaded or localizer_class(config)(config)

    def _config_at(self, T_map_base: Array) -> ScanLocalizerConfig:
        """The configuration of a robot that starts at a pose (3,)."""
        x, y, yaw = T_map_base.tolist()
        return replace(self._config, start_x_m=x, start_y_m=y, start_yaw_rad=yaw)

    def _on_odometry(self, message: Odometry) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        ready = self._pairing.add_odometry(stamp_ns, messages.pose_from_msg(message.pose.pose))
        self._process(ready)

    def _on_scan(self, message: LaserScan) -> None:
        self._process(self._pairing.add_scan(self._laser_transform.to_scan(message)))

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._localizer.set_pose(
            messages.pose_from_msg(message.pose.pose), messages.covariance_from_msg(message)
        )

    def _on_topology(self, message: TopologicalMap) -> None:
        self._topology = messages.topology_from_msg(message)
        set_topology(self._localizer, self._topology)

    def _process(self, ready: list[tuple[Scan, Array]]) -> None:
        if self._restored_pose is not None:
            ready = self._resume(self._restored_pose, ready)
        for scan, T_odom_base in ready:
            started = perf_counter()
            estimate = self._localizer.step(scan, T_odom_base)
            step_ms = 1000.0 * (perf_counter() - started)
            self._publish(scan, estimate, step_ms)
            if not estimate.lost:
                self._last = LastPose(scan.stamp_ns, estimate.T_map_odom, T_odom_base)
        self.diagnostics.set_drop_total(
            'scans without odometry at their time', self._pairing.dropped
        )
        self.diagnostics.set_drop_total(
            'scans or odometry that make no sense', self._localizer.refused
        )

    def _subscribe_map_once(self) -> None:
        """Hear the map that was drawn before this localizer was killed, once."""

        def take(message: OccupancyGrid) -> None:
            if self._restored_pose is None:
                return  # it was told to begin anew
            try:
                self._latched_map = messages.grid_from_msg(message)
            except InputError as error:
                self.get_logger().warning(f'map: {error}')
            if self.is_active:
                self._process([])

        self._map_topic = self.create_subscription(OccupancyGrid, 'map', take, qos.LATCHED)
        self.create_active_timer(
            _MAP_WAIT_S, lambda: self._process([]), Clock(clock_type=ClockType.STEADY_TIME)
        )

    def _resume(self, last: LastPose, ready: list[tuple[Scan, Array]]) -> list[tuple[Scan, Array]]:
        """Begin where the robot is now, in the map; returns the scan to go on with, or none yet.

        Where the odometry has begun anew, too, the robot is at its start. Where there is no map, it
        begins with what it sees where odometry says that it is.
        """
        self._pending_scan = ready[-1:] or self._pending_scan
        if not self._pending_scan:
            self._waiting_since = monotonic()
            return []
        scan, T_odom_base = self._pending_scan[0]
        leads = last.leads_to(scan.stamp_ns, T_odom_base)
        waited_s = monotonic() - self._waiting_since
        if leads and self._latched_map is None and waited_s < _MAP_WAIT_S:
            return []
        if not leads:
            self.get_logger().warning('the odometry has begun anew as well: beginning at the start')
        elif self._latched_map is None:
            self.get_logger().warning(
                f'no map came for {waited_s:.0f} s: what is drawn now may not fit what was before'
            )
            self._localizer = self._create_localizer(
                self._config_at(se2.compose(last.T_map_odom, T_odom_base))
            )
        else:
            kind = localizer_class(self._config)
            self._localizer = kind.resumed(self._latched_map, last, T_odom_base, self._config)
        if self._topology is not None:
            set_topology(self._localizer, self._topology)
        self._restored_pose = self._latched_map = None
        self.destroy_subscription(self._map_topic)
        return self._pending_scan

    def _on_save(self, request: SaveMap.Request, response: SaveMap.Response) -> SaveMap.Response:
        def save() -> str:
            path = self._save_directory.resolve(request.path)
            return f'saved {LOCALIZER.save(path, self._localizer)}'

        return fill_response(response, save)

    def _on_load(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        return fill_response(response, lambda: self._load(request.path))

    def _load(self, path: str) -> str:
        """Take over the features of a session; without any, those that there are stay."""
        config = self._config_at(self._localizer.pose)
        loaded = LOCALIZER.load_optional(self._save_directory.resolve(path), config)
        if loaded is None:
            return 'no features are saved: the localizer keeps its own'
        self._localizer = loaded
        if self._topology is not None:
            set_topology(loaded, self._topology)
        features = line_features(loaded)
        return f'{len(features)} line features' if features else 'the local map'

    def _publish(self, scan: Scan, estimate: Estimate, step_ms: float) -> None:
        ns = scan.stamp_ns
        self.diagnostics.record_step_time('localizer', step_ms)
        state = _state_of(scan, estimate)
        self.diagnostics.set_state(*_HEALTH[state])
        if estimate.correction is not None:
            self._publish_trajectory(ns)
        pose = messages.pose_with_covariance_msg(
            estimate.T_map_base, estimate.covariance, self._map_frame, ns
        )
        self._pose.publish(pose)
        transform = messages.transform_msg(
            estimate.T_map_odom, self._map_frame, self._odom_frame, ns
        )
        self._tf.publish(TFMessage(transforms=[transform]))
        header = messages.header(self._map_frame, ns)
        features = [_feature_msg(feature) for feature in line_features(self._localizer)]
        self._features.publish(LineFeatureArray(header=header, features=features))
        self._status.publish(
            SlamStatus(
                header=header,
                state=state,
                features=len(features),
                local_features=estimate.n_local,
                observed=estimate.observed,
                matched=estimate.matched,
                refused=self._localizer.refused,
                match_quality=estimate.match_quality,
                step_time_ms=step_ms,
            )
        )

    def _publish_trajectory(self, ns: int) -> None:
        """Say where the kept scans were made, now that a loop is closed.

        Before the first pose that follows from it.
        """
        stamps, poses = self._localizer.past()
        self._trajectory.publish(
            messages.trajectory_msg(stamps.tolist(), poses, self._map_frame, ns)
        )
        self.get_logger().info(f'a loop is closed: {len(poses)} poses of the past are corrected')


def _state_of(scan: Scan, estimate: Estimate) -> int:
    """State of a SlamStatus. Of a robot that sees nothing it is not known whether it is lost."""
    if scan.is_blind:
        return int(SlamStatus.BLIND)
    return int(SlamStatus.LOST if estimate.lost else SlamStatus.TRACKING)


def _feature_msg(feature: Feature) -> LineFeature:
    return LineFeature(
        id=feature.id,
        r_m=feature.r_m,
        alpha_rad=feature.alpha_rad,
        covariance=feature.covariance.ravel(),
        start=Point(x=float(feature.start[0]), y=float(feature.start[1])),
        end=Point(x=float(feature.end[0]), y=float(feature.end[1])),
        node_ids=feature.nodes,
        in_local_area=feature.local,
    )


def main() -> None:
    """Run the node."""
    node_main.run(LocalizerNode)


if __name__ == '__main__':
    main()
