"""The pose of the robot: each scan, with the odometry at its stamp, is a step of the localizer."""

import math
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from nav_msgs.msg import Path
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from thinmap_msgs.msg import (
    LineFeature,
    LineFeatureArray,
    LocalizedScan,
    ProbabilityGrid,
    SlamStatus,
    TopologicalMap,
)
from thinmap_msgs.srv import SetMapTag
from thinmap_ros import kernels
from thinmap_ros.core import snapshot
from thinmap_ros.core.ekf_slam.features import LineFeature as Feature
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.odometry import OdometryAnchor
from thinmap_ros.core.scan import TILTED, Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.sensing.consistency import ConsistencyMonitor
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer
from thinmap_ros.core.slam.localizer import (
    AnyLocalizer,
    Localizer,
    adjust,
    config_class,
    parameters_elsewhere,
)
from thinmap_ros.core.slam.track import LIVE_PARAMETERS, LocalizerConfig
from thinmap_ros.core.snapshot import State
from thinmap_ros.core.stage import SCAN_MATCHING, Correction, Estimate, StartConfig, config_at
from thinmap_ros.core.topology.graph import TopologicalMap as Graph
from thinmap_ros.core.topology.graph import topology_from_msg
from thinmap_ros.files.sessions import LOCALIZER, load_localizer, save_localizer
from thinmap_ros.logs.frames import NONE
from thinmap_ros.nodes.parts.localization import (
    GivenMap,
    KeyframeOutput,
    Recovery,
    require_near_map,
    restored,
)
from thinmap_ros.ros import messages, node_main, parameters, qos
from thinmap_ros.ros.diagnostics import ERROR, OK, SCALE_KEY, WARN
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.localized_scan import localized_scan_msg
from thinmap_ros.ros.maps import UNKNOWN, new_map_id
from thinmap_ros.ros.services import offer
from thinmap_ros.ros.session_services import (
    SaveDirectory,
    offer_loading,
    offer_saving,
)
from thinmap_ros.ros.subscription import AdaptiveSubscription, subscribe_guarded
from thinmap_ros.ros.tf import MapBroadcaster, OdometrySource

_HEALTH = {
    SlamStatus.TRACKING: (OK, 'tracking'),
    SlamStatus.LOST: (ERROR, 'lost: scans contradict the map, or have not confirmed the pose'),
    SlamStatus.NO_MAP: (ERROR, 'no map: waits for topic map; dead reckoning'),
}


