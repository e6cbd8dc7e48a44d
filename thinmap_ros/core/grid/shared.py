"""Maps of others: copies of published maps, and tiles that robots send each other."""

import struct
import zlib
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.core.grid.moved import overlaid
from thinmap_ros.core.grid.patch import (
    FREE_AT_MOST,
    OCCUPIED_AT_LEAST,
    UNKNOWN,
    GridFrame,
    GridPatch,
)
from thinmap_ros.core.grid.tiles import MAX_CELLS
from thinmap_ros.core.se2 import Array


def _table() -> NDArray[np.uint8]:
    """Bits of each value of a cell."""
    values = np.arange(256, dtype=np.uint8).view(np.int8)
    bits = np.full(256, 3, dtype=np.uint8)
    bits[values < 0] = 0
    bits[(values >= 0) & (values <= FREE_AT_MOST)] = 1
    bits[values >= OCCUPIED_AT_LEAST] = 2
    return bits


TILE_PERIOD_S = 5.0  # from one message of a robot to the next

EDGE = 16
_PACKED_BYTES = EDGE * EDGE // 4
_UNKNOWN_TILE = bytes(_PACKED_BYTES)
_MAX_TILES = 1 << 16
_HEADER = struct.Struct('<IIIddd')
_SHIFTS = np.array([0, 2, 4, 6], dtype=np.uint8)
_CELLS = np.array([UNKNOWN, 0, 100, 50], dtype=np.int8)  # in the order of their bits
_TABLE = _table()

# Percent: after some four beams, of which most agree. docs/theory/exploration.md has the ablation.
_SURELY_FREE = 10
_SURELY_OCCUPIED = 90

# Updates that may be received before the whole map that they follow: those of some seconds.
_MAX_KEPT_UPDATES = 50

Key = tuple[int, int]  # row and column of a tile, in tiles from the origin of its frame


@dataclass(frozen=True)
class TileMessage:
    """Tiles that have changed after one version of a map, up to another one.

    A tile has 16 x 16 cells of 2 bits: unknown, free, occupied, or in between. A receiver that has
    missed a message notices by its versions, and asks for all that has changed since the last that
    it has. The lattices of both maps must be the same.
    frame: of the lattice; tiles: packed cells by row and column.
    """

    after: int
    version: int
    frame: GridFrame
    tiles: dict[Key, bytes]

    def encode(self) -> bytes:
        """The message as bytes."""
        frame = self.frame
        head = _HEADER.pack(
            self.after,
            self.version,
            len(self.tiles),
            frame.origin_x,
            frame.origin_y,
            frame.resolution,
        )
        keys = np.array(list(self.tiles), dtype='<i4').reshape(-1, 2)
        return zlib.compress(head + keys.tobytes() + b''.join(self.tiles.values()), 9)

    @staticmethod
    def decode(data: bytes) -> 'TileMessage':
        """The message in some bytes. Raises InputError where they are none."""
        most = _HEADER.size + _MAX_TILES * (8 + _PACKED_BYTES)
        try:
            plain = zlib.decompressobj().decompress(data, most)
        except zlib.error as error:
            raise InputError(f'map tiles: {one_line_reason(error)}') from error
        if len(plain) < _HEADER.size:
            raise InputError(f'map tiles: {len(plain)} bytes: expected at least {_HEADER.size}')
        after, version, count, x, y, resolution = _HEADER.unpack_from(plain)
        expected = _HEADER.size + count * (8 + _PACKED_BYTES)
        if len(plain) != expected or version < after:
            raise InputError(
                f'map tiles: {len(plain)} bytes for {count} tiles of versions {after} to '
                f'{version}: expected {expected} bytes, and rising versions'
            )
        keys = np.frombuffer(plain, '<i4', 2 * count, _HEADER.size).reshape(-1, 2).tolist()
        first = _HEADER.size + 8 * count
        tiles = {
            (row, col): plain[first + i * _PACKED_BYTES : first + (i + 1) * _PACKED_BYTES]
            for i, (row, col) in enumerate(keys)
        }
        return TileMessage(after, version, GridFrame(x, y, resolution), tiles)


class TileSender:
    """The tiles of a robot's own map, with the version in which each has changed last."""

    def __init__(self, frame: GridFrame) -> None:
        """frame: of the lattice; all maps lie on its cells."""
        self.frame = frame
        self.version = 0
        self._next_after = 0  # version after which the next message begins
        self._tiles: dict[Key, tuple[bytes, int]] = {}

    def update(self, patch: GridPatch) -> None:
        """Find the tiles that differ from the last map."""
        found = _tiles_of(patch, self.frame)
        gone = dict.fromkeys(self._tiles.keys() - found.keys(), _UNKNOWN_TILE)
        changed = {
            key: packed
            for key, packed in (found | gone).items()
            if packed != self._tiles.get(key, (_UNKNOWN_TILE, 0))[0]
        }
        if changed:
            self.version += 1
            self._tiles |= {key: (packed, self.version) for key, packed in changed.items()}

    def next_message(self) -> TileMessage:
        """What has changed since the last message, or since what a receiver has asked for."""
        message = self.changes_after(self._next_after)
        self._next_after = self.version
        return message

    def repeat_after(self, version: int) -> None:
        """Have the next message contain all that has changed after a version: it was missed."""
        self._next_after = min(self._next_after, version)

    def changes_after(self, version: int) -> TileMessage:
        """All tiles that have changed after a version; 0: all tiles."""
        tiles = {key: packed for key, (packed, changed) in self._tiles.items() if changed > version}
        return TileMessage(version, self.version, self.frame, tiles)


