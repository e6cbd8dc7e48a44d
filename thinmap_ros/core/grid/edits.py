"""What a person has changed on a map: keep-out areas, and parts that are erased."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.keep_out import (
    MAX_AREAS,
    MAX_CORNERS,
    MAX_STORED_OUTLINE_M,
    KeepOut,
    KeepOutArea,
    moved_corners,
    require_corners,
)
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_ID, Field, State

MAX_ERASURES = 200
_STAMP_LIMIT_NS = 2**62
FIELDS = {
    'keep_out': Field(np.int64, ('a', 3), (1, 0, 1), (MAX_ID, 1, MAX_CORNERS)),
    'keep_out_xy': Field(np.float64, ('c', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'keep_out_next_id': Field(np.int64, (), 1, MAX_ID + 1),
    'erased': Field(np.int64, ('e', 2), (0, 1), (_STAMP_LIMIT_NS, MAX_CORNERS)),
    'erased_xy': Field(np.float64, ('d', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
}


class Erasure(NamedTuple):
    """A polygon with corners (M, 2), m, of which no scan up to a stamp shows anything."""

    corners: Array
    stamp_ns: int

    def moved(self, before: Array, after: Array) -> 'Erasure':
        """The same, moved along with the pose (3,) nearest to it; poses (N >= 1, 3)."""
        return Erasure(moved_corners(self.corners, before, after), self.stamp_ns)


@dataclass(eq=False)
class Erasures:
    """Erased parts of a map, in the order in which they were erased."""

    items: list[Erasure] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.items)

    def add(self, corners: Array, stamp_ns: int) -> None:
        """Add a polygon with corners (M, 2), m; stamp_ns: of the newest scan that is erased.

        Raises InputError where there are too many.
        """
        if len(self.items) >= MAX_ERASURES:
            raise InputError(f'map with {MAX_ERASURES} erased parts: expected no more')
        self.items.append(Erasure(corners, stamp_ns))

    def count_before(self, stamp_ns: int) -> int:
        """How many were erased before a scan of an earlier session was made."""
        return sum(item.stamp_ns < stamp_ns for item in self.items)

    def move(self, before: Array, after: Array) -> None:
        """Move each along with the pose (3,) nearest to it; poses (N, 3) around a correction."""
        if len(before):
            self.items = [item.moved(before, after) for item in self.items]


@dataclass(frozen=True, eq=False)
class MapEdits:
    """The edits of a map, as they are saved."""

    keep_out: KeepOut = field(default_factory=KeepOut)
    erasures: Erasures = field(default_factory=Erasures)

    def __bool__(self) -> bool:
        return bool(self.keep_out.areas or self.erasures.items)

    def state(self) -> State:
        """The edits as arrays by name; see `from_state`."""
        areas = self.keep_out.areas
        rows = [(area.id, int(area.is_wall), len(area.corners)) for area in areas]
        erased = [(item.stamp_ns, len(item.corners)) for item in self.erasures.items]
        return {
            'keep_out': np.array(rows, dtype=np.int64).reshape(-1, 3),
            'keep_out_xy': _stacked([area.corners for area in areas]),
            'keep_out_next_id': np.array(self.keep_out.next_id),
            'erased': np.array(erased, dtype=np.int64).reshape(-1, 2),
            'erased_xy': _stacked([item.corners for item in self.erasures.items]),
        }

    @staticmethod
    def from_state(state: State, config: object = None) -> 'MapEdits':
        """Restore edits from their `state`. Raises InputError if the state is invalid."""
        checked = snapshot.validate(state, FIELDS, 'edits')
        rows = checked['keep_out'].tolist()
        snapshot.require(len(rows) <= MAX_AREAS, 'edits: keep_out', f'at most {MAX_AREAS}')
        snapshot.require_unique(checked['keep_out'][:, 0], 'edits: keep_out')
        next_id = int(checked['keep_out_next_id'])
        snapshot.require(
            all(number < next_id for number, _, _ in rows), 'edits: keep_out', 'ids below next_id'
        )
        polygons = _split(checked['keep_out_xy'], [size for _, _, size in rows], 'keep_out')
        areas = [
            KeepOutArea(number, corners, bool(is_wall))
            for (number, is_wall, _), corners in zip(rows, polygons, strict=True)
        ]
        erased = checked['erased'].tolist()
        snapshot.require(len(erased) <= MAX_ERASURES, 'edits: erased', f'at most {MAX_ERASURES}')
        corners_of = _split(checked['erased_xy'], [size for _, size in erased], 'erased')
        items = [
            Erasure(corners, stamp) for (stamp, _), corners in zip(erased, corners_of, strict=True)
        ]
        try:
            for item in items:
                require_corners('erased part', item.corners, max_outline_m=MAX_STORED_OUTLINE_M)
            return MapEdits(KeepOut([area.checked() for area in areas], next_id), Erasures(items))
        except InputError as error:
            raise InputError(f'saved edits: {error}') from error


def split_edits(state: State) -> tuple[MapEdits, dict[str, NDArray[Any]]]:
    """Split a state into its edits, none where it has no array of them, and the other arrays.

    Raises InputError if the edits are invalid.
    """
    own = {name: array for name, array in state.items() if name in FIELDS}
    rest = {name: array for name, array in state.items() if name not in FIELDS}
    return MapEdits.from_state(own) if own else MapEdits(), rest


def _stacked(polygons: Sequence[Array]) -> Array:
    return np.vstack([np.empty((0, 2)), *polygons])


def _split(corners: Array, sizes: Sequence[int], what: str) -> list[Array]:
    """Corners (M, 2) of each polygon. Raises InputError where there are more or less."""
    snapshot.require(sum(sizes) == len(corners), f'edits: {what}_xy', f'{sum(sizes)} corners')
    return np.split(corners, np.cumsum(sizes)[:-1]) if sizes else []
