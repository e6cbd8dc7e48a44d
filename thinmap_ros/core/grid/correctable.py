"""An occupancy grid that follows the corrections of loop closures."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.grid.rerendering import Rerendering, StoredScan
from thinmap_ros.core.grid.scan_history import CorrectedPoses, PoseHistory
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array


class CorrectableGrid:
    """A grid that is re-rendered from kept scans, a slice with each scan, after a correction.

    `shown` is the map for others to read; it is complete at any time: each tile shows the new
    rendering as soon as that is complete, and the old one before. `corrected_ns` is the stamp of
    the newest correction that all of it has undergone.
    The kept scans take 10 kB a metre of new ground, at most 30 kB a square metre.
    """

    def __init__(
        self, grid: OccupancyGrid, keeps_scans: bool = True, corrected_ns: int = 0
    ) -> None:
        """Begin with a grid; without its scans (keeps_scans) it is never corrected."""
        self.shown = grid
        self.corrected_ns = corrected_ns
        self._history: PoseHistory[StoredScan] | None = PoseHistory() if keeps_scans else None
        self._pending_ns: int | None = None
        self._rerendering: Rerendering | None = None
        self._T_map_base = np.zeros(3)  # pose of the robot

    @property
    def is_rerendering(self) -> bool:
        """Whether there is a correction that not all of the shown grid has undergone."""
        return self._pending_ns is not None

    def correct(self, stamps_ns: NDArray[np.int64], poses: Array, since_ns: int) -> bool:
        """Follow a correction: the scans of these stamps (M,) were made at poses (M, 3).

        since_ns: stamp of the first scan whose pose is right already. A re-rendering that is under
        way starts again, at the newer poses. Returns False where the scans of the grid are not
        known: then it stays as it is.
        """
        if self._history is None:
            self.corrected_ns = since_ns
            return False
        self._history.correct(stamps_ns, poses, since_ns)
        self._pending_ns = since_ns
        self._rerendering = None
        return True

    def update(self, scan: Scan | None, T_map_base: Array) -> CorrectedPoses | None:
        """Continue the re-rendering, then add a scan made at a robot pose (3,).

        scan: None where nobody knows where it was made. Returns the moved poses when a
        re-rendering is completed, without that of this scan. Raises InputError as
        `OccupancyGrid.update` does.
        """
        self._T_map_base = T_map_base
        moved = self._render_slice()
        if scan is not None:
            self._add_scan(scan, T_map_base)
        return moved

    def finish(self) -> CorrectedPoses | None:
        """Complete the re-rendering, if one is under way, and return the moved poses."""
        moved = None
        while self.is_rerendering:
            moved = self._render_slice()
        return moved

    def _add_scan(self, scan: Scan, T_map_base: Array) -> None:
        self.shown.update(scan, T_map_base)
        if self._history is None:
            return
        kept = StoredScan.of(scan, self.shown.config)
        self._history.add(scan.stamp_ns, T_map_base, kept)
        if self._rerendering is not None:
            self._rerendering.add_scan(kept, T_map_base)

    def _render_slice(self) -> CorrectedPoses | None:
        if self._history is None or self._pending_ns is None:
            return None
        if self._rerendering is None:
            kept = self._history.kept()
            poses = self._history.kept_poses()
            self._rerendering = Rerendering(self.shown, kept, poses, self._T_map_base)
            # The step in which a loop is closed has enough to do.
            return None
        self._rerendering.render_slice(self.shown)
        if not self._rerendering.is_complete:
            return None
        self.shown = self._rerendering.grid
        self.corrected_ns = self._pending_ns
        self._pending_ns = None
        self._rerendering = None
        return self._history.accept_corrections()