class LocalizerNode(ThinmapNode):
    """/scan and /odom in; /pose, map -> odom on /tf, /line_features, /slam_status out.

    /localized_scan with all that a mapper needs of a scan; /trajectory after a loop closure;
    /keyframes and /keyframe_poses for map_joiner.

    /map_tag, or the service set_map_tag, says on which storey the robot is.

    Services ~/pause, ~/reset, save_localizer, load_localizer, and check_localizer, which reads a
    saved map without replacing the present one. In a given map it is lost until
    /initialpose arrives or a scan matches at its start pose. In mode localization the map does not
    change, and the node has AMCL's interface: amcl_pose, particle_cloud, set_initial_pose,
    reinitialize_global_localization, request_nomotion_update.
    """

    def __init__(self) -> None:
        super().__init__('localizer', recovers=True)
        slam = parameters.given_text(self, 'slam', StartConfig.slam)
        self._config = parameters.declare_config(
            self, config_class(slam), self._on_config, LIVE_PARAMETERS
        )
        self._map_frame = parameters.declare_map_frame(self)
        self._create_publishers()
        self._laser_transform = LaserTransform(self)
        base_frame = self._laser_transform.base_frame
        self._odometry = OdometrySource(self, base_frame, self._on_odometry)
        self._broadcaster = MapBroadcaster(
            self,
            self._map_frame,
            self._odometry.odom_frame,
            base_frame if self._odometry.source == NONE else '',
        )
        self._given = GivenMap(self, self._config)
        self._save_directory = SaveDirectory(self)
        offer_saving(self, self._save_directory, LOCALIZER, self._save, self._save_at_end)
        parameters.reject_unknown(self, parameters_elsewhere(slam))
        kernels.localizer()
        if slam != SCAN_MATCHING:
            kernels.ekf_localizer()
        self._map_id = new_map_id() if self._config.is_mapping else UNKNOWN
        self._published_id = UNKNOWN
        self._replaced_id = UNKNOWN  # of the map that a reset has replaced by the present one
        self._is_map_given = False  # loaded, or begun by a reset, and not by the start of the node
        self._begin()
        self.enable_checkpoint(self._state, self._restore, self._map_state)
        if self._config.is_mapping:
            self._living = self.create_subscription(
                ProbabilityGrid, 'grid', self._on_living_map, qos.LATCHED
            )
        self.diagnostics.add_update_callback(self._report_unpaired)
        self.diagnostics.check_sole_publisher('pose')
        self.diagnostics.add_check(WARN, lambda: '; '.join(self._warnings.values()))
        # Before the scans: of messages that wait together, the executor processes the graph of the
        # last scan first.
        subscribe_guarded(self, TopologicalMap, 'topology', self._on_topology, qos.LATCHED)
        self._odometry.subscribe()
        self._laser_transform.subscribe(self, self._on_scan)
        self._given.subscribe_to_poses(
            self._map_frame, self._on_initial_pose, self._broadcaster.received
        )
        self._given.subscribe_to_map(self._on_new_map)
        AdaptiveSubscription(self, String, 'map_tag', self._on_map_tag, qos.LATCHED)
        self._offer_services()

    def _create_publishers(self) -> None:
        self._pose = self.create_publisher(PoseWithCovarianceStamped, 'pose', qos.LATCHED)
        self._features = self.create_publisher(LineFeatureArray, 'line_features', qos.LATCHED)
        self._scan = self.create_publisher(LocalizedScan, 'localized_scan', qos.STREAM)
        self._status = self.create_publisher(SlamStatus, 'slam_status', qos.STREAM)
        self._trajectory = self.create_publisher(Path, 'trajectory', qos.LATCHED)
        self._keyframes = KeyframeOutput(self, self._map_frame)
        self._corrected_ns = 0  # stamp of the last trajectory

    def _offer_services(self) -> None:
        self.create_pause_service()
        offer(
            self.create_service,
            SetMapTag,
            'set_map_tag',
            lambda request: self._enter_storey(request.tag),
        )
        offer_loading(self, LOCALIZER, self._check, self._load)

    def _on_config(self, config: StartConfig) -> None:
        """Continue in the same map with other parameters."""
        self._config = config
        self._given.config = config
        adjust(self._localizer, config)

    def reset_state(self) -> None:
        """Discard the map, or return to the session that the node was started with.

        The robot is at the start pose. A new map is of the storey that the robot is on.
        """
        self._begin_map(replaced_id=self._published_id)
        self._corrected_ns = 0
        before = self._localizer.config
        self._begin()
        tag = before.map_tag if isinstance(before, LocalizerConfig) else ''
        if tag and not len(self._localizer.known_places()):
            self._enter_storey(tag)

    def _begin_map(self, replaced_id: int) -> None:
        """Another map, which is made here: it was loaded, or a reset has replaced one by it."""
        if self._config.is_mapping:
            self._replaced_id = replaced_id
            self._map_id = new_map_id()
            self._is_map_given = True

    def _begin(self) -> None:
        self._localizer = self._given.first_localizer()
        self._broadcaster.reset()
        self._odometry.reset()
        self._pairing = ScanOdometrySynchronizer()
        self._consistency = ConsistencyMonitor()
        self._reported: set[str] = set()  # kinds of warnings that are in the log
        self._topology: Graph | None = None
        self._recovery = Recovery()

    def _state(self) -> State | None:
        pose = self._recovery.pose_state(self._localizer)
        is_map_missing = self._config.is_mapping and not self._recovery.is_map_saved
        if pose is None or is_map_missing:
            return None
        return {**pose, 'map_id': np.array(self._map_id)}

    def _map_state(self) -> State | None:
        """What cannot be loaded again: the map, while it is made."""
        if not self._has_own_map:
            return None
        return self._recovery.map_state(self._localizer)

    @property
    def _has_own_map(self) -> bool:
        """Whether the localizer has made a map."""
        return self._config.is_mapping and self._recovery.last is not None

    def _restore(self, state: State) -> None:
        """Continue as a killed localizer would. Raises InputError for another state."""
        map_id, own = snapshot.split_number(state, 'map_id')
        localizer, last = restored(own, self._config)
        self._localizer = localizer or self._localizer
        self._map_id = map_id
        self._recovery = Recovery(last)

    def _on_odometry(self, stamp_ns: int, T_odom_base: Array) -> None:
        tilt_rad = self._odometry.tilt_rad
        self._process(self._pairing.add_odometry(stamp_ns, T_odom_base, tilt_rad))

    def _on_scan(self, topic: str, message: LaserScan) -> None:
        scan = self._laser_transform.to_scan(topic, message)
        self._odometry.add_scan_stamp(scan.odometry_ns)
        self._process(self._pairing.add_scan(scan))

    def _on_initial_pose(self, T_map_base: Array, covariance: Array) -> None:
        require_near_map(T_map_base, self._localizer)
        self._localizer.set_pose(T_map_base, covariance)
        self._given.pose_set(covariance)

    def _on_map_tag(self, message: String, _: dict[str, Any]) -> None:
        try:
            self.get_logger().info(self._enter_storey(message.data))
        except InputError as error:
            self.get_logger().warning(f'topic map_tag: {error}')

    def _enter_storey(self, tag: str) -> str:
        """The robot is on a storey: a lift has taken it there."""
        if not isinstance(self._localizer, Localizer):
            raise InputError(f'map_tag: slam is {self._config.slam}: expected {SCAN_MATCHING}')
        self._localizer.enter_storey(tag)
        here = 'the map is' if self._localizer.map_tag == tag else 'a piece of map apart is'
        return f'{here} of {quoted(tag)}'

    def _on_new_map(self) -> None:
        """Localize in the map that topic map has brought."""
        self._localizer = self._given.with_new_map(self._localizer)

    def _on_topology(self, message: TopologicalMap) -> None:
        self._topology = topology_from_msg(message)
        self._localizer.set_topology(self._topology)

    def _process(self, ready: list[tuple[Scan, Array]]) -> None:
        for scan, T_odom_base in ready:
            try:
                self._step(scan, T_odom_base)
            except InputError:
                raise
            except Exception as error:
                self.step_failed(f'scan at {scan.stamp_ns} ns', error)
        self._report_warnings()
        diagnostics = self.diagnostics
        diagnostics.set_drop_total('scans without odometry at their time', self._pairing.dropped)
        discarded = self._pairing.discarded_odometry
        diagnostics.set_drop_total('odometry with stamps ahead of those after it', discarded)
        diagnostics.set_drop_total('invalid scans or odometry', self._localizer.rejected)

    def _report_unpaired(self) -> None:
        """Report on /diagnostics why scans were not paired with odometry."""
        reasons = [f'{n} {reason}' for reason, n in self._pairing.reasons().items()]
        if reasons:
            self.diagnostics.set_value('scans without odometry', '; '.join(reasons))

    def _step(self, scan: Scan, T_odom_base: Array) -> None:
        """Localize a scan, and publish its pose."""
        self._resume(scan, T_odom_base)
        started = perf_counter()
        estimate = self._localizer.step(scan, T_odom_base)
        estimate = self._consistency.checked(scan, T_odom_base, estimate)
        self._pairing.add_estimate(scan, estimate)
        step_ms = 1000.0 * (perf_counter() - started)
        self._publish(scan, estimate, step_ms)
        if estimate.odometry_discontinuity:
            self.get_logger().warning(
                f'{estimate.odometry_discontinuity}: the motion of the robot is unknown, and '
                'its pose follows from the scan alone'
            )
        if not estimate.is_lost:
            last = OdometryAnchor(scan.stamp_ns, estimate.T_map_odom, T_odom_base)
            self._recovery.last = last
        if estimate.correction is not None:
            self.checkpoint_now()

    @property
    def _warnings(self) -> dict[str, str]:
        """What scans and odometry contradict, by kind."""
        return self._pairing.warnings | self._consistency.warnings

    def _report_warnings(self) -> None:
        """Log each kind of warning once."""
        scale = self._consistency.odometry_scale.warning
        self.diagnostics.set_value(SCALE_KEY, scale)
        warnings = {kind: f'scan: {text}' for kind, text in self._warnings.items()}
        for kind, text in (warnings | {SCALE_KEY: scale}).items():
            if text and kind not in self._reported:
                self.get_logger().warning(text)
                self._reported.add(kind)

    def _on_living_map(self, message: ProbabilityGrid) -> None:
        """Continue in a map whose mapper has outlived a localizer, rather than begin another one.

        Only the first grid of a known map counts.
        """
        if message.map_id == UNKNOWN:
            return
        try:
            patch = messages.grid_from_msg(message)
        except InputError as error:
            self.get_logger().warning(f'grid: {error}')
            return
        self.destroy_subscription(self._living)
        if message.map_id == self._map_id or self._is_map_given:
            return
        if not isinstance(self._config, LocalizerConfig):
            return  # a map of line features cannot be made of a grid
        self.get_logger().warning(
            'grid is of a map that another localizer has begun: lost in that map until '
            'scans on the way confirm the start pose, or a pose is given'
        )
        # The robot has driven since it was at the start pose: a room may fit there by chance.
        self._localizer = Localizer.in_occupancy_map(patch, self._config, is_guess=True)
        self._recovery.awaited = None
        self._map_id = message.map_id

    def _resume(self, scan: Scan, T_odom_base: Array) -> None:
        """Continue where the killed localizer was; at the start pose if the odometry was reset."""
        last = self._recovery.awaited
        if last is None or not self._given.has_map:
            return
        self._recovery.awaited = None
        if last.is_continuous_with(scan.stamp_ns, T_odom_base):
            self._localizer.resume(last, T_odom_base)
            return
        self.get_logger().warning('odometry was reset: starting at the initial pose')
        if scan.stamp_ns < last.stamp_ns:
            # So was the robot, with all that made the map.
            self._localizer = self._given.first_localizer()

    def _save(self, path: str, overwrite: bool = False) -> str:
        return f'saved {save_localizer(path, self._localizer, overwrite)}'

    def _save_at_end(self, path: str) -> str:
        return self._save(path) if self._has_own_map else ''

    def _check(self, path: str) -> str:
        return 'no map of the localizer' if self._read(path) is None else 'a map'

    def _read(self, path: str) -> AnyLocalizer | None:
        """Localizer in a saved map, at the present pose; None where there is no such map."""
        here = config_at(self._localizer.config, self._localizer.pose)
        config = replace(here, has_start=False)  # nobody has said that it is the pose in that map
        folder = self._save_directory
        return load_localizer(folder.resolve(path), config, folder.path, self.get_logger().warning)

    def _load(self, path: str) -> str:
        """Replace the map by that of a session, or by any map_server map; lost until scans fit."""
        loaded = self._read(path)
        if loaded is None:
            return 'the session has no map of the localizer: it keeps its own'
        self._localizer = loaded
        self._recovery = Recovery()
        self._given.has_loaded = True
        self._begin_map(replaced_id=UNKNOWN)
        if self._topology is not None:
            loaded.set_topology(self._topology)
        features = loaded.features
        return f'{len(features)} line features loaded' if features else 'local map loaded'

    def _publish(self, scan: Scan, estimate: Estimate, step_ms: float) -> None:
        state = _state_of(estimate) if self._given.has_map else SlamStatus.NO_MAP
        self.diagnostics.record_step_time('localizer', step_ms)
        self.diagnostics.set_state(*_health(state, estimate))
        if estimate.correction is not None:
            stamps, poses = self._localizer.keyframe_trajectory()
            self._corrected_ns = scan.stamp_ns
            self._trajectory.publish(
                messages.trajectory_msg(stamps.tolist(), poses, self._map_frame, scan.stamp_ns)
            )
            self.get_logger().info(_correction_line(estimate.correction, len(poses)))
        if state != SlamStatus.NO_MAP:
            self._broadcaster.update(estimate.T_map_odom)
        self._given.publish(scan.odometry_ns, estimate, state)
        # At its stamp by the clock of the odometry, with which others take it on.
        self._pose.publish(messages.estimate_msg(estimate, self._map_frame, scan.odometry_ns))
        features = self._localizer.features
        apart = estimate.apart
        status = SlamStatus(
            header=messages.header(self._map_frame, scan.stamp_ns),
            state=state,
            apart_m=0.0 if apart is None else apart.path_m,
            join_odds=0.0 if apart is None else apart.odds,
            is_contradicted=estimate.is_contradicted,
            features=len(features),
            local_features=estimate.n_local_features,
            observed=estimate.observed_lines,
            matched=estimate.matched_lines,
            rejected=self._localizer.rejected,
            no_return_is_unknown=scan.drops_out,
            inlier_ratio=estimate.inlier_ratio,
            step_time_ms=step_ms,
            map_id=self._map_id,
            replaced_map_id=self._replaced_id,
        )
        self._published_id = self._map_id
        lines = [_feature_msg(feature) for feature in features]
        self._features.publish(LineFeatureArray(header=status.header, features=lines))
        self._status.publish(status)
        self._scan.publish(
            localized_scan_msg(scan, estimate, status, self._map_frame, self._corrected_ns)
        )
        if self._config.is_mapping:
            self._keyframes.publish(scan.stamp_ns, self._localizer, self._map_id)


