"""A topological map rebuilt after a loop closure, whose grid and poses come one after the other."""

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.map_mirror import MapMirror
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
    that any that were cut out of the grid before. The graph is rebuilt in a thread, so that no scan
    waits; windows that come meanwhile are added to the new graph.
    """

    def __init__(self, from_the_start: bool = True) -> None:
        """from_the_start: whether the graph begins here: all poses of it will be known."""
        self._past: PoseHistory[None] | None = PoseHistory() if from_the_start else None
        # Stamp of the correction whose grid is awaited, and the poses that came with it.
        self._awaited: tuple[int, Array] | None = None
        self._waited = 0
        # The newest window, and stamps of the corrections that its grid,
        # and one that is out of date, had undergone.
        self._window: GridPatch | None = None
        self._window_ns = 0
        self._stale_ns: int | None = None
        self._job: Future[TopologyBuilder] | None = None
        self._pending: list[tuple[GridPatch, Array]] = []

    def window(self, window: GridPatch, corrected_ns: int) -> None:
        """Record a window, and the stamp of the correction that its grid had undergone."""
        self._window = window
        self._window_ns = corrected_ns
        if corrected_ns != self._stale_ns:
            self._stale_ns = None

    def accepts_window(self) -> bool:
        """Whether the newest window may be added to the graph."""
        if self._awaited is not None:
            self._waited += 1
            self._awaited = None if self._waited > _PATIENCE else self._awaited
        return self._awaited is None and self._window_ns != self._stale_ns

    def update(
        self, builder: TopologyBuilder, window: GridPatch, T_map_base: Array
    ) -> tuple[TopologyBuilder, bool]:
        """Update the graph by the newest window, at the robot's pose (3,).

        Returns the builder to use from now on, and whether its map changed.
        """
        if not self.accepts_window():
            return builder, False
        if self._job is None:
            return builder, builder.update(window, T_map_base)
        self._pending.append((window, T_map_base))
        return (self.result(builder), True) if self._job.done() else (builder, False)

    def result(self, builder: TopologyBuilder) -> TopologyBuilder:
        """The rebuilt graph with all windows, or the given one; waits for it."""
        if self._job is None:
            return builder
        rebuilt = self._job.result()
        self._job = None
        for window, T_map_base in self._pending:
            rebuilt.update(window, T_map_base)
        self._pending = []
        return rebuilt

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

    def with_window(self, patch: GridPatch, corrected_ns: int) -> GridPatch | None:
        """A whole grid with the newest window in it, which is newer.

        None if the two have not undergone the same correction, or the graph is being rebuilt.
        """
        is_ready = self._awaited is None and self._job is None
        if not is_ready or self._window is None or corrected_ns != self._window_ns:
            return None
        mirror = MapMirror()
        mirror.replace(patch)
        mirror.paste(self._window)
        return mirror.patch

    def start(self, builder: TopologyBuilder, patch: GridPatch) -> TopologyBuilder:
        """Begin to rebuild the graph from the grid that has undergone the correction.

        Returns the builder to use until then.
        """
        if self._awaited is None:
            return builder
        _, poses = self._awaited
        self._awaited = None
        builder = self.result(builder)
        # Of a graph that began elsewhere it is not known from where it was seen: its nodes are
        # searched for where they were.
        moved = CorrectedPoses(poses, poses)
        if self._past is not None:
            moved = self._past.accept_corrections()
        thread = ThreadPoolExecutor(max_workers=1)
        self._job = thread.submit(builder.rebuilt, patch, *moved)
        thread.shutdown(wait=False)
        return builder
