"""A topological map rebuilt after a loop closure, whose grid and poses come one after the other."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.scan_history import CorrectedPoses, PoseHistory
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.builder import TopologyBuilder

# Windows after which a grid that does not come is awaited no longer. A re-rendering takes some tens
# of windows, in a large building some hundreds.
_PATIENCE = 1000


class Rebuilding:
    """What is needed for it: where the robot has been, and which correction the grid has undergone.

    Between a correction and the grid that has undergone it the graph accepts no windows, nor after
    that any that were cut out of the grid before: they would replace what is right.
    """

    def __init__(self, from_the_start: bool = True) -> None:
        """from_the_start: whether the graph begins here.

        All poses from which it was seen then become known.
        """
        self._past: PoseHistory[None] | None = PoseHistory() if from_the_start else None
        # Stamp of the correction whose grid is awaited, and the poses that came with it.
        self._awaited: tuple[int, Array] | None = None
        self._waited = 0
        # The newest window, and stamps of the corrections that its grid,
        # and one that is out of date, had undergone.
        self._window: GridPatch | None = None
        self._window_ns = 0
        self._stale_ns: int | None = None

    def window(self, window: GridPatch, corrected_ns: int) -> None:
        """Take note of a window, and of the stamp of the correction that its grid had undergone."""
        self._window = window
        self._window_ns = corrected_ns
        if corrected_ns != self._stale_ns:
            self._stale_ns = None

    def accepts_window(self) -> bool:
        """Whether the newest window may go into the graph."""
        if self._awaited is not None:
            self._waited += 1
            self._awaited = None if self._waited > _PATIENCE else self._awaited
        return self._awaited is None and self._window_ns != self._stale_ns

    def add_pose(self, stamp_ns: int, T_map_base: Array) -> None:
        """Add the pose (3,) of a scan."""
        if self._past is not None:
            self._past.add_pose(stamp_ns, T_map_base, None)

    def correct(self, corrected_ns: int, stamps_ns: NDArray[np.int64], poses: Array) -> None:
        """Follow a correction: the scans of these stamps (M,) were made at poses (M, 3)."""
        if self._past is not None:
            self._past.apply_correction(stamps_ns, poses, since_ns=corrected_ns)
        self._awaited = (corrected_ns, poses)
        self._waited = 0
        self._stale_ns = self._window_ns if self._window_ns != corrected_ns else None

    def awaits(self, corrected_ns: int) -> bool:
        """Whether the grid that has undergone this correction is awaited."""
        return self._awaited is not None and corrected_ns == self._awaited[0]

    def rebuild(self, builder: TopologyBuilder, patch: GridPatch) -> None:
        """Rebuild the graph from the grid that has undergone the correction."""
        if self._awaited is None or self._window is None:
            return
        _, poses = self._awaited
        self._awaited = None
        # Of a graph that began elsewhere it is not known from where it was seen: its nodes are
        # searched for where they were.
        moved = CorrectedPoses(poses, poses)
        if self._past is not None:
            moved = self._past.accept_corrections()
        grid = OccupancyGrid.from_patch(patch, OccupancyConfig(resolution_m=patch.frame.resolution))
        size_m = self._window.shape[0] * patch.frame.resolution
        builder.rebuild(lambda x, y: grid.window(x, y, size_m), *moved)
