"""From localized scans to the map."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.correction import CorrectableGrid, CorrectedPoses
from thinmap_ros.core.grid.edits import KeepOut, MapEdits, require_corners, split_edits
from thinmap_ros.core.grid.moved import MapMotion
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import State
from thinmap_ros.core.stage import Destination, LocalizedScan, Stage, Trajectory

_NOWHERE = CorrectedPoses(np.zeros((0, 3)), np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class WholeMap:
    """All known cells of the map.

    corrected_ns: stamp of the newest trajectory that they follow; previous_ns: of the one before;
    moved: where the map has moved in between, by the poses of its scans.
    """

    patch: GridPatch
    corrected_ns: int = 0
    previous_ns: int = 0
    moved: CorrectedPoses = _NOWHERE


@dataclass(frozen=True, eq=False)
class MapUpdate:
    """What has changed in the map since the last update, with the newest scan.

    changes: cells of the map, among them those around the robot that have changed; None: none has.
    places (N, 2): where the robot was meanwhile, m, in the map as it is now.
    corrected_ns: stamp of the newest trajectory that all of the map follows; is_rerendering:
    whether a newer one has not reached all of it. whole: the map, once it has been rendered again.
    """

    localized: LocalizedScan
    changes: GridPatch | None
    corrected_ns: int
    is_rerendering: bool
    whole: WholeMap | None = None
    places: Array | None = None


class Mapper(Stage[LocalizedScan, MapUpdate]):
    """The stage of the map: each scan is added at its pose, and the map follows corrections.

    grid: the map; refusals: why scans are not on it, a reason for each. keep_out: areas that move
    with the map when it is corrected, and do not change it.
    """

    def __init__(
        self,
        config: OccupancyConfig | None = None,
        keeps_scans: bool = True,
        window_m: float | None = None,
        scans_per_update: int = 1,
    ) -> None:
        """Start empty. If keeps_scans is False, the map is never corrected.

        window_m: edge of the square around the robot that an update shows; None: all changes.
        """
        self._config = config or OccupancyConfig()
        self._keeps_scans = keeps_scans
        self._window_m = window_m
        self._scans_per_update = scans_per_update
        self.reset()

    def reset(self) -> None:
        """Begin again with an empty map."""
        self.replace(CorrectableGrid(OccupancyGrid(self._config), self._keeps_scans))
        self._is_given = False

    def replace(self, grid: CorrectableGrid, keep_out: KeepOut | None = None) -> None:
        """Continue with another map, whose cells may have any size, and its keep-out areas."""
        self.grid = grid
        self.keep_out = keep_out or KeepOut()
        self.refusals: list[str] = []
        self._is_given = True
        self._scans = 0
        self._previous_ns = 0
        self._moved = _NOWHERE
        # Since the last update.
        self._newest: LocalizedScan | None = None
        self._places: list[Array] = []
        self._is_whole_new = False

    @property
    def edits(self) -> MapEdits:
        """What a person has changed on the map."""
        return MapEdits(self.keep_out, self.grid.erasures)

    def erase(self, corners: Array, stamp_ns: int) -> None:
        """Set a polygon (M, 2), m, to unknown, after a correction in progress is complete.

        stamp_ns: of the newest scan. Raises InputError where it is none, or the last of too many.
        """
        require_corners('part to erase', corners)
        self.finish()
        self.grid.erase(corners, stamp_ns)

    def state(self) -> State:
        """The cells of the map, and its edits."""
        return {**self.grid.shown.state(), **self.edits.state()}

    def restore(self, state: State) -> None:
        """Continue with saved cells, which are not corrected. Raises InputError for others."""
        edits, cells = split_edits(state)
        grid = OccupancyGrid.from_state(cells, self._config)
        expected_m = self._config.resolution_m
        if not self._is_given and grid.frame.resolution != expected_m:
            raise InputError(
                f'map with {grid.frame.resolution} m a cell: expected {expected_m} m (resolution_m)'
            )
        erased = edits.erasures
        self.replace(CorrectableGrid(grid, keeps_scans=False, erasures=erased), edits.keep_out)

    def correct(self, trajectory: Trajectory) -> bool:
        """Begin to follow a trajectory; returns whether the map can be corrected."""
        before_ns = self.grid.corrected_ns
        is_corrected = self.grid.apply_correction(*trajectory)
        if not is_corrected:
            self._note(before_ns, _NOWHERE)
        return is_corrected

    @property
    def has_changed(self) -> bool:
        """Whether there is an update: the map has changed since the last one."""
        return self._is_whole_new or bool(self._places)

    def step(self, localized: LocalizedScan, /) -> MapUpdate | None:
        """Add a scan; None before the next update is due."""
        return self.update() if self.add(localized) else None

    def add(self, localized: LocalizedScan) -> bool:
        """Add a scan; returns whether the next update is due, which may also be made later."""
        if localized.trajectory is not None:
            self.correct(localized.trajectory)
        before_ns = self.grid.corrected_ns
        moved = self.grid.update(localized.scan, localized.T_map_base, localized.destination)
        self.refusals = self.grid.take_refusals()
        is_due = self._scans % self._scans_per_update == 0
        self._scans += 1
        self._newest = localized
        if moved is not None:
            self._take_corrected(before_ns, moved)
        elif is_due and localized.destination is Destination.MAP and not self.grid.is_rerendering:
            # Poses during a correction are ahead of the map.
            self._places.append(localized.T_map_base[:2])
        return is_due or moved is not None

    def update(self) -> MapUpdate:
        """What has changed since the last update; after the first scan."""
        assert self._newest is not None
        whole = self.whole_map() if self._is_whole_new else None
        changes = self._changes(self._newest, whole)
        places = np.array(self._places).reshape(-1, 2)
        self._places = []
        self._is_whole_new = False
        grid = self.grid
        return MapUpdate(
            self._newest, changes, grid.corrected_ns, grid.is_rerendering, whole, places
        )

    def finish(self) -> WholeMap | None:
        """Complete a correction; returns the map where it was not complete before."""
        if not self.complete():
            return None
        self._is_whole_new = False
        return self.whole_map()

    def complete(self) -> bool:
        """Complete a correction; returns whether it was not complete before."""
        before_ns = self.grid.corrected_ns
        moved = self.grid.finish()
        self.refusals = self.grid.take_refusals()
        if moved is None:
            return False
        self._take_corrected(before_ns, moved)
        return True

    def whole_map(self) -> WholeMap:
        """All known cells."""
        grid = self.grid
        return WholeMap(grid.shown.known_area(), grid.corrected_ns, self._previous_ns, self._moved)

    def _take_corrected(self, before_ns: int, moved: CorrectedPoses) -> None:
        """All of the map has been rendered again."""
        if self._places and len(moved.before):
            self._places = list(MapMotion(*moved).moved(np.array(self._places)))
        self._note(before_ns, moved)
        self._is_whole_new = True

    def _note(self, before_ns: int, moved: CorrectedPoses) -> None:
        """The map has been corrected, unless it was rendered again for another reason."""
        if before_ns == self.grid.corrected_ns:
            return
        self.keep_out = self.keep_out.moved(*moved)
        if not self._is_whole_new:
            self._previous_ns = before_ns
            self._moved = moved
        elif len(moved.before):
            # No update has told of the last correction.
            self._moved = CorrectedPoses(
                self._moved.before, MapMotion(*moved).moved_poses(self._moved.after)
            )

    def _changes(self, localized: LocalizedScan, whole: WholeMap | None) -> GridPatch | None:
        grid = self.grid.shown
        if self._window_m is not None:
            x, y, _ = localized.T_map_base
            return grid.window(x, y, self._window_m)
        changes = grid.take_changes()
        if whole is None:
            return changes
        return whole.patch if self._places else None
