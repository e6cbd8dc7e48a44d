"""Scans with the pose and the status that the localizer found for them."""

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from thinmap_msgs.msg import SlamStatus
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stamp_matcher import StampMatcher
from thinmap_ros.ros import messages


class ScanPairs:
    """Pairs each scan with its pose and, where a localizer publishes it, its status.

    A pose of a lost robot, or of one without a map, belongs to no place in the map, and a blind
    scan observes nothing.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._status_topic = node.resolve_topic_name('slam_status')
        self._poses: StampMatcher[LaserScan, Array] = StampMatcher()
        self._states: StampMatcher[tuple[LaserScan, Array], int] = StampMatcher()

    @property
    def dropped(self) -> int:
        """Number of scans, poses and states without a partner."""
        return self._poses.dropped + self._states.dropped

    def add_scan(self, message: LaserScan) -> tuple[LaserScan, Array, bool] | None:
        """Add a scan; returns scan, T_map_base (3,), whether it is known, once complete."""
        ns = messages.stamp_ns(message.header.stamp)
        return self._with_state(ns, self._poses.add_left(ns, message))

    def add_pose(self, message: PoseWithCovarianceStamped) -> tuple[LaserScan, Array, bool] | None:
        """Add a pose."""
        ns = messages.stamp_ns(message.header.stamp)
        T_map_base = messages.pose_from_msg(message.pose.pose)
        return self._with_state(ns, self._poses.add_right(ns, T_map_base))

    def add_status(self, message: SlamStatus) -> tuple[LaserScan, Array, bool] | None:
        """Add a status."""
        return _complete(
            self._states.add_right(messages.stamp_ns(message.header.stamp), message.state)
        )

    def _with_state(
        self, ns: int, pair: tuple[LaserScan, Array] | None
    ) -> tuple[LaserScan, Array, bool] | None:
        if pair is None:
            return None
        if self._node.count_publishers(self._status_topic) == 0:
            return *pair, True
        return _complete(self._states.add_left(ns, pair))


def _complete(
    found: tuple[tuple[LaserScan, Array], int] | None,
) -> tuple[LaserScan, Array, bool] | None:
    if found is None:
        return None
    pair, state = found
    return *pair, state == SlamStatus.TRACKING
