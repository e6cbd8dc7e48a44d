"""A topological map rebuilt after a loop closure, whose grid and poses come one after the other."""

from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.map_receiver import MapReceiver
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.scan_history import CorrectedPoses, PoseHistory
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.builder import TopologyBuilder
from thinmap_ros.ros.localized_scan import MappedScan


class _Correction(NamedTuple):
    """A trajectory: the scans of these stamps (M,) were made at poses (M, 3)."""

    ns: int
    stamps_ns: NDArray[np.int64]
    poses: Array


class Rebuilding:
    """The graph follows the corrections of its grid.

    While a grid is rendered again, the graph accepts no windows, nor later those of a grid that has
    undergone another correction than the graph. The graph is rebuilt in a thread, so that no scan
    waits; windows that come meanwhile are added to the new graph.
    """

    def __init__(self, from_the_start: bool = True, restored_ns: int | None = None) -> None:
        """from_the_start: whether the graph begins here: all poses of it will be known.

        restored_ns: stamp of a checkpoint, which follows all corrections until then.
        """
        self._past: PoseHistory[None] | None = PoseHistory() if from_the_start else None
        self._restored_ns = restored_ns
        # Of the correction that the graph follows: None until there is a window.
        self._corrected_ns: int | None = None
        self._correction: _Correction | None = None
        self._newest: MappedScan | None = None
        # The newest grid, until it is used with newer windows in it.
        self._grid: MapReceiver | None = None
        self._grid_ns = 0
        self._is_grid_used = False
        self._job: Future[TopologyBuilder] | None = None
        self._pending: list[MappedScan] = []

    def window(self, mapped: MappedScan) -> None:
        """Record a window and its scan. Raises InputError where it does not fit the grid."""
        self._newest = mapped
        self.add_pose(mapped.localized.scan.stamp_ns, mapped.localized.T_map_base)
        self._adopt(mapped)
        self._paste_window()

    def add_pose(self, stamp_ns: int, T_map_base: Array) -> None:
        """Add the pose (3,) of a scan from which the graph was made."""
        if self._past is not None:
            self._past.add_pose(stamp_ns, T_map_base, None)

    def _adopt(self, mapped: MappedScan) -> None:
        """Learn which correction the graph follows, from a window of its grid."""
        if self._corrected_ns is None:
            is_newer = self._restored_ns is not None and mapped.corrected_ns > self._restored_ns
            self._corrected_ns = 0 if is_newer else mapped.corrected_ns
        elif mapped.corrected_ns < self._corrected_ns <= mapped.localized.scan.stamp_ns:
            # The mapper was restarted: its grid knows of no correction.
            self._corrected_ns = mapped.corrected_ns

    def accepts_window(self) -> bool:
        """Whether the newest window may be added to the graph."""
        mapped = self._newest
        return (
            mapped is not None
            and not mapped.is_rerendering
            and mapped.corrected_ns == self._corrected_ns
        )

    def update(self, builder: TopologyBuilder) -> tuple[TopologyBuilder, bool]:
        """Update the graph by the newest window.

        Returns the builder to use from now on, and whether its map changed.
        """
        builder = self.start(builder)
        if self._newest is None or not self.accepts_window():
            return builder, False
        if self._job is None:
            return builder, _updated(builder, self._newest)
        self._pending.append(self._newest)
        return (self.result(builder), True) if self._job.done() else (builder, False)

    def result(self, builder: TopologyBuilder) -> TopologyBuilder:
        """The rebuilt graph with all windows, or the given one; waits for it."""
        if self._job is None:
            return builder
        rebuilt = self._job.result()
        self._job = None
        for mapped in self._pending:
            _updated(rebuilt, mapped)
        self._pending = []
        return rebuilt

    def correct(self, corrected_ns: int, stamps_ns: NDArray[np.int64], poses: Array) -> None:
        """Record a correction: the scans of these stamps (M,) were made at poses (M, 3)."""
        self._correction = _Correction(corrected_ns, stamps_ns, poses)

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
        if self._grid is None or self._is_grid_used or self._newest is None:
            return
        if self._newest.corrected_ns != self._grid_ns:
            return
        try:
            self._grid.paste(self._newest.window)
        except InputError:
            self._is_grid_used = True
            raise

    def whole_map(self) -> GridPatch | None:
        """The newest grid with newer windows in it, once.

        None where it has been used, where it and the newest window have not undergone the same
        correction, and while grid or graph is being rebuilt.
        """
        is_ready = self._job is None and self.accepts_window()
        if self._grid is None or self._is_grid_used or not is_ready:
            return None
        if self._grid_ns != self._corrected_ns:
            return None
        self._is_grid_used = True
        return self._grid.patch

    def start(self, builder: TopologyBuilder) -> TopologyBuilder:
        """Begin to rebuild the graph, if there is a grid of a newer correction.

        Returns the builder to use until then.
        """
        found = self._correction
        patch = None if self._grid is None else self._grid.patch
        if found is None or patch is None or self._corrected_ns is None:
            return builder
        if not self._corrected_ns < found.ns == self._grid_ns:
            return builder
        self._corrected_ns = found.ns
        self._is_grid_used = True
        builder = self.result(builder)
        # Of a graph that began elsewhere it is not known from where it was seen: its nodes are
        # searched for where they were.
        moved = CorrectedPoses(found.poses, found.poses)
        if self._past is not None:
            self._past.apply_correction(found.stamps_ns, found.poses, since_ns=found.ns)
            moved = self._past.accept_corrections()
        thread = ThreadPoolExecutor(max_workers=1)
        self._job = thread.submit(builder.rebuilt, patch, *moved)
        thread.shutdown(wait=False)
        return builder


def _updated(builder: TopologyBuilder, mapped: MappedScan) -> bool:
    """Update a graph by a window; returns whether its map changed."""
    return builder.update(mapped.window, mapped.localized.T_map_base)
