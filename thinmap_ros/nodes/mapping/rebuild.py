"""A topological map rebuilt after a loop closure, whose grid and poses come one after the other."""

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.map_receiver import MapReceiver
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
        # The newest grid, until it is used with newer windows in it.
        self._grid: MapReceiver | None = None
        self._grid_ns = 0
        self._is_grid_used = False
        self._job: Future[TopologyBuilder] | None = None
        self._pending: list[tuple[GridPatch, Array]] = []

    def window(self, window: GridPatch, corrected_ns: int) -> None:
        """Record a window, and the stamp of the correction that its grid had undergone."""
        self._window = window
        self._window_ns = corrected_ns
        if corrected_ns != self._stale_ns:
            self._stale_ns = None
        self._paste_window()

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

    def grid(self, patch: GridPatch, corrected_ns: int) -> None:
        """Record a whole grid, and the stamp of the correction that it had undergone.

        It is published again only when it changes, and so it is kept until it can be used.
        Raises InputError where the newest window does not fit it.
        """
        self._grid = MapReceiver()
        self._grid.replace(patch)
        self._grid_ns = corrected_ns
        self._is_grid_used = False
        self._paste_window()

    def _paste_window(self) -> None:
        """Paste the newest window into a grid that is not used yet: it is newer."""
        is_outdated = self._is_grid_used or self._window_ns != self._grid_ns
        if self._grid is None or self._window is None or is_outdated:
            return
        try:
            self._grid.paste(self._window)
        except InputError:
            self._is_grid_used = True
            raise

    def whole_map(self) -> GridPatch | None:
        """The newest grid with newer windows in it, once.

        None where it has been used, where it and the newest window have not undergone the same
        correction, and while the graph is being rebuilt.
        """
        is_ready = self._awaited is None and self._job is None
        is_matched = self._window is not None and self._window_ns == self._grid_ns
        if self._grid is None or self._is_grid_used or not is_ready or not is_matched:
            return None
        self._is_grid_used = True
        return self._grid.patch

    def start(self, builder: TopologyBuilder) -> TopologyBuilder:
        """Begin to rebuild the graph, if the newest grid has undergone the awaited correction.

        Returns the builder to use until then.
        """
        patch = None if self._grid is None else self._grid.patch
        if self._awaited is None or patch is None or self._grid_ns != self._awaited[0]:
            return builder
        _, poses = self._awaited
        self._awaited = None
        self._is_grid_used = True
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
