"""Scans of a piece of map that is apart, until it is joined."""

from typing import Any

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array
from thinmap_ros.logs import decode

_STEP_M = 0.5


class ApartScans:
    """Points of the scans of a piece of map that is apart, a step between them.

    points (N, 2): where dead reckoning puts them, m; none once the piece is joined.
    """

    def __init__(self) -> None:
        self.points = np.empty((0, 2))
        self._last: Array | None = None

    def update(self, message: Any) -> bool:
        """Add the scan of a LocalizedScan, or forget all; returns whether the points changed."""
        if message.status.state != message.status.MAPPING_APART:
            was_apart = self._last is not None
            self.points = np.empty((0, 2))
            self._last = None
            return was_apart
        T_map_base = decode.checked_pose(message.pose.pose)
        if self._last is not None and np.hypot(*(T_map_base - self._last)[:2]) < _STEP_M:
            return False
        self._last = T_map_base
        ns = decode.stamp_ns(message)
        scan = decode.scan(message.scan, ns, decode.pose(message.laser_pose))
        here = se2.transform_points(T_map_base, scan.points_base())
        self.points = np.vstack([self.points, here])
        return True