class ReceivedTiles:
    """Cells of other robots, filled into a robot's own map where that is unknown."""

    def __init__(self, frame: GridFrame) -> None:
        """frame: of the lattice of the robot's own map."""
        self._frame = frame
        self._tiles: dict[Key, dict[str, NDArray[np.int8]]] = {}
        self._versions: dict[str, int] = {}
        self._patch: GridPatch | None = None

    def version_of(self, sender: str) -> int:
        """Version up to which the tiles of a robot are complete; 0: none."""
        return self._versions.get(sender, 0)

    def add(self, sender: str, message: TileMessage) -> Array | None:
        """Add the tiles of a robot; returns the corners (2, 2), m, of what they change.

        None where there is nothing new, or the messages before this one are missing. Raises
        InputError where its lattice is another one, or the map would have more than MAX_CELLS.
        """
        if message.frame != self._frame:
            raise InputError(f'map tiles on {message.frame}: expected those of {self._frame}')
        known = self.version_of(sender)
        if message.after > known or message.version <= known:
            return None
        self._require_near(message)
        self._versions[sender] = message.version
        if not message.tiles:
            return None
        for key, packed in message.tiles.items():
            layers = self._tiles.setdefault(key, {})
            # The newest is the last one, and decides where robots contradict each other.
            layers.pop(sender, None)
            layers[sender] = _unpacked(packed)
        self._patch = None
        cells = EDGE * np.array(list(message.tiles))
        low = cells.min(axis=0)
        high = cells.max(axis=0) + EDGE
        frame = self._frame
        origin = (frame.origin_x, frame.origin_y)
        corners = np.array([[low[1], low[0]], [high[1], high[0]]]) * frame.resolution
        return np.asarray(corners + origin)

    def completed(self, own: GridPatch) -> GridPatch:
        """A robot's own map, and what others know where it is undecided."""
        received = self.known_area()
        return own if received is None else completed(own, received)

    def known_area(self) -> GridPatch | None:
        """All received tiles as one map; None: there are none."""
        if self._patch is None and self._tiles:
            self._patch = self._rendered()
        return self._patch

    def _require_near(self, message: TileMessage) -> None:
        """Raise InputError where a map with these tiles, too, would be too large."""
        keys = np.array([*self._tiles, *message.tiles]).reshape(-1, 2)
        if not len(keys):
            return
        rows, cols = (EDGE * (1 + keys.max(axis=0) - keys.min(axis=0))).tolist()
        if rows * cols > MAX_CELLS:
            raise InputError(
                f'map tiles for a map of {rows} x {cols} cells: expected {MAX_CELLS} at most'
            )

    def _rendered(self) -> GridPatch:
        """All received tiles as one map."""
        keys = np.array(list(self._tiles))
        low = keys.min(axis=0)
        rows, cols = EDGE * (keys.max(axis=0) + 1 - low)
        cells = np.full((int(rows), int(cols)), UNKNOWN, dtype=np.int8)
        for (row, col), layers in self._tiles.items():
            top = EDGE * (row - int(low[0]))
            left = EDGE * (col - int(low[1]))
            part = cells[top : top + EDGE, left : left + EDGE]
            for layer in layers.values():
                part[:] = _decided(layer, part)
        row, col = (EDGE * low).tolist()
        return GridPatch(self._frame.with_origin_at(row, col), cells)


def completed(own: GridPatch, other: GridPatch) -> GridPatch:
    """A map, with the cells that another one on its lattice decides where it is not sure itself.

    From afar a wall is easily taken for free: another robot that was there knows better.
    Raises InputError off the lattice.
    """
    wide = own.padded(own.overhang_of(other))
    row, col = wide.offset_of(other)
    cells = wide.cells.copy()
    part = cells[row : row + other.shape[0], col : col + other.shape[1]]
    is_sure = ((part >= 0) & (part <= _SURELY_FREE)) | (part >= _SURELY_OCCUPIED)
    part[:] = np.where(is_sure, part, _decided(other.cells, part))
    return GridPatch(wide.frame, cells, own.is_replaced)


