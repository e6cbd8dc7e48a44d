"""Regions as values: their doors, the names that people give, and those of nodes and edges."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.grid.moved import MapMotion
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.se2 import MAX_COORDINATE_M, Array, lengths_along
from thinmap_ros.core.snapshot import Field
from thinmap_ros.core.topology.graph import TopologicalMap

_STEP_M = 0.05  # between points of a path
_REACH_M = 0.5  # of a point from the nearest region

MAX_NAMES = 1000
MAX_LENGTH = 64
_MAX_LETTER = 0x10FFFF

FIELDS = {
    'name_anchors': Field(np.float64, ('n', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    # Code points, 0 behind the end.
    'name_letters': Field(np.int32, ('n', MAX_LENGTH), 0, _MAX_LETTER),
}


class RegionKind(IntEnum):
    """What a region is, by its shape."""

    ROOM = 0
    CORRIDOR = 1
    HALL = 2


@dataclass(frozen=True, eq=False)
class Region:
    """A room, corridor or hall.

    x, y: a free place far from walls, m, map frame; area_m2: free area; outline (K, 2): outer
    boundary, counterclockwise and not closed, m, map frame; name: that a person has given, '' for
    none.
    """

    id: int
    kind: RegionKind
    x: float
    y: float
    area_m2: float
    outline: Array
    name: str = ''


@dataclass(frozen=True)
class Door:
    """A narrow passage between the regions a and b.

    x, y: where it is narrowest, m, map frame; width_m: free width there.
    """

    a: int
    b: int
    x: float
    y: float
    width_m: float


@dataclass(frozen=True, eq=False)
class RegionMap:
    """Regions by id; labels (H, W): id of the region of each cell of a grid, 0 for none."""

    frame: GridFrame
    labels: NDArray[np.unsignedinteger[Any]]
    regions: Mapping[int, Region]
    doors: tuple[Door, ...]

    def ids_at(self, points: Array) -> NDArray[np.int32]:
        """Id of the region at each point (N, 2), m, map frame; 0 for none."""
        cells = self.frame.cells_of(points)
        inside = np.all((cells >= 0) & (cells < self.labels.shape), axis=1)
        ids = np.zeros(len(cells), dtype=np.int32)
        ids[inside] = self.labels[cells[inside, 0], cells[inside, 1]]
        return ids

    def neighbours(self, region_id: int) -> list[int]:
        """Ids of the regions that a door joins to a region, each once."""
        return self.all_neighbours().get(region_id, [])

    def all_neighbours(self) -> dict[int, list[int]]:
        """Neighbours of each region that has a door, by id."""
        found: dict[int, set[int]] = {}
        for door in self.doors:
            found.setdefault(door.a, set()).add(door.b)
            found.setdefault(door.b, set()).add(door.a)
        return {region: sorted(ends) for region, ends in found.items()}


@dataclass(frozen=True, eq=False)
class Membership:
    """Regions, and the id of that of each node and edge, by id; without those in no region.

    door_of: the narrowest door that an edge passes through, by edge id.
    """

    regions: RegionMap
    of_node: Mapping[int, int]
    of_edge: Mapping[int, int]
    door_of: Mapping[int, Door]

    def edges_through(self, door: Door) -> list[int]:
        """Ids of the edges that pass through a door as the narrowest one on their path."""
        return self._edges_by_door.get(id(door), [])

    @cached_property
    def _edges_by_door(self) -> dict[int, list[int]]:
        """Ids of edges, by the identity of their narrowest door: doors may be equal."""
        found: dict[int, list[int]] = {}
        for number, door in self.door_of.items():
            found.setdefault(id(door), []).append(number)
        return found


def membership_of(topology: TopologicalMap, regions: RegionMap) -> Membership:
    """Assign nodes by position, edges by the region of most of their path."""
    nodes = list(topology.nodes.values())
    places = np.array([(node.x, node.y) for node in nodes]).reshape(-1, 2)
    of_node = dict(zip((node.id for node in nodes), _nearest_ids(regions, places), strict=True))
    of_edge = {}
    door_of = {}
    doors_at = _doors_by_region(regions)
    for edge in topology.edges.values():
        path = _sampled(edge.path)
        ids = regions.ids_at(path)
        named = ids[ids > 0]
        of_edge[edge.id] = int(np.bincount(named).argmax()) if named.size else of_node[edge.a]
        ends = {of_node[edge.a], of_node[edge.b], *named.tolist()}
        door = _door_on(path, ends, doors_at)
        if door is not None:
            door_of[edge.id] = door
    return Membership(regions, _without_0(of_node), _without_0(of_edge), door_of)


def _sampled(path: Array) -> Array:
    """Points (N, 2) every _STEP_M along a path (K, 2)."""
    along = lengths_along(path)
    marks = np.linspace(0.0, along[-1], 2 + int(along[-1] / _STEP_M))
    return np.column_stack([np.interp(marks, along, path[:, axis]) for axis in (0, 1)])


def _doors_by_region(regions: RegionMap) -> dict[int, list[Door]]:
    """The doors of each region, each once: at the first of the two that it joins."""
    found: dict[int, list[Door]] = {}
    for door in regions.doors:
        found.setdefault(door.a, []).append(door)
    return found


def _door_on(path: Array, ids: set[int], doors_at: Mapping[int, list[Door]]) -> Door | None:
    """The narrowest door between two of the regions that a path (K, 2) passes through."""
    doors = [
        door
        for region in sorted(ids)
        for door in doors_at.get(region, ())
        if door.b in ids and _distance_m(path, door) <= 0.5 * door.width_m
    ]
    return min(doors, key=lambda door: door.width_m, default=None)


def _distance_m(path: Array, door: Door) -> float:
    """Distance of a door from the nearest point of a path (K, 2)."""
    return float(np.hypot(path[:, 0] - door.x, path[:, 1] - door.y).min())


def _nearest_ids(regions: RegionMap, points: Array) -> list[int]:
    """Id of the region at each point (N, 2), or nearest to it; 0 for none in reach."""
    ids = regions.ids_at(points)
    steps = np.arange(0.0, _REACH_M, regions.frame.resolution)[1:]
    for reach in steps:
        if ids.all():
            break
        for angle in np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False):
            around = regions.ids_at(points + reach * np.array([np.cos(angle), np.sin(angle)]))
            ids = np.where(ids > 0, ids, around)
    return [int(number) for number in ids]


def _without_0(ids: dict[int, int]) -> dict[int, int]:
    return {key: value for key, value in ids.items() if value}


def checked_name(text: str) -> str:
    """A name without the spaces around it; '' stays.

    Raises InputError where it is too long or has a character that cannot be printed.
    """
    name = text.strip()
    if len(name) > MAX_LENGTH or not name.isprintable():
        raise InputError(
            f'name {quoted(text)}: expected at most {MAX_LENGTH} characters that can be printed'
        )
    return name


class RegionNames:
    """Names, each at a point of the map: the region around the point has the name.

    So a name stays at its room when regions are computed again, divided or joined.
    """

    def __init__(self) -> None:
        self._anchors = np.empty((0, 2))
        self._names: list[str] = []

    def put(self, regions: RegionMap, region_id: int, anchor: Array, name: str) -> None:
        """Give the region around an anchor (2,), m, a name instead of those it has; '': none.

        Raises InputError where there are too many names.
        """
        ids = regions.ids_at(self._anchors)
        others = np.flatnonzero(ids != region_id).tolist()
        if name and len(others) >= MAX_NAMES:
            raise InputError(f'name {quoted(name)}: expected at most {MAX_NAMES} names of regions')
        self._names = [self._names[i] for i in others] + ([name] if name else [])
        anchors = [self._anchors[others], np.reshape(anchor, (1, 2))[: 1 if name else 0]]
        self._anchors = np.vstack(anchors)

    def move(self, motion: MapMotion) -> None:
        """Move the names as the map."""
        if self._names:
            self._anchors = motion.moved(self._anchors)

    def add(self, others: 'RegionNames') -> None:
        """Add names of another map; in a region with a name of both, the own one stays.

        Raises InputError where there are too many names.
        """
        names = [*others._names, *self._names]
        _check_count(len(names))
        self._anchors = np.vstack([others._anchors, self._anchors])
        self._names = names

    def named(self, regions: RegionMap) -> RegionMap:
        """Regions with their names; of several in one region the newest."""
        ids = regions.ids_at(self._anchors).tolist()
        names = dict(zip(ids, self._names, strict=True))
        known = {
            number: replace(region, name=names.get(number, ''))
            for number, region in regions.regions.items()
        }
        return replace(regions, regions=known)

    def state(self) -> dict[str, NDArray[Any]]:
        """Arrays by name; `from_state` continues from them."""
        letters = np.zeros((len(self._names), MAX_LENGTH), dtype=np.int32)
        for row, name in zip(letters, self._names, strict=True):
            row[: len(name)] = [ord(letter) for letter in name]
        return {'name_anchors': self._anchors, 'name_letters': letters}

    @staticmethod
    def from_state(state: Mapping[str, NDArray[Any]]) -> 'RegionNames':
        """Names of the `state` of others. Raises InputError where it is no such state."""
        checked = snapshot.validate(state, FIELDS, 'names of regions')
        names = RegionNames()
        names._anchors = checked['name_anchors']
        names._names = [_text(row) for row in checked['name_letters'].tolist()]
        _check_count(len(names._names))
        return names


def _check_count(count: int) -> None:
    if count > MAX_NAMES:
        raise InputError(f'{count} names of regions: expected at most {MAX_NAMES}')


def _text(letters: list[int]) -> str:
    """A name by its code points. Raises InputError where it is none."""
    text = ''.join(map(chr, letters)).rstrip('\0')
    if not text or checked_name(text) != text:
        raise InputError(f'saved name {quoted(text)}: expected the name of a region')
    return text
