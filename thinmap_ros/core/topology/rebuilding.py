"""A topological map built anew after a loop was closed, where grid and poses are heard of one after the other."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.history import PoseHistory
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.update import TopologyBuilder


class Rebuilding:
    """What is needed for it: where the robot has been, and which correction the grid has undergone.

    Between the news of a correction and the grid that has undergone it, and of windows that were cut out of the grid
    before, nothing is taken into the graph: it would be drawn over what is right.
    """

    def __init__(self) -> None:
        self._past = PoseHistory()
        self._corrected_ns = 0
        self._awaited: tuple[NDArray[np.int64], Array] | None = None
        self._window: GridPatch | None = None
        self._window_is_right = True

    def window(self, window: GridPatch, corrected_ns: int) -> None:
        """Take note of a window, and of the stamp of the correction that its grid had undergone."""
        self._window, self._window_is_right = window, corrected_ns == self._corrected_ns

    def may_take(self, window: GridPatch) -> bool:
        """Whether a window may go into the graph."""
        return self._awaited is None and (window is not self._window or self._window_is_right)

    def took(self, stamp_ns: int, T_map_base: Array) -> None:
        """Take note of the pose (3,) of a scan."""
        self._past.add(stamp_ns, T_map_base)

    def expect(self, corrected_ns: int, stamps_ns: NDArray[np.int64], poses: Array) -> None:
        """Hear of a correction: the scans of these stamps (M,) were made at poses (M, 3)."""
        self._corrected_ns, self._awaited = corrected_ns, (stamps_ns, poses)

    def waits_for(self, corrected_ns: int) -> bool:
        """Whether it is a grid with this correction that is waited for."""
        return self._awaited is not None and corrected_ns == self._corrected_ns

    def rebuild(self, builder: TopologyBuilder, patch: GridPatch) -> None:
        """Build the graph anew from the grid that has undergone the correction."""
        if self._awaited is None or self._window is None:
            return
        before = self._past.poses()
        self._past.correct(*self._awaited, since_ns=self._corrected_ns)
        self._awaited = None
        grid = OccupancyGrid.from_patch(patch, OccupancyConfig(resolution_m=patch.frame.resolution))
        size_m = self._window.shape[0] * patch.frame.resolution
        builder.rebuild(lambda x, y: grid.window(x, y, size_m), before, self._past.poses())
