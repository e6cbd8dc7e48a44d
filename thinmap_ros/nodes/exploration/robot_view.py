"""What a robot sees of a map that somebody else makes, and from where: by TF and scans."""

from collections import deque
from functools import cached_property

from sensor_msgs.msg import LaserScan

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridPatch, scan_in_map
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.nodes.parts.mission import ExplorationSettings
from thinmap_ros.ros import messages
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.tf import TransformListener

_MAX_SCANS = 50
_MAX_SCAN_AGE_NS = 2 * SECOND_NS
_LOOKUP_STEP_NS = 20_000_000


class RobotView:
    """Newest scan whose pose in the map TF knows, and that pose.

    Without scans, what the map shows around the robot stands for one.
    """

    def __init__(
        self,
        node: ThinmapNode,
        settings: ExplorationSettings,
        map_frame: str,
        laser_transform: LaserTransform,
    ) -> None:
        self._settings = settings
        self._map_frame = map_frame
        self._laser_transform = laser_transform
        self._node = node
        self._scans: deque[LaserScan] = deque(maxlen=_MAX_SCANS)

    def reset(self) -> None:
        """Discard the scans."""
        self._scans.clear()

    def add_scan(self, message: LaserScan) -> None:
        """Keep a scan until its pose is known."""
        self._scans.append(message)

    def look(self, patch: GridPatch, now_ns: int) -> tuple[Scan, Array]:
        """Scan and pose (3,) in a map. Raises InputError where TF does not know the pose."""
        for message in reversed(self._scans):
            found = self._scan_at(message, now_ns)
            if found is not None:
                return found
        T_map_base = self.newest_pose(now_ns)
        return scan_in_map(patch, T_map_base, self._settings.view_range_m, now_ns), T_map_base

    @cached_property
    def _transforms(self) -> TransformListener:
        """From the first look on: each transform costs time, and most explorations need none."""
        return TransformListener(self._node)

    def _scan_at(self, message: LaserScan, now_ns: int) -> tuple[Scan, Array] | None:
        try:
            stamp_ns = messages.stamp_ns(message.header.stamp)
            if abs(now_ns - stamp_ns) > _MAX_SCAN_AGE_NS:
                return None
            T_map_base = self._lookup(stamp_ns)
            scan = self._laser_transform.to_scan(message)
        except InputError:
            return None
        return None if scan.is_blind else (scan, T_map_base)

    def newest_pose(self, now_ns: int) -> Array:
        """Newest pose (3,) that is not too old. Raises InputError where TF knows none."""
        reason: InputError | None = None
        tolerance_ns = round(self._settings.transform_tolerance * SECOND_NS)
        for age_ns in range(0, tolerance_ns + 1, _LOOKUP_STEP_NS):
            try:
                return self._lookup(now_ns - age_ns)
            except InputError as error:
                reason = reason or error
        raise reason or InputError('transform_tolerance: expected at least 0 s')

    def _lookup(self, stamp_ns: int) -> Array:
        return self._transforms.lookup(self._map_frame, self._laser_transform.base_frame, stamp_ns)
