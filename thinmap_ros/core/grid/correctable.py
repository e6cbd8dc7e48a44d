"""Occupancy grid that is corrected after loop closures, and once a laser proves to drop out."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.edits import Erasures
from thinmap_ros.core.grid.erasing import erase
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.grid.rerendering import Rerendering, StoredScan
from thinmap_ros.core.grid.scan_history import CorrectedPoses, PoseHistory
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.stage import Destination

MAX_OPEN = 1000  # scans that wait, the latest; 10 MB of a robot that stands at a start pose


class CorrectableGrid:
    """A grid that is re-rendered from stored scans after a correction, one slice per scan.

    So it is when the beams without return of a laser turn out to show no free space (`drops_out`).
    `shown` is the published map. It is always complete: each tile shows the old rendering until its
    new one is complete. `corrected_ns` is the stamp of the newest correction that has been
    applied to the whole map.
    Scans whose placement is open wait: they are added once a scan belongs in the map, and dropped
    if the robot was lost. Those of a robot that maps apart are stored and not shown. They join the
    map if a correction comes before the robot is in the map again; otherwise they are dropped.
    `erasures` are the parts of the map of which only later scans show anything, whenever it is
    rendered again; a correction moves them.
    The stored scans take 10 kB per metre of new ground, at most 30 kB per square metre.
    """

    def __init__(
        self,
        grid: OccupancyGrid,
        keeps_scans: bool = True,
        corrected_ns: int = 0,
        scans: Sequence[tuple[Scan, Array]] = (),
        erasures: Erasures | None = None,
    ) -> None:
        """Start with a grid. If keeps_scans is False, it is never corrected.

        scans: with poses (3,), from which a grid that is not empty can be rendered. It is shown as
        it is until the first correction. erasures: of the grid, among its scans by their stamps.
        """
        self.shown = grid
        self.corrected_ns = corrected_ns
        self.erasures = erasures or Erasures()
        self._drops_out = False
        self._refusals: list[str] = []
        history: PoseHistory[StoredScan] = PoseHistory()
        for scan, T_scan in scans:
            count = self.erasures.count_before(scan.stamp_ns)
            history.add_pose(scan.stamp_ns, T_scan, StoredScan.of(scan, grid.config, count))
        self._history = history if keeps_scans else None
        # With the poses (3,) at which they were made.
        self._open: deque[tuple[Scan, Array]] = deque(maxlen=MAX_OPEN)
        self._apart: PoseHistory[StoredScan] | None = None
        self._is_joined = False  # whether a correction has come since the last scan that is apart
        self._pending_ns: int | None = None
        self._rerendering: Rerendering | None = None
        self._T_map_base = np.zeros(3)  # pose of the robot

    @property
    def is_rerendering(self) -> bool:
        """Whether a correction has not yet been applied to the whole grid."""
        return self._pending_ns is not None

    def apply_correction(self, stamps_ns: NDArray[np.int64], poses: Array, since_ns: int) -> bool:
        """Apply a correction: the scans of these stamps (M,) were made at poses (M, 3).

        since_ns: stamp of the first scan whose pose is already correct. A re-rendering in progress
        starts again with the newer poses. Returns False, and changes nothing, if the scans of the
        grid are not stored.
        """
        if self._history is None:
            self.corrected_ns = since_ns
            return False
        before = self._history.last_pose()
        places = self._history.kept_poses()
        self._history.apply_correction(stamps_ns, poses, since_ns)
        self.erasures.move(places, self._history.kept_poses())
        self._move_open(before, self._history.last_pose())
        if self._apart is not None:
            self._apart.apply_correction(stamps_ns, poses, since_ns)
            self._is_joined = True
        self._pending_ns = since_ns
        self._rerendering = None
        return True

    def update(
        self, scan: Scan | None, T_map_base: Array, placement: Destination = Destination.MAP
    ) -> CorrectedPoses | None:
        """Continue the re-rendering, then add a scan made at a robot pose (3,).

        scan: None where there is none that belongs anywhere. Returns the corrected poses when a
        re-rendering is complete, without that of this scan. Scans that `OccupancyGrid.add_scan`
        refuses are left out: `take_refusals`.
        """
        self._T_map_base = T_map_base
        if scan is None:
            placement = Destination.NOWHERE
        if placement is Destination.MAP:
            self._end_apart()
        moved = self._render_slice()
        if scan is not None:
            self._place(scan, T_map_base, placement)
        return moved

    def _place(self, scan: Scan, T_map_base: Array, placement: Destination) -> None:
        if placement is Destination.MAP:
            self._set_drops_out(scan.drops_out)
            for earlier, T_earlier in self._open:
                self._add_scan(earlier, T_earlier)
            self._open.clear()
            self._add_scan(scan, T_map_base)
        elif placement is Destination.OPEN:
            self._open.append((scan, T_map_base))
        elif placement is Destination.APART:
            self._open.clear()
            self._store_apart(scan, T_map_base)

    def erase(self, corners: Array, stamp_ns: int) -> None:
        """Set a polygon (M, 2), m, to unknown until later scans show it.

        Only where no re-rendering is in progress. stamp_ns: of the newest scan. Raises InputError
        where too many parts are erased.
        """
        self.erasures.add(corners, stamp_ns)
        erase(self.shown, corners)

    def take_refusals(self) -> list[str]:
        """Why scans were left out since the last call, a reason for each."""
        refusals = self._refusals
        self._refusals = []
        return refusals

    def finish(self) -> CorrectedPoses | None:
        """Complete a re-rendering in progress, and return the corrected poses."""
        moved = None
        while self.is_rerendering:
            moved = self._render_slice()
        return moved

    def _store_apart(self, scan: Scan, T_map_base: Array) -> None:
        if self._history is None:
            return
        if self._apart is None:
            self._apart = PoseHistory()
        self._is_joined = False
        kept = self._stored(scan)
        self._apart.add_pose(scan.stamp_ns, T_map_base, kept)

    def _end_apart(self) -> None:
        """Add the scans that are apart to the map if they were joined, and drop them otherwise."""
        if self._history is not None and self._apart is not None and self._is_joined:
            self._history.extend(self._apart)
            self._render_again()
        self._apart = None

    def _set_drops_out(self, drops_out: bool) -> None:
        """Render the stored scans again if what their beams without return say has changed."""
        if drops_out == self._drops_out:
            return
        self._drops_out = drops_out
        if self._history is not None:
            self._render_again()

    def _render_again(self) -> None:
        """Begin to render all stored scans."""
        self._rerendering = None
        if self._pending_ns is None:
            self._pending_ns = self.corrected_ns

    def _move_open(self, before: Array | None, after: Array | None) -> None:
        """Move the waiting scans along with the scan before them, from one pose (3,) to another."""
        if before is not None and after is not None:
            T = se2.compose(after, se2.invert(before))
            moved = [(scan, se2.compose(T, T_scan)) for scan, T_scan in self._open]
            self._open = deque(moved, maxlen=MAX_OPEN)

    def _add_scan(self, scan: Scan, T_map_base: Array) -> None:
        try:
            self.shown.add_scan(scan, T_map_base)
        except InputError as error:
            self._refusals.append(str(error))
            return
        if self._history is None:
            return
        kept = self._stored(scan)
        self._history.add_pose(scan.stamp_ns, T_map_base, kept)
        if self._rerendering is not None:
            self._rerendering.add_scan(kept, T_map_base)

    def _stored(self, scan: Scan) -> StoredScan:
        """The scan of a laser of which it is found out later whether it drops out."""
        scan = replace(scan, drops_out=False)
        return StoredScan.of(scan, self.shown.config, len(self.erasures))

    def _render_slice(self) -> CorrectedPoses | None:
        if self._history is None or self._pending_ns is None:
            return None
        if self._rerendering is None:
            kept = self._history.kept()
            poses = self._history.kept_poses()
            self._rerendering = Rerendering(
                self.shown,
                kept,
                poses,
                self._T_map_base,
                self._drops_out,
                [item.corners for item in self.erasures.items],
            )
            # The step that closes a loop is already long: rendering starts with the next one.
            return None
        self._refusals += self._rerendering.render_slice(self.shown)
        if not self._rerendering.is_complete:
            return None
        self.shown = self._rerendering.grid
        self.corrected_ns = self._pending_ns
        self._pending_ns = None
        self._rerendering = None
        return self._history.accept_corrections()