def changed_part(before: GridPatch, now: GridPatch) -> GridPatch | None:
    """The rectangle of a map in which it differs from an earlier one; None: nowhere."""
    wide = now.padded(now.overhang_of(before))
    bounds = wide.changes_since(before.padded(before.overhang_of(now)))
    return None if bounds is None else wide.part(bounds)


def _decided(cells: NDArray[np.int8], otherwise: NDArray[np.int8]) -> NDArray[np.int8]:
    """Cells (H, W) that are free or occupied; others where those are not."""
    is_decided = ((cells >= 0) & (cells <= FREE_AT_MOST)) | (cells >= OCCUPIED_AT_LEAST)
    is_better = is_decided | (otherwise == UNKNOWN)
    return np.asarray(np.where(is_better, cells, otherwise))


def _tiles_of(patch: GridPatch, frame: GridFrame) -> dict[Key, bytes]:
    """Packed cells of all tiles of a map that are not unknown."""
    row, col = GridPatch(frame, patch.cells[:0, :0]).offset_of(patch)
    top = row % EDGE
    left = col % EDGE
    rows, cols = patch.shape
    margins = (top, left, -(top + rows) % EDGE, -(left + cols) % EDGE)
    cells = _TABLE[patch.padded(margins).cells.view(np.uint8)]
    first = ((row - top) // EDGE, (col - left) // EDGE)
    down, right = (size // EDGE for size in cells.shape)
    tiles = cells.reshape(down, EDGE, right, EDGE).swapaxes(1, 2).reshape(-1, EDGE * EDGE // 4, 4)
    packed = np.bitwise_or.reduce(tiles << _SHIFTS, axis=2).astype(np.uint8)
    return {
        (first[0] + int(i) // right, first[1] + int(i) % right): packed[i].tobytes()
        for i in np.flatnonzero(packed.any(axis=1))
    }


def _unpacked(packed: bytes) -> NDArray[np.int8]:
    """Cells (16, 16) of a tile."""
    bits = np.frombuffer(packed, dtype=np.uint8)[:, None] >> _SHIFTS & 3
    return np.asarray(_CELLS[bits].reshape(EDGE, EDGE))


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


class _Update(NamedTuple):
    """Cells from a row and a column of the map on."""

    stamp_ns: int
    row: int
    col: int
    cells: NDArray[np.int8]


class MapReceiver:
    """A copy of the map of another node: the newest whole map, with newer updates and windows.

    The lattice of all patches must be the same. Whole maps and updates have a topic each, and those
    of one topic may overtake the others: an update is made where it is newer than the whole map, by
    its stamp, also once that comes. Stamps of 0 are unknown: what comes last is the newest.
    """

    def __init__(self) -> None:
        self.patch: GridPatch | None = None
        self._stamp_ns = 0
        self._updates: deque[_Update] = deque(maxlen=_MAX_KEPT_UPDATES)

    def replace(self, whole: GridPatch, stamp_ns: int = 0) -> None:
        """Replace the copy by a whole map."""
        # A stamp from before: time was set back, and updates from then do not follow this map.
        has_begun_anew = stamp_ns < self._stamp_ns
        kept = () if has_begun_anew else tuple(self._updates)
        self._updates.clear()
        self._stamp_ns = stamp_ns
        self.patch = whole
        for update in kept:
            if update.stamp_ns > stamp_ns:
                with suppress(InputError):
                    self.update(*update)

    def update(self, stamp_ns: int, row: int, col: int, cells: NDArray[np.int8]) -> bool:
        """Replace cells (H, W) of the map; returns whether they are newer than the map.

        Raises InputError where they do not lie inside the map: the next whole map has them.
        """
        self._updates.append(_Update(stamp_ns, row, col, cells))
        is_known = 0 < stamp_ns <= self._stamp_ns
        if self.patch is None or is_known:
            return False
        self.patch = self.patch.with_part(row, col, cells)
        return True

    def paste(self, window: GridPatch) -> GridPatch:
        """Paste a window into the copy, enlarging it if necessary; returns the result.

        Raises InputError if the window is not aligned with the cells of the map, or far from it.
        """
        if self.patch is None:
            self.patch = window
            return window
        margins = self.patch.overhang_of(window)
        rows, cols = window.shape
        if max(margins[0], margins[2]) > 2 * rows or max(margins[1], margins[3]) > 2 * cols:
            raise InputError(
                f'map window at {window.frame}: expected it on or beside the map '
                f'at {self.patch.frame}'
            )
        rows_in_all = self.patch.shape[0] + margins[0] + margins[2]
        cols_in_all = self.patch.shape[1] + margins[1] + margins[3]
        if rows_in_all * cols_in_all > MAX_CELLS:
            raise InputError(
                f'map window at {window.frame}: a map of {rows_in_all} x {cols_in_all} cells: '
                f'expected {MAX_CELLS} at most'
            )
        whole = self.patch.padded(margins) if any(margins) else self.patch
        self.patch = whole.with_part(*whole.offset_of(window), window.cells)
        return self.patch
