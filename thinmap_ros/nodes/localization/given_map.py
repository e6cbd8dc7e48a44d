"""Localization in a given map: what the localizer does besides mapping."""

from dataclasses import replace

from thinmap_msgs.msg import SlamStatus
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.localizer import AnyLocalizer
from thinmap_ros.core.stage import Estimate, StartConfig
from thinmap_ros.nodes.localization.amcl_interface import AmclInterface
from thinmap_ros.nodes.localization.config import GIVEN_COVARIANCE, LocalizationConfig
from thinmap_ros.nodes.localization.initial_poses import InitialPoses
from thinmap_ros.nodes.localization.known_area import require_near_map
from thinmap_ros.nodes.localization.last_pose import LastPose
from thinmap_ros.nodes.localization.map_source import MapSource
from thinmap_ros.ros import parameters
from thinmap_ros.ros.lifecycle_node import ThinmapNode

_WARN_PERIOD_S = 30.0


class GivenMap:
    """The given map, the poses to start from, and AMCL's interface; in mode mapping, a session.

    config: of the next localizer.
    """

    def __init__(self, node: ThinmapNode, config: StartConfig) -> None:
        """Declare the parameters. Raises ConfigError or InputError as `MapSource`."""
        self._node = node
        self.config = config
        self._settings = parameters.declare_config(node, LocalizationConfig)
        report = node.get_logger().warning
        session = parameters.declare_session(node)
        self.source = MapSource(config, self._settings, session, report)
        self._last_pose = LastPose(
            node, self._settings.pose_file, self._settings.save_pose_rate, self.source.name
        )
        node.add_end_callback(self._last_pose.save_latest)
        self._amcl: AmclInterface | None = None
        self._given_covariance: Array | None = None  # of an initial pose without a map

    def create_interface(self, map_frame: str, poses: InitialPoses) -> None:
        """Offer AMCL's topics and services in mode localization."""
        if not self.config.is_mapping:
            self._amcl = AmclInterface(self._node, map_frame, poses.add_pose)

    def create_localizer(self) -> AnyLocalizer:
        """A localizer at the start pose.

        It is initial_pose where set, else the start pose where it is not 0, else the last pose.
        """
        self._given_covariance = None
        config = self.config
        if config.is_mapping:
            return self.source.create_localizer(config)
        if self._settings.set_initial_pose:
            T_map_base = self._settings.initial_pose.pose
            return self._placed(T_map_base, GIVEN_COVARIANCE)
        if config.is_start_given:
            return self.source.create_localizer(config)
        last = self._last_pose.load()
        if last is None:
            return self.source.create_localizer(config)
        x, y, yaw = last.tolist()
        self._node.get_logger().info(f'last pose: {x:.2f}, {y:.2f} m, {yaw:.2f} rad')
        return self.create_localizer_at(last)

    def create_localizer_at(self, T_map_base: Array) -> AnyLocalizer:
        """A localizer at a pose (3,); in a given map it is delocalized until scans fit."""
        return self.source.create_localizer(config_at(self.config, T_map_base))

    def with_new_map(self, localizer: AnyLocalizer) -> AnyLocalizer:
        """The localizer that follows another one in a map from its topic."""
        settings = self._settings
        covariance = self._given_covariance
        self._given_covariance = None
        if covariance is not None:
            placed = self._placed(localizer.pose, covariance)
            if self._is_near_map(placed):
                return placed
        is_first = self._amcl is None or not self._amcl.has_published
        if is_first or (settings.set_initial_pose and settings.always_reset_initial_pose):
            return self.create_localizer()
        return self.create_localizer_at(localizer.pose)

    def pose_set(self, covariance: Array) -> None:
        """A user has given a pose, with a covariance (3, 3)."""
        if not self.source.has_map:
            self._given_covariance = covariance

    def publish(self, stamp_ns: int, estimate: Estimate, state: int) -> None:
        """Publish the estimate of a scan with AMCL's interface, and save the pose if known."""
        if self._amcl is None:
            return
        logger = self._node.get_logger()
        if state == SlamStatus.NO_MAP:
            text = 'no map: waits for topic map'
            logger.warning(text, throttle_duration_sec=_WARN_PERIOD_S)
            return
        self._amcl.publish(stamp_ns, estimate)
        if state == SlamStatus.TRACKING:
            self._last_pose.save(estimate.T_map_base)
        elif state == SlamStatus.LOST:
            text = 'lost: waits for initialpose, a global localization, or a scan that matches'
            logger.warning(text, throttle_duration_sec=_WARN_PERIOD_S)

    def _is_near_map(self, placed: AnyLocalizer) -> bool:
        """Whether the pose that a user gave before there was a map lies near it."""
        try:
            require_near_map(placed.pose, placed)
        except InputError as error:
            self._node.diagnostics.message_rejected('initialpose', str(error))
            self._node.get_logger().warning(f'initialpose: {error}')
            return False
        return True

    def _placed(self, T_map_base: Array, covariance: Array) -> AnyLocalizer:
        localizer = self.create_localizer_at(T_map_base)
        localizer.set_pose(T_map_base, covariance)
        return localizer


def config_at(config: StartConfig, T_map_base: Array) -> StartConfig:
    """The configuration with a start pose (3,)."""
    x, y, yaw = T_map_base.tolist()
    return replace(config, initial_x_m=x, initial_y_m=y, initial_yaw_rad=yaw)
