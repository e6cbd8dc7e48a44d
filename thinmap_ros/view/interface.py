"""The interface of views, and what views share."""

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.logs import decode


class NullView:
    """A view that shows nothing, and the interface of all views.

    Stamps are in ns; poses (3,) and points are in the map frame, m and rad.
    """

    def grid(self, ns: int, patch: GridPatch) -> None:
        """Show the map."""

    def scan(self, ns: int, scan: Scan) -> None:
        """Show a scan at the pose of the robot; it replaces the previous scan."""

    def pose(self, ns: int, T_map_base: Array, covariance: Array) -> None:
        """Show the robot pose with its covariance (3, 3) over x, y, theta.

        The poses form the trajectory `estimate`.
        """

    def trajectory(self, ns: int, name: str, T_map_base: Array) -> None:
        """Extend a trajectory: `estimate`, `truth` or `odometry`."""

    def topology(self, ns: int, topology: TopologicalMap) -> None:
        """Show the skeleton, and the nodes coloured by kind."""

    def regions(self, ns: int, outlines: Sequence[Array], colours: Sequence[str]) -> None:
        """Show the outlines (K, 2) of regions in their colours, `#RRGGBB`."""

    def apart(self, ns: int, points: Array) -> None:
        """Show the scan points (N, 2) of pieces of map whose place is unknown."""

    def end_nodes(self, ns: int, places: Array, probabilities: Array) -> None:
        """Show end nodes at places (N, 2) with their position probabilities (N,), 0 to 1."""

    def lines(self, ns: int, segments: Array, local: NDArray[np.bool_]) -> None:
        """Show line features by their ends (N, 2, 2), and which (N,) are in the local area."""

    def local_area(self, ns: int, places: Array) -> None:
        """Show the nodes (N, 2) of the local area."""

    def particles(self, ns: int, places: Array) -> None:
        """Show the particles (N, 2) of global localization."""

    def plan(self, ns: int, points: Array) -> None:
        """Show the path (N, 2) that the robot follows."""

    def target(self, ns: int, place: Array | None) -> None:
        """Show the target (2,) of the robot, or remove it."""

    def scalar(self, ns: int, plot: str, curve: str, value: float) -> None:
        """Add a value to a curve of a plot (`error`, `progress`, `count`, `step`)."""

    def wait_until_closed(self) -> None:
        """Wait until the user closes the viewer."""

    def close(self) -> None:
        """Finish the recording."""


Left = TypeVar('Left')
Right = TypeVar('Right')


_WAITING = 50  # messages without a partner


class StampMatcher(Generic[Left, Right]):
    """Pairs the messages of two topics that carry exactly the same stamp, in any order.

    A message without a partner within fifty later messages is dropped and counted.
    """

    def __init__(self) -> None:
        self._lefts: OrderedDict[int, Left] = OrderedDict()
        self._rights: OrderedDict[int, Right] = OrderedDict()
        self.dropped = 0

    def add_left(self, stamp_ns: int, value: Left) -> tuple[Left, Right] | None:
        """Add a message of the first topic; returns its pair if that is complete."""
        partner = self._rights.pop(stamp_ns, None)
        if partner is not None:
            return value, partner
        self._keep(self._lefts, stamp_ns, value)
        return None

    def add_right(self, stamp_ns: int, value: Right) -> tuple[Left, Right] | None:
        """Add a message of the second topic; returns its pair if that is complete."""
        partner = self._lefts.pop(stamp_ns, None)
        if partner is not None:
            return partner, value
        self._keep(self._rights, stamp_ns, value)
        return None

    def _keep(self, waiting: OrderedDict[int, Any], stamp_ns: int, value: Any) -> None:
        waiting[stamp_ns] = value
        if len(waiting) > _WAITING:
            waiting.popitem(last=False)
            self.dropped += 1


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