def _state_of(estimate: Estimate) -> int:
    """State of a SlamStatus; of a blind laser it is unknown whether the robot is lost.

    A tilted robot drives on: it would never leave its ramp.
    """
    if estimate.blind_reason and estimate.blind_reason != TILTED:
        return int(SlamStatus.BLIND)
    if estimate.mount_fault:
        return int(SlamStatus.MISALIGNED)
    if estimate.is_mapping_apart:
        return int(SlamStatus.MAPPING_APART)
    return int(SlamStatus.LOST if estimate.is_lost else SlamStatus.TRACKING)


def _health(state: int, estimate: Estimate) -> tuple[bytes, str]:
    """Level and text for /diagnostics."""
    if state == SlamStatus.BLIND:
        return ERROR, f'laser blind ({estimate.blind_reason}): dead reckoning'
    if state == SlamStatus.MISALIGNED:
        return ERROR, f'laser misaligned: {estimate.mount_fault}'
    if estimate.blind_reason == TILTED:
        return WARN, f'{TILTED}: dead reckoning'
    if estimate.apart is not None and state == SlamStatus.MAPPING_APART:
        return ERROR, (
            f'lost: maps a piece apart, {estimate.apart.path_m:.0f} m, best odds '
            f'{_odds(estimate.apart.odds)}: expected a way through known places, or a pose on '
            'initialpose'
        )
    return _HEALTH[state]


def _correction_line(correction: Correction, poses: int) -> str:
    join = correction.join
    if join is None:
        return f'loop closed: {poses} keyframe poses corrected'
    x, y, yaw = join.T.tolist()
    return (
        f'a piece of map of {join.path_m:.0f} m is joined: moved by x {x:.2f} m, y {y:.2f} m, '
        f'yaw {yaw:.3f} rad, odds {_odds(math.exp(join.log_odds))}, {join.links} matches; {poses} '
        'keyframe poses corrected'
    )


def _odds(odds: float) -> str:
    """Odds as people say them: 12:1, or 1:30."""
    if odds <= 0.0:
        return 'none'
    return f'{odds:.3g}:1' if odds >= 1.0 else f'1:{1.0 / odds:.3g}'


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


main = node_main.program(LocalizerNode)

if __name__ == '__main__':
    main()
