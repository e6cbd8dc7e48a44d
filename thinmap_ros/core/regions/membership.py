"""Regions of the nodes and edges of a topological map, and doors on its edges."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from thinmap_ros.core.regions.region_map import Door, RegionMap
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap

_STEP_M = 0.05
_REACH_M = 0.5  # of a point from the nearest region


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
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))))
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
