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
from thinmap_ros.core.odometry import OdometryAnchor, ScanOdometrySynchronizer
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import ScanLocalizerConfig
from thinmap_ros.core.slam.localizers import (
    AnyLocalizer,
    line_features,
    localizer_class,
    set_topology,
)
from thinmap_ros.core.topology.graph import TopologicalMap as Graph
from thinmap_ros.files import sessions
from thinmap_ros.kernels import warm_up
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.checkpoint import State
from thinmap_ros.ros.diagnostics import ERROR, OK
from thinmap_ros.ros.laser_transform import LaserMount
from thinmap_ros.ros.lifecycle_node import LiveNode
from thinmap_ros.ros.save_folder import SaveFolder
from thinmap_ros.ros.services import answer
from thinmap_ros.ros.subscription import listen

_MAP_WAIT_S = 3.0  # after a restart; the navigator drives on for so long without a new pose
_HEALTH = {
    SlamStatus.TRACKING: (OK, 'tracking'),
    SlamStatus.LOST: (ERROR, 'lost: scans do not fit the map'),
    SlamStatus.BLIND: (ERROR, 'laser blind (too few valid beams): odometry alone'),
}


class LocalizerNode(LiveNode):
    """/scan and /odom in; /pose, map -> odom on /tf, /line_features, /slam_status out.

    /trajectory after a loop.

    Services ~/pause, ~/reset, and save_features and load_features for sessions: lost in the map of
    one, it waits for /initialpose, or for a scan that fits where it is.
    """

    def __init__(self) -> None:
        super().__init__('localizer', recovers=True)
        self._config = parameters.declare(self, ScanLocalizerConfig)
        self._map_frame = parameters.declare_value(self, 'map_frame', 'map', 'frame of the map')
        self._odom_frame = parameters.declare_value(
            self, 'odom_frame', 'odom', 'frame of the odometry'
        )
        self._mount = LaserMount(self)
        self._session = parameters.declare_session(self)
        self._saves = SaveFolder(self)
        parameters.check_unknown(self)
        warm_up.localizer()
        self._map_topic: Subscription | None = None
        # Of a localizer that was killed: its last pose, the map, and the newest scan, that waits
        # for it.
        self._resumed: OdometryAnchor | None = None
        self._latched: GridPatch | None = None
        self.begin_anew()
        self.keep(lambda: None if self._last is None else self._last.state(), self._take_up)
        self.offer_pause()
        self.health.sole_publisher_of('pose')
        self._pose = self.create_publisher(PoseWithCovarianceStamped, 'pose', qos.STREAM)
        self._tf = self.create_publisher(TFMessage, '/tf', qos.STREAM)
        self._features = self.create_publisher(LineFeatureArray, 'line_features', qos.LATCHED)
        self._status = self.create_publisher(SlamStatus, 'slam_status', qos.STREAM)
        self._trajectory = self.create_publisher(Path, 'trajectory', qos.LATCHED)
        # Before the scans: of messages that wait together, the executor takes the graph of the last
        # scan first.
        listen(self, TopologicalMap, 'topology', self._on_topology, qos.LATCHED)
        listen(self, Odometry, 'odom', self._on_odometry, qos.STREAM)
        listen(self, LaserScan, 'scan', self._on_scan, qos.SENSOR)
        listen(self, PoseWithCovarianceStamped, 'initialpose', self._on_initial_pose, qos.STREAM)
        self.create_service(SaveMap, 'save_features', self._on_save)
        self.create_service(LoadMap, 'load_features', self._on_load)

    def begin_anew(self) -> None:
        """Forget all features, or go back to the session that the node was started with.

        The robot is at its start.
        """
        self._localizer = self._made(self._config)
        self._pairing = ScanOdometrySynchronizer()
        self._last: OdometryAnchor | None = None
        self._topology: Graph | None = None
        self._resumed = self._latched = None
        self._newest: list[tuple[Scan, Array]] = []
        self._waits_since = monotonic()

    def _take_up(self, left: State) -> None:
        """Go on from the last pose of a killed localizer. Raises InputError where it is none."""
        self._resumed = OdometryAnchor.from_state(left)
        self._listen_for_the_map()

    def _made(self, config: ScanLocalizerConfig) -> AnyLocalizer:
        """A localizer that begins at its start, in the map of the session if there is one."""
        loaded = sessions.load_features(self._session, config) if self._session else None
        return loaded or localizer_class(config)(config)

    def _at(self, T_map_base: Array) -> ScanLocalizerConfig:
        """The configuration of a robot that starts at a pose (3,)."""
        x, y, yaw = T_map_base.tolist()
        return replace(self._config, start_x_m=x, start_y_m=y, start_yaw_rad=yaw)

    def _on_odometry(self, message: Odometry) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        ready = self._pairing.add_odometry(stamp_ns, messages.pose_from(message.pose.pose))
        self._take(ready)

    def _on_scan(self, message: LaserScan) -> None:
        self._take(self._pairing.add_scan(self._mount.scan(message)))

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._localizer.set_pose(
            messages.pose_from(message.pose.pose), messages.covariance_from(message)
        )

    def _on_topology(self, message: TopologicalMap) -> None:
        self._topology = messages.topology_from(message)
        set_topology(self._localizer, self._topology)

    def _take(self, ready: list[tuple[Scan, Array]]) -> None:
        if self._resumed is not None:
            ready = self._resume(self._resumed, ready)
        for scan, T_odom_base in ready:
            started = perf_counter()
            estimate = self._localizer.step(scan, T_odom_base)
            step_ms = 1000.0 * (perf_counter() - started)
            self._publish(scan, estimate, step_ms)
            if not estimate.is_lost:
                self._last = OdometryAnchor(scan.stamp_ns, estimate.T_map_odom, T_odom_base)
        self.health.dropped_in_all('scans without odometry at their time', self._pairing.dropped)
        self.health.dropped_in_all('scans or odometry that make no sense', self._localizer.refused)

    def _listen_for_the_map(self) -> None:
        """Hear the map that was drawn before this localizer was killed, once."""

        def take(message: OccupancyGrid) -> None:
            if self._resumed is None:
                return  # it was told to begin anew
            try:
                self._latched = messages.patch_from(message)
            except InputError as error:
                self.get_logger().warning(f'map: {error}')
            if self.is_active:
                self._take([])

        self._map_topic = self.create_subscription(OccupancyGrid, 'map', take, qos.LATCHED)
        self.every(_MAP_WAIT_S, lambda: self._take([]), Clock(clock_type=ClockType.STEADY_TIME))

    def _resume(
        self, last: OdometryAnchor, ready: list[tuple[Scan, Array]]
    ) -> list[tuple[Scan, Array]]:
        """Begin where the robot is now, in the map; returns the scan to go on with, or none yet.

        Where the odometry has begun anew, too, the robot is at its start. Where there is no map, it
        begins with what it sees where odometry says that it is.
        """
        self._newest = ready[-1:] or self._newest
        if not self._newest:
            self._waits_since = monotonic()
            return []
        scan, T_odom_base = self._newest[0]
        leads = last.is_continuous_with(scan.stamp_ns, T_odom_base)
        waited_s = monotonic() - self._waits_since
        if leads and self._latched is None and waited_s < _MAP_WAIT_S:
            return []
        if not leads:
            self.get_logger().warning('the odometry has begun anew as well: beginning at the start')
        elif self._latched is None:
            self.get_logger().warning(
                f'no map came for {waited_s:.0f} s: what is drawn now may not fit what was before'
            )
            self._localizer = self._made(self._at(se2.compose(last.T_map_odom, T_odom_base)))
        else:
            kind = localizer_class(self._config)
            self._localizer = kind.resumed(self._latched, last, T_odom_base, self._config)
        if self._topology is not None:
            set_topology(self._localizer, self._topology)
        self._resumed = self._latched = None
        self.destroy_subscription(self._map_topic)
        return self._newest

    def _on_save(self, request: SaveMap.Request, response: SaveMap.Response) -> SaveMap.Response:
        def save() -> str:
            path = self._saves.inside(request.path)
            return f'saved {sessions.save_features(path, self._localizer)}'

        return answer(response, save)

    def _on_load(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        return answer(response, lambda: self._load(request.path))

    def _load(self, path: str) -> str:
        """Take over the features of a session; without any, those that there are stay."""
        config = self._at(self._localizer.pose)
        loaded = sessions.load_features(self._saves.inside(path), config)
        if loaded is None:
            return 'no features are saved: the localizer keeps its own'
        self._localizer = loaded
        if self._topology is not None:
            set_topology(loaded, self._topology)
        features = line_features(loaded)
        return f'{len(features)} line features' if features else 'the local map'

    def _publish(self, scan: Scan, estimate: Estimate, step_ms: float) -> None:
        ns = scan.stamp_ns
        self.health.took('localizer', step_ms)
        state = _state_of(scan, estimate)
        self.health.state(*_HEALTH[state])
        if estimate.correction is not None:
            self._tell_trajectory(ns)
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
                local_features=estimate.n_local_features,
                observed=estimate.observed_lines,
                matched=estimate.matched_lines,
                refused=self._localizer.refused,
                match_quality=estimate.inlier_ratio,
                step_time_ms=step_ms,
            )
        )

    def _tell_trajectory(self, ns: int) -> None:
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
    return int(SlamStatus.LOST if estimate.is_lost else SlamStatus.TRACKING)


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
