"""The global topological map, kept up to date from the cells of the grid that change."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import config_or_default
from thinmap_ros.core.errors import InputError, quoted, require_type
from thinmap_ros.core.grid.moved import MapMotion
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology import topology_state
from thinmap_ros.core.topology.free_space import select_free_space
from thinmap_ros.core.topology.graph import Edge, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.layers.lattice import Cells, Lattice
from thinmap_ros.core.topology.layers.stack import Layers, Span
from thinmap_ros.core.topology.registry import Changes, Registry

__all__ = [
    'TopologyBuilder',
    'TopologyConfig',
    'build',
    'build_again',
    'build_along',
    'moved_map',
]

_OFF_LATTICE = 1e-3  # of a cell: windows farther off do not belong to the same grid


def build(
    patch: GridPatch,
    seed_xy: tuple[float, float] | None = None,
    config: TopologyConfig | None = None,
) -> TopologicalMap:
    """Topological map of a whole grid: what can be reached from seed_xy (m, map frame), or all.

    Raises InputError where it is no grid or seed_xy no place, ConfigError for another config.
    """
    require_type('patch', patch, GridPatch)
    config = config_or_default(config, TopologyConfig)
    if seed_xy is not None and np.shape(seed_xy) != (2,):
        raise InputError(f'seed_xy = {quoted(seed_xy)}: expected x, y (m)')
    return build_along(patch, select_free_space(patch, seed_xy, config), None, config)


def build_along(
    patch: GridPatch,
    free: NDArray[np.bool_],
    lines: NDArray[np.bool_] | None,
    config: TopologyConfig,
) -> TopologicalMap:
    """Topological map of a whole grid along lines (H, W); None: along its thinned free space.

    free (H, W): traversable cells. The lines are cells among these, up to a few cells wide, from
    another method than thinning: nodes and edges along them follow the same rules.
    """
    registry = Registry(patch.frame, config)
    registry.update(*_all_edges(patch, free, lines, config))
    return registry.map


def build_again(
    last: Registry | None, patch: GridPatch, seed_xy: tuple[float, float], config: TopologyConfig
) -> Registry:
    """Registry with the map of `build`, whose ids continue those of the last grid of the place.

    The grids may differ in their frames. A node keeps its id where the last map has a node within
    MATCH_RADIUS_M, nearest pairs first; edges between the same nodes keep theirs.
    """
    registry = Registry(patch.frame, config)
    if last is not None:
        registry = Registry(patch.frame, config, last.map, last.next_id)
    free = select_free_space(patch, seed_xy, config)
    registry.update(*_all_edges(patch, free, None, config))
    return registry


def _all_edges(
    patch: GridPatch,
    free: NDArray[np.bool_],
    lines: NDArray[np.bool_] | None,
    config: TopologyConfig,
) -> tuple[Lattice, Changes]:
    layers = Layers(patch.frame.resolution, config)
    layers.fill(patch, (0, 0), free, lines)
    return layers.lattice, layers.edge_changes(set(), is_everywhere=True)


class TopologyBuilder:
    """The global topological map of a grid that changes.

    After each update the map is that of the whole grid, as far as the robot can reach. Each layer
    receives only the cells that the one before changed: free space, deletion times of the thinning,
    skeleton graph, nodes and edges. Ids of nodes and edges stay, and are never assigned again.
    Source: topological map paper section 2.
    """

    def __init__(self, config: TopologyConfig | None = None) -> None:
        self.config = config_or_default(config, TopologyConfig)
        self._frame: GridFrame | None = None
        self._layers: Layers | None = None
        self._registry: Registry | None = None
        self._window = Span(0, 0, 0, 0)

    @property
    def map(self) -> TopologicalMap:
        """The global map. It is changed in place by `update`; take a copy to keep a state."""
        return TopologicalMap() if self._registry is None else self._registry.map

    @property
    def resolution_m(self) -> float | None:
        """Edge length of the cells of the grid, m; None before the first window."""
        return None if self._frame is None else self._frame.resolution

    def update(self, window: GridPatch, T_map_base: Array) -> bool:
        """Update the map by a window of the grid, and one robot's pose (3,), or several (N, 3).

        The window holds all cells that changed since the last one; its size and place are free.
        Returns whether the map changed. Raises InputError if the window is not on the cells of the
        first one, or the pose is not finite.

        The step of the paper: the cells of the local grid become free space, it is thinned, nodes
        and edges are found along the skeleton, and these are merged into the global map. Thinning
        is that of the global grid, so that the redundant nodes at the border of a local map, which
        the paper removes when it merges, do not occur.
        Source: topological map paper section 2.2, Fig. 5 and 8.
        """
        layers, registry, place = self._begin(window, T_map_base)
        self._window = Span(*place, *window.shape)
        changed = layers.update_free_space(window, place)
        layers.update_skeleton()
        for row, col in self._cells_of(T_map_base):
            layers.mark_robot((row, col))
        if changed == 0 and not layers.has_new_parts():
            return False
        return registry.update(layers.lattice, layers.edge_changes(registry.hashes))

    def local_map(self) -> TopologicalMap:
        """The part of the global map within the newest window."""
        if self._frame is None or self._registry is None:
            return TopologicalMap()
        return _part(self._registry.map, self._window.bounds_m(self._frame))

    def rebuilt(self, patch: GridPatch, before: Array, after: Array) -> 'TopologyBuilder':
        """Builder with the map of a corrected grid; this one is not changed.

        patch: all known cells. before, after: poses (N, 3) of the robot before and after the
        correction. A node keeps its id where the new map has a node at the place to which the pose
        nearest to it has moved; edges between the same nodes keep theirs.
        """
        builder = TopologyBuilder(self.config)
        if self._layers is None or self._registry is None or self._frame is None:
            return builder
        moved = moved_map(self._registry.map, before, after)
        robot_xy = self._frame.centres_of(self._layers.robot_places())
        robot_xy = _moved_points(robot_xy, before, after)
        places = patch.frame.cells_of(robot_xy)
        builder._fill(
            patch,
            patch.frame,
            places,
            Registry(patch.frame, self.config, moved, self._registry.next_id),
        )
        return builder

    @staticmethod
    def continued(
        patch: GridPatch,
        predecessor: TopologicalMap,
        next_id: int,
        config: TopologyConfig | None = None,
    ) -> 'TopologyBuilder':
        """Builder with the map of a grid whose ids continue those of another map of the place.

        predecessor: its nodes at the places where they are now; a part of the grid without any of
        them is not published. next_id: smallest number that no node or edge has had.
        """
        builder = TopologyBuilder(config)
        xy = np.array([node.position for node in predecessor.nodes.values()]).reshape(-1, 2)
        registry = Registry(patch.frame, builder.config, predecessor, next_id)
        builder._fill(patch, patch.frame, patch.frame.cells_of(xy), registry)
        return builder

    @property
    def next_id(self) -> int:
        """Smallest number that no node or edge has had."""
        return 1 if self._registry is None else self._registry.next_id

    def skip_ids(self, count: int) -> None:
        """Never assign the next so many ids: another builder may have assigned them meanwhile."""
        if self._registry is not None:
            self._registry.next_id += count

    def state(self) -> dict[str, NDArray[Any]]:
        """The state as arrays by name, empty before the first window; see `from_state`."""
        if self._layers is None or self._registry is None or self._frame is None:
            return {}
        return {
            'frame': self._frame.as_array(),
            'next_id': np.array(self._registry.next_id),
            'robot_places': self._layers.robot_places(),
            **topology_state.pack_tiles(*self._layers.states()),
            **topology_state.pack_map(self._registry.map),
        }

    @staticmethod
    def from_state(
        state: Mapping[str, NDArray[Any]], config: TopologyConfig | None = None
    ) -> 'TopologyBuilder':
        """Restore a builder from the `state` of one with the same configuration.

        Raises InputError if the state is invalid.
        """
        builder = TopologyBuilder(config)
        if not state:
            return builder
        saved = topology_state.unpack(state)
        registry = Registry(saved.frame, builder.config, saved.map, saved.next_id)
        builder._fill(saved.patch, saved.frame, saved.robot_places, registry)
        return builder

    def _fill(
        self, patch: GridPatch, lattice: GridFrame, robot_places: Cells, registry: Registry
    ) -> None:
        """Begin with all cells of a grid; robot_places (N, 2): rows and columns on the lattice."""
        self._frame = lattice
        self._layers = Layers(lattice.resolution, self.config)
        self._layers.fill(patch, _place_on(lattice, patch.frame))
        for row, col in robot_places.tolist():
            self._layers.mark_robot((row, col))
        self._registry = registry
        registry.update(self._layers.lattice, self._layers.edge_changes(set()))

    def _begin(
        self, window: GridPatch, T_map_base: Array
    ) -> tuple[Layers, Registry, tuple[int, int]]:
        """Layers, registry, and row and column of the window's first cell."""
        if not se2.is_finite(T_map_base):
            raise InputError(f'pose {T_map_base}: expected finite numbers')
        if self._frame is None or self._layers is None or self._registry is None:
            self._frame = window.frame
            self._layers = Layers(window.frame.resolution, self.config)
            self._registry = Registry(window.frame, self.config)
        return self._layers, self._registry, _place_on(self._frame, window.frame)

    def _cells_of(self, T_map_base: Array) -> list[list[int]]:
        """Row and column of a pose (3,), or of each of some poses (N, 3)."""
        assert self._frame is not None
        cells: list[list[int]] = self._frame.cells_of(T_map_base[..., :2]).tolist()
        return cells


