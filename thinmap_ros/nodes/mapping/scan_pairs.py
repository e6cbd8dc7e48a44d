"""Scans with the pose and the status that the localizer found for them."""

from typing import NamedTuple

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from thinmap_msgs.msg import SlamStatus
from thinmap_ros.core.estimate import Placement
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stamp_matcher import StampMatcher
from thinmap_ros.ros import messages
from thinmap_ros.ros.decoding.map_identity import UNKNOWN


class LocatedScan(NamedTuple):
    """A scan and the pose T_map_base (3,) at which it was made.

    drops_out: whether its beams without return show no free space; map_id, replaced_map_id: of the
    map that the pose is in, and of the one before it.
    """

    message: LaserScan
    T_map_base: Array
    placement: Placement = Placement.MAP
    drops_out: bool = False
    map_id: int = UNKNOWN
    replaced_map_id: int = UNKNOWN


class ScanPairs:
    """Pairs each scan with its pose and, where a localizer publishes it, its status.

    A localizer that publishes the scans that it has localized, corrected for motion, is preferred
    to the laser. A pose of a lost robot, or of one without a map, belongs to no place in the map,
    that of one that maps apart to a piece beside it, and a blind scan observes nothing.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._scan_topic = node.resolve_topic_name('localized_scan')
        self._status_topic = node.resolve_topic_name('slam_status')
        self._poses: StampMatcher[LaserScan, Array] = StampMatcher()
        self._states: StampMatcher[LocatedScan, SlamStatus] = StampMatcher()

    @property
    def dropped(self) -> int:
        """Number of scans, poses and states without a partner."""
        return self._poses.dropped + self._states.dropped

    def add_scan(self, message: LaserScan) -> LocatedScan | None:
        """Add a scan of the laser; returns a scan with its pose once that is complete."""
        is_localized = self._node.count_publishers(self._scan_topic) > 0
        return None if is_localized else self.add_localized_scan(message)

    def add_localized_scan(self, message: LaserScan) -> LocatedScan | None:
        """Add a scan as the localizer has used it."""
        ns = messages.stamp_ns(message.header.stamp)
        return self._with_state(ns, self._poses.add_left(ns, message))

    def add_pose(self, message: PoseWithCovarianceStamped) -> LocatedScan | None:
        """Add a pose."""
        ns = messages.stamp_ns(message.header.stamp)
        T_map_base = messages.pose_from_msg(message.pose.pose)
        return self._with_state(ns, self._poses.add_right(ns, T_map_base))

    def add_status(self, message: SlamStatus) -> LocatedScan | None:
        """Add a status."""
        return _complete(self._states.add_right(messages.stamp_ns(message.header.stamp), message))

    def _with_state(self, ns: int, pair: tuple[LaserScan, Array] | None) -> LocatedScan | None:
        if pair is None:
            return None
        located = LocatedScan(*pair)
        if self._node.count_publishers(self._status_topic) == 0:
            return located
        return _complete(self._states.add_left(ns, located))


def _complete(found: tuple[LocatedScan, SlamStatus] | None) -> LocatedScan | None:
    if found is None:
        return None
    located, status = found
    return located._replace(
        placement=_placement(status),
        drops_out=status.no_return_is_unknown,
        map_id=status.map_id,
        replaced_map_id=status.replaced_map_id,
    )


def _placement(status: SlamStatus) -> Placement:
    if status.state == SlamStatus.MAPPING_APART:
        return Placement.APART
    if status.state != SlamStatus.TRACKING:
        return Placement.NOWHERE
    return Placement.OPEN if status.is_contradicted else Placement.MAP
