"""What can be told to a view, whoever shows it."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap


class NullView:
    """What a view is told, shown to nobody.

    Each call gives the stamp in ns; poses (3,) and points are in the map frame, m and rad.
    """

    def grid(self, ns: int, patch: GridPatch) -> None:
        """Show the map."""

    def scan(self, ns: int, scan: Scan) -> None:
        """Show a scan where the robot is; it replaces the one before."""

    def pose(self, ns: int, T_map_base: Array, covariance: Array) -> None:
        """Show the robot with its covariance (3, 3) over x, y, theta.

        Its way becomes the trail `estimate`.
        """

    def trail(self, ns: int, name: str, T_map_base: Array) -> None:
        """Lengthen the trail of this name: `estimate`, `truth` or `odometry`."""

    def topology(self, ns: int, topology: TopologicalMap) -> None:
        """Show the skeleton, and the nodes coloured by kind."""

    def end_nodes(self, ns: int, places: Array, probabilities: Array) -> None:
        """Show end nodes at places (N, 2) with their position probabilities (N,), 0 to 1."""

    def lines(self, ns: int, segments: Array, local: NDArray[np.bool_]) -> None:
        """Show line features by their ends (N, 2, 2), and which (N,) are in the local area."""

    def local_area(self, ns: int, places: Array) -> None:
        """Show the nodes (N, 2) of the local area."""

    def samples(self, ns: int, places: Array) -> None:
        """Show where the samples (N, 2) of global localization are."""

    def plan(self, ns: int, points: Array) -> None:
        """Show the path (N, 2) that the robot follows."""

    def target(self, ns: int, place: Array | None) -> None:
        """Show where the robot is going, (2,), or that it has no target."""

    def number(self, ns: int, plot: str, curve: str, value: float) -> None:
        """Continue a curve of a plot (`error`, `progress`, `count`, `step`)."""

    def wait_until_closed(self) -> None:
        """Show all that was told until whoever looks at it has seen enough."""

    def close(self) -> None:
        """Finish what is shown or written."""
