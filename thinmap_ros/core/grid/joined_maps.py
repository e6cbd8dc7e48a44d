"""Maps of other robots, received as tiles, laid into a robot's own map where that is undecided."""

from functools import reduce

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.map_tiles import ReceivedTiles, TileMessage, completed
from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.grid.rotated import overlaid
from thinmap_ros.core.se2 import Array


class _JoinedMap:
    """The map of another robot on its own lattice, and on that of this robot.

    session: of the versions of its tiles. T (3,): place of the map in that of this robot, None
    where it is unknown; laid: the map there.
    """

    def __init__(self, session: int, message: TileMessage) -> None:
        self.session = session
        self.received = ReceivedTiles(message.frame)
        self.T: Array | None = None
        self.laid: GridPatch | None = None

    def is_moved_by(self, T: Array | None) -> bool:
        """Whether a cell of the map is another one of this robot's map at another place."""
        patch = self.received.known_area()
        if T is None or self.T is None or patch is None:
            return T is not self.T
        corners = _corners(patch)
        moved = se2.transform_points(T, corners) - se2.transform_points(self.T, corners)
        return bool(np.hypot(*moved.T).max() > patch.frame.resolution)

    def lay(self, base: GridPatch) -> GridPatch | None:
        """The map on the lattice of a base; None: its place, or all of it, is unknown."""
        patch = self.received.known_area()
        if self.laid is None and self.T is not None and patch is not None:
            self.laid = overlaid(base, patch, self.T)
        return self.laid


class JoinedMaps:
    """Cells of other robots, in the map of this one as soon as the place of their maps is known.

    is_moved: whether more of the joined map may have changed than `take_changes` says, since
    somebody set this to False.
    """

    def __init__(self) -> None:
        self.is_moved = False
        self._maps: dict[str, _JoinedMap] = {}
        self._places: dict[str, Array] = {}
        self._changes: list[Array] = []
        self._base: GridPatch | None = None
        self._others: GridPatch | None = None
        self._last: tuple[GridPatch, GridPatch] | None = None

    def add(self, robot: str, session: int, message: TileMessage) -> int | None:
        """Add tiles of a robot; returns the version after which some are missing; None: none.

        Tiles of another session are of another map, which takes the place of the last one. Raises
        InputError as `ReceivedTiles.add`.
        """
        joined = self._maps.get(robot)
        if joined is None or joined.session != session:
            joined = self._begin(robot, session, message)
        box = joined.received.add(robot, message)
        known = joined.received.version_of(robot)
        if box is not None:
            self._changed(joined, box)
        return known if known < message.version else None

    def place(self, places: dict[str, Array]) -> None:
        """Set the places T (3,) of the maps of all joined robots in the map of this one, by name.

        The maps of all others are left out.
        """
        self._places = places
        for robot, joined in self._maps.items():
            T = places.get(robot)
            if joined.is_moved_by(T):
                joined.T = T
                self._drop(joined)

    def completed(self, own: GridPatch) -> GridPatch:
        """The map of this robot, and what others know where it is undecided.

        Raises InputError where the map would be too large.
        """
        if self._base is None or not self._base.is_aligned_with(own):
            self._base = GridPatch(own.frame, np.full((1, 1), UNKNOWN, dtype=np.int8))
            for joined in self._maps.values():
                self._drop(joined)
        if self._others is None:
            laid = [joined.lay(self._base) for joined in self._maps.values()]
            known = [patch for patch in laid if patch is not None]
            if not known:
                return own
            self._others = reduce(completed, known)
            self._last = None
        if self._last is None or self._last[0] is not own:
            self._last = (own, completed(own, self._others))
        return self._last[1]

    def take_changes(self) -> list[Array]:
        """Parts (2, 2), m, of this robot's map that others have changed since the last call."""
        changes = self._changes
        self._changes = []
        return changes

    def _begin(self, robot: str, session: int, message: TileMessage) -> _JoinedMap:
        joined = _JoinedMap(session, message)
        joined.T = self._places.get(robot)
        self._maps[robot] = joined
        self._drop(joined)
        return joined

    def _changed(self, joined: _JoinedMap, box: Array) -> None:
        """Tiles in a box (2, 2) of the map of a robot are new."""
        joined.laid = None
        self._others = None
        if joined.T is not None:
            corners = se2.transform_points(joined.T, _corners_of(box))
            self._changes.append(np.array([corners.min(axis=0), corners.max(axis=0)]))

    def _drop(self, joined: _JoinedMap) -> None:
        joined.laid = None
        self._others = None
        self._last = None
        self.is_moved = True


def _corners(patch: GridPatch) -> Array:
    """Corners (4, 2), m, of a map."""
    frame = patch.frame
    low = np.array([frame.origin_x, frame.origin_y])
    size = np.array(patch.shape[::-1]) * frame.resolution
    return _corners_of(np.array([low, low + size]))


def _corners_of(box: Array) -> Array:
    """Corners (4, 2) of a box (2, 2)."""
    return np.array([[x, y] for x in box[:, 0] for y in box[:, 1]])
