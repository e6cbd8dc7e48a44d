"""Scans with the pose that the localizer found for them, from it to the mapper and beyond."""

from dataclasses import dataclass, field, replace
from time import monotonic
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovariance, PoseWithCovarianceStamped
from rclpy.node import Node

from thinmap_msgs.msg import LocalGrid, LocalizationStatus, SlamStatus, TopologicalMap
from thinmap_msgs.msg import LocalizedScan as LocalizedScanMsg
from thinmap_ros.core.errors import ConfigError, InputError
from thinmap_ros.core.grid.mapper import MapUpdate
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.stage import Destination, Estimate, LocalizedScan
from thinmap_ros.logs import decode
from thinmap_ros.ros import messages, qos


@dataclass(frozen=True, eq=False)
class ReceivedScan(LocalizedScan):
    """A localized scan with the message that it came in.

    corrected_ns: stamp of the newest trajectory that the pose follows; 0: none yet.
    """

    corrected_ns: int = 0
    message: LocalizedScanMsg = field(default_factory=LocalizedScanMsg)

    @property
    def is_blind(self) -> bool:
        """Whether the laser shows nothing of what is around the robot."""
        is_useless = self.message.status.state in (SlamStatus.BLIND, SlamStatus.MISALIGNED)
        return bool(is_useless or self.scan.is_blind)


def localized_scan_msg(
    scan: Scan, estimate: Estimate, status: SlamStatus, frame_id: str, corrected_ns: int = 0
) -> LocalizedScanMsg:
    """Message of a scan, its estimate and its status; corrected_ns as in `ReceivedScan`."""
    T_map_base = messages.estimate_msg(estimate, frame_id, scan.stamp_ns)
    return LocalizedScanMsg(
        header=T_map_base.header,
        scan=messages.scan_msg(scan, scan.frame, scan.scan_time_s),
        max_range_m=scan.max_range_m,
        zero_is_no_return=scan.zero_is_no_return,
        laser_pose=messages.pose_msg(scan.T_base_laser),
        pose=PoseWithCovariance(pose=T_map_base.pose.pose, covariance=T_map_base.pose.covariance),
        status=status,
        correction_stamp=messages.time_msg(corrected_ns),
    )


def localized_scan_from_msg(message: LocalizedScanMsg) -> ReceivedScan:
    """Scan of a message.

    Raises InputError where scan, pose or a stamp is invalid, and where a number that is no range is
    not finite.
    """
    _require_finite(message)
    scan = decode.scan(
        message.scan,
        messages.stamp_ns(message.header.stamp),
        messages.pose_from_msg(message.laser_pose),
        _laser(message),
    )
    return ReceivedScan(
        replace(scan, drops_out=message.status.no_return_is_unknown),
        messages.pose_from_msg(message.pose.pose),
        _destination(message.status),
        corrected_ns=messages.stamp_ns(message.correction_stamp),
        message=message,
    )


def _destination(status: SlamStatus) -> Destination:
    """Where the scan belongs: nowhere if the robot is lost, or the laser shows nothing."""
    if status.state == SlamStatus.MAPPING_APART:
        return Destination.APART
    if status.state != SlamStatus.TRACKING:
        return Destination.NOWHERE
    return Destination.OPEN if status.is_contradicted else Destination.MAP


def map_update_from_msg(message: LocalGrid) -> MapUpdate:
    """Scan and window of a message. Raises InputError where one of them is invalid."""
    return MapUpdate(
        localized_scan_from_msg(message.localized),
        messages.grid_from_msg(message.grid),
        messages.stamp_ns(message.grid.correction_stamp),
        message.is_rerendering,
    )


def _require_finite(message: LocalizedScanMsg) -> None:
    """Raise InputError unless poses, covariance and status are finite: others receive them, too."""
    status = message.status
    numbers = [*message.pose.covariance, status.inlier_ratio, status.step_time_ms]
    numbers += [status.apart_m, status.join_odds]
    for pose in (message.pose.pose, message.laser_pose):
        at = pose.position
        turn = pose.orientation
        numbers += [at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w]
    if not np.isfinite(numbers).all():
        raise InputError('localized scan: a number is not finite: expected a pose, and its status')


def _laser(message: LocalizedScanMsg) -> LaserConfig:
    try:
        return LaserConfig(
            max_range_m=message.max_range_m, zero_is_no_return=message.zero_is_no_return
        )
    except ConfigError as error:
        raise InputError(str(error)) from error


NONE = 'none'
_POSE = 'pose'
_TYPES: dict[str, Any] = {
    _POSE: PoseWithCovarianceStamped,
    'local_grid': LocalGrid,
    'local_topology': TopologicalMap,
    'localization_status': LocalizationStatus,
}
TOPICS = (NONE, *_TYPES)
# Long: a busy machine, or one that compiles kernels, still publishes a result.
TIMEOUT_S = 10.0
TIMEOUT_DESCRIPTION = 'Time after which lockstep continues without a result (s, machine time).'


class Lockstep:
    """Waits, after each scan, for its result: the message of a topic with the stamp of the scan."""

    def __init__(
        self, node: Node, topic: str, timeout_s: float = TIMEOUT_S, prefix: str = ''
    ) -> None:
        """prefix: of the topic of one of several robots, with a slash."""
        self._node = node
        self._topic = topic
        self._name = f'{prefix}{topic}'
        self._timeout_s = timeout_s
        self._awaited_ns: int | None = None
        self._since = 0.0
        if topic != NONE:
            node.create_subscription(_TYPES[topic], self._name, self._on_message, qos.STREAM)
        if topic == _POSE:
            # Of a scan with a delay, the pose is stamped earlier.
            status = f'{prefix}slam_status'
            node.create_subscription(SlamStatus, status, self._on_message, qos.STREAM)

    def scan_published(self, stamp_ns: int) -> None:
        """Wait for the result of a scan that was published, and of those before it."""
        if self._topic != NONE:
            self._awaited_ns = max(stamp_ns, self._awaited_ns or stamp_ns)
            self._since = monotonic()

    @property
    def is_waiting(self) -> bool:
        """Whether the result of the last scan is missing."""
        return self._awaited_ns is not None

    @property
    def waited_s(self) -> float:
        """Time since the last scan was published, s of the machine."""
        return monotonic() - self._since

    def timed_out(self) -> bool:
        """Whether the result has been missing for too long; waiting then ends."""
        if self.waited_s < self._timeout_s:
            return False
        self._node.get_logger().warning(
            f'no /{self._name} for the last scan: continuing without it'
        )
        self._awaited_ns = None
        return True

    def _on_message(self, message: Any) -> None:
        if (
            self._awaited_ns is not None
            and messages.stamp_ns(message.header.stamp) >= self._awaited_ns
        ):
            self._awaited_ns = None