def _place_on(lattice: GridFrame, frame: GridFrame) -> tuple[int, int]:
    """Row and column of the first cell of a frame on the lattice of another."""
    if frame.resolution != lattice.resolution:
        raise InputError(
            f'window with {frame.resolution} m a cell: expected {lattice.resolution} m'
        )
    row = (frame.origin_y - lattice.origin_y) / frame.resolution
    col = (frame.origin_x - lattice.origin_x) / frame.resolution
    if abs(row - round(row)) > _OFF_LATTICE or abs(col - round(col)) > _OFF_LATTICE:
        origin = (frame.origin_x, frame.origin_y)
        raise InputError(
            f'window at {origin}: expected whole cells from the first window of the map'
        )
    return round(row), round(col)


def _part(topology: TopologicalMap, bounds_m: Array) -> TopologicalMap:
    """Nodes within a rectangle (x, y, end x, end y), and the edges between them."""
    low_x, low_y, high_x, high_y = bounds_m.tolist()
    reach_m = 0.5 * math.hypot(high_x - low_x, high_y - low_y)
    nodes = topology.nodes_near(0.5 * (low_x + high_x), 0.5 * (low_y + high_y), reach_m)
    inside = [n for n in nodes if low_x <= n.x < high_x and low_y <= n.y < high_y]
    part = TopologicalMap(inside)
    edges: dict[int, Edge] = {e.id: e for node in inside for e in topology.edges_at(node.id)}
    for edge in edges.values():
        if edge.a in part.nodes and edge.b in part.nodes:
            part.put_edge(edge)
    return part


def _moved_points(points: Array, before: Array, after: Array) -> Array:
    """Points (N, 2), each moved as the pose nearest to it was."""
    return MapMotion(before, after).moved(points) if len(before) else points.copy()


def moved_map(topology: TopologicalMap, before: Array, after: Array) -> TopologicalMap:
    """The map with its nodes moved as the nearest of poses (N, 3) was.

    The path of each edge is its middle alone.
    """
    nodes = list(topology.nodes.values())
    xy = _moved_points(np.array([n.position for n in nodes]).reshape(-1, 2), before, after)
    edges = list(topology.edges.values())
    middles = np.array([edge.path[len(edge.path) // 2] for edge in edges]).reshape(-1, 2)
    moved = _moved_points(middles, before, after)
    return TopologicalMap(
        [replace(n, x=float(x), y=float(y)) for n, (x, y) in zip(nodes, xy, strict=True)],
        [replace(e, path=middle[None]) for e, middle in zip(edges, moved, strict=True)],
    )
