"""A topological map built anew after a loop closure, with grid and poses heard of in turn."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.history import PoseHistory
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.update import TopologyBuilder

_PATIENCE = 100  # windows after which a grid that does not come is waited for no longer


class Rebuilding:
    """What is needed for it: where the robot has been, and which correction the grid has undergone.

    Between the news of a correction and the grid that has undergone it nothing is taken into the
    graph, nor are windows that were cut out of the grid before: they would be drawn over what is
    right.
    """

    def __init__(self, from_the_start: bool = True) -> None:
        """from_the_start: whether the graph begins here.

        All poses from which it was seen then become known.
        """
        self._past = PoseHistory() if from_the_start else None
        self._awaited: tuple[int, NDArray[np.int64], Array] | None = None
        self._waited = 0
        # The newest window, and stamps of the corrections that its grid,
        # and one that is out of date, had undergone.
        self._window: GridPatch | None = None
        self._window_ns = 0
        self._stale_ns: int | None = None

    def window(self, window: GridPatch, corrected_ns: int) -> None:
        """Take note of a window, and of the stamp of the correction that its grid had undergone."""
        self._window, self._window_ns = window, corrected_ns
        if corrected_ns != self._stale_ns:
            self._stale_ns = None

    def may_take(self) -> bool:
        """Whether the newest window may go into the graph."""
        if self._awaited is not None:
            self._waited += 1
            self._awaited = None if self._waited > _PATIENCE else self._awaited
        return self._awaited is None and self._window_ns != self._stale_ns

    def took(self, stamp_ns: int, T_map_base: Array) -> None:
        """Take note of the pose (3,) of a scan."""
        if self._past is not None:
            self._past.add(stamp_ns, T_map_base)

    def expect(self, corrected_ns: int, stamps_ns: NDArray[np.int64], poses: Array) -> None:
        """Hear of a correction: the scans of these stamps (M,) were made at poses (M, 3)."""
        self._awaited, self._waited = (corrected_ns, stamps_ns, poses), 0
        self._stale_ns = self._window_ns if self._window_ns != corrected_ns else None

    def waits_for(self, corrected_ns: int) -> bool:
        """Whether it is a grid with this correction that is waited for."""
        return self._awaited is not None and corrected_ns == self._awaited[0]

    def rebuild(self, builder: TopologyBuilder, patch: GridPatch) -> None:
        """Build the graph anew from the grid that has undergone the correction."""
        if self._awaited is None or self._window is None:
            return
        corrected_ns, stamps_ns, poses = self._awaited
        self._awaited = None
        # Of a graph that began elsewhere nobody knows from where it was seen: nodes are looked for
        # where they were.
        before = after = poses
        if self._past is not None:
            before = self._past.poses()
            self._past.correct(stamps_ns, poses, since_ns=corrected_ns)
            after = self._past.poses()
        grid = OccupancyGrid.from_patch(patch, OccupancyConfig(resolution_m=patch.frame.resolution))
        size_m = self._window.shape[0] * patch.frame.resolution
        builder.rebuild(lambda x, y: grid.window(x, y, size_m), before, after)
