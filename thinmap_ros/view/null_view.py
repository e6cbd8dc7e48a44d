"""The interface of views, and a view that shows nothing."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap


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
