"""The topological map of a growing grid, rebuilt in slices, and of a whole map at once."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2, snapshot
from thinmap_ros.core.config import config_or_default
from thinmap_ros.core.errors import InputError, quoted, require_type
from thinmap_ros.core.grid.correction import CorrectedPoses
from thinmap_ros.core.grid.mapper import MapUpdate, WholeMap
from thinmap_ros.core.grid.moved import MapMotion
from thinmap_ros.core.grid.patch import (
    FRAME_FIELD,
    UNKNOWN,
    GridFrame,
    GridPatch,
)
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.core.grid.tiles import MAX_CELLS, MAX_TILE_INDEX, TILE
from thinmap_ros.core.se2 import Array, Cells, Mask
from thinmap_ros.core.snapshot import MAX_CELL_INDEX, MAX_COORDINATE_M, MAX_ID, Field, State
from thinmap_ros.core.stage import Stage
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.layers.lattice import Lattice
from thinmap_ros.core.topology.layers.stack import Layers, Span
from thinmap_ros.core.topology.registry import MATCH_RADIUS_M, Changes, Registry
from thinmap_ros.core.topology.thinning import beyond_radius, select_free_space, without_islands

_OFF_LATTICE = 1e-3  # of a cell: windows farther off do not belong to the same grid
_STALE_NS = -1  # before every correction: the graph is rebuilt from the next whole map
# The time for the graph of the whole of a map grows with its cells.
_GRAPH_PERIOD_NS = 2_000_000_000
_CELLS_A_PERIOD = 1_000_000

# Of saved states.
_PERCENT = np.array([UNKNOWN, 0, 100, UNKNOWN], dtype=np.int8)  # of each state
_A_BYTE = 4  # states

Ids = dict[int, int]

FIELDS = {
    'frame': FRAME_FIELD,
    'next_id': Field(np.int64, (), 1, MAX_ID),
    'robot_places': Field(np.int64, ('r', 2), -MAX_CELL_INDEX, MAX_CELL_INDEX),
    'tiles': Field(np.int64, ('t', 2), -MAX_TILE_INDEX, MAX_TILE_INDEX),
    'states': Field(np.uint8, ('t', TILE, TILE // _A_BYTE), 0, 255),
    'nodes': Field(np.int64, ('n', 2), (1, 0), (MAX_ID, len(NodeKind) - 1)),  # id, kind
    'node_xy': Field(np.float64, ('n', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'edges': Field(np.int64, ('e', 3), 1, MAX_ID),  # id, ids of its nodes
    'edge_xy': Field(np.float64, ('e', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),  # middle
}


class SavedTopology(NamedTuple):
    """A saved state: the known cells, rows and columns (N, 2) where the robot was, and the ids.

    frame: of the lattice to which rows and columns refer; map: nodes at their places, and edges
    whose path is only its middle.
    """

    frame: GridFrame
    patch: GridPatch
    robot_places: Cells
    map: TopologicalMap
    next_id: int


def pack_tiles(tiles: Cells, states: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Arrays of the states (N, TILE, TILE) of the cells of tiles (N, 2)."""
    four = states.reshape(len(states), TILE, TILE // _A_BYTE, _A_BYTE)
    packed = four[..., 0] | four[..., 1] << 2 | four[..., 2] << 4 | four[..., 3] << 6
    return {'tiles': tiles, 'states': packed.astype(np.uint8)}


def pack_map(topology: TopologicalMap) -> dict[str, NDArray[Any]]:
    """Arrays of the ids of a map and of where they are."""
    nodes = list(topology.nodes.values())
    edges = list(topology.edges.values())
    middles = [edge.path[len(edge.path) // 2] for edge in edges]
    return {
        'nodes': np.array([(n.id, n.kind) for n in nodes], dtype=np.int64).reshape(-1, 2),
        'node_xy': np.array([(n.x, n.y) for n in nodes], dtype=np.float64).reshape(-1, 2),
        'edges': np.array([(e.id, e.a, e.b) for e in edges], dtype=np.int64).reshape(-1, 3),
        'edge_xy': np.array(middles, dtype=np.float64).reshape(-1, 2),
    }


def unpack(state: Mapping[str, NDArray[Any]]) -> SavedTopology:
    """Restore what the functions above have packed. Raises InputError if the state is invalid."""
    checked = snapshot.validate(state, FIELDS, 'topology')
    x, y, resolution = checked['frame'].tolist()
    frame = GridFrame(x, y, resolution)
    low = _first_cell(checked['tiles'])
    patch = GridPatch(frame.with_origin_at(*low), _cells(checked['tiles'], checked['states']))
    next_id = int(checked['next_id'])
    topology = _map_of(checked)
    ids = np.concatenate((checked['nodes'][:, 0], checked['edges'][:, 0]))
    snapshot.require(bool((ids < next_id).all()), 'topology: ids', f'below next_id, {next_id}')
    return SavedTopology(frame, patch, checked['robot_places'], topology, next_id)


def _first_cell(tiles: Cells) -> tuple[int, int]:
    """First row and column of the bounding rectangle of tiles (N, 2)."""
    unique = np.unique(tiles, axis=0)
    snapshot.require(len(unique) == len(tiles), 'topology: tiles', 'each once')
    if not len(tiles):
        return 0, 0
    row, col = (tiles.min(axis=0) * TILE).tolist()
    end_row, end_col = ((tiles.max(axis=0) + 1) * TILE).tolist()
    fits = (end_row - row) * (end_col - col) <= MAX_CELLS
    size = f'topology: {end_row - row} x {end_col - col} cells'
    snapshot.require(fits, size, f'{MAX_CELLS} at most')
    return row, col


def _cells(tiles: Cells, packed: NDArray[np.uint8]) -> NDArray[np.int8]:
    """Cells (H, W) of the bounding rectangle of tiles (N, 2), in percent."""
    if not len(tiles):
        return np.full((1, 1), UNKNOWN, dtype=np.int8)
    rows, cols = (tiles.max(axis=0) - tiles.min(axis=0) + 1).tolist()
    cells = np.full((rows, TILE, cols, TILE), UNKNOWN, dtype=np.int8)
    shifts = np.array([0, 2, 4, 6], dtype=np.uint8)
    for (row, col), part in zip((tiles - tiles.min(axis=0)).tolist(), packed, strict=True):
        states = part[..., None] >> shifts & 3
        cells[row, :, col] = _PERCENT[states.reshape(TILE, TILE)]
    return cells.reshape(rows * TILE, cols * TILE)


def _map_of(checked: Mapping[str, NDArray[Any]]) -> TopologicalMap:
    nodes = checked['nodes']
    edges = checked['edges']
    snapshot.require_unique(np.concatenate((nodes[:, 0], edges[:, 0])), 'topology: id')
    snapshot.require_known(edges[:, 1:].ravel(), nodes[:, 0], 'topology: node of an edge')
    return TopologicalMap(
        [
            Node(int(number), NodeKind(kind), float(x), float(y), 0.0)
            for (number, kind), (x, y) in zip(nodes, checked['node_xy'], strict=True)
        ],
        [
            Edge(int(number), int(a), int(b), middle[None], 0.0, 0.0)
            for (number, a, b), middle in zip(edges, checked['edge_xy'], strict=True)
        ],
    )


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
    free: Mask,
    lines: Mask | None,
    config: TopologyConfig,
) -> TopologicalMap:
    """Topological map of a whole grid along lines (H, W); None: along its thinned free space.

    free (H, W): traversable cells. The lines are cells among these, up to a few cells wide, from
    another method than thinning: nodes and edges along them follow the same rules.
    """
    registry = Registry(patch.frame, config)
    registry.update(*_all_edges(patch, free, lines, config))
    return registry.map


class Routes(NamedTuple):
    """A route graph, and what it was made of.

    map: the route graph; whole: the skeleton that it reduces; selected, standing (H, W): the cells
    that a robot can reach, and those of them that are no island; config: with the radius beyond
    which obstacles have to be.
    """

    map: TopologicalMap
    whole: TopologicalMap
    selected: Mask
    standing: Mask
    config: TopologyConfig


def build_routes(
    patch: GridPatch,
    start_xy: tuple[float, float] | Array | None,
    config: TopologyConfig,
    detail_m: float | None = None,
    node_spacing_m: float | None = None,
    touching: bool = False,
) -> Routes:
    """The route graph of a map in which all that is forbidden is a wall.

    start_xy: one place or several (N, 2), m, from which it is reached; None: all of the map but its
    islands. detail_m, node_spacing_m: as of `route_graph`; detail_m 0: the whole skeleton.
    touching: whether gaps that are exactly as wide as the robot count, which Nav2 refuses.
    Raises InputError where a place is not finite.
    """
    # Imported here: without a route graph, a node needs neither it nor the search tree of scipy.
    from thinmap_ros.core.topology.routes import DETAIL_M, route_graph

    resolution = patch.frame.resolution
    config = config if touching else beyond_radius(config, resolution)
    selected = select_free_space(patch, start_xy, config)
    standing = without_islands(selected, resolution) if start_xy is None else selected
    whole = build_along(patch, standing, None, config)
    detail_m = DETAIL_M if detail_m is None else detail_m
    reduced = (
        route_graph(whole, patch, standing, config, detail_m, node_spacing_m) if detail_m else whole
    )
    return Routes(reduced, whole, selected, standing, config)


def build_again(
    last: Registry | None, patch: GridPatch, seed_xy: tuple[float, float], config: TopologyConfig
) -> Registry:
    """Registry with the map of `build`, whose ids continue those of the last grid of the place.

    The grids may differ in their frames. A node keeps its id where the last map has a node within
    MATCH_RADIUS_M, nearest pairs first; edges between the same nodes keep theirs.
    """
    before = (None, 1) if last is None else (last.map, last.next_id)
    registry = Registry(patch.frame, config, *before)
    free = select_free_space(patch, seed_xy, config)
    registry.update(*_all_edges(patch, free, None, config))
    return registry


def _all_edges(
    patch: GridPatch,
    free: Mask,
    lines: Mask | None,
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
        frame, layers, registry = self._begin(window, T_map_base)
        place = _place_on(frame, window.frame)
        self._window = Span(*place, *window.shape)
        changed = layers.update_free_space(window, place)
        layers.update_skeleton()
        for row, col in frame.cells_of(T_map_base[..., :2]).tolist():
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
            **pack_tiles(*self._layers.states()),
            **pack_map(self._registry.map),
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
        saved = unpack(state)
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

    def _begin(self, window: GridPatch, T_map_base: Array) -> tuple[GridFrame, Layers, Registry]:
        """Frame, layers and registry, new ones with the first window."""
        if not se2.is_finite(T_map_base):
            raise InputError(f'pose {T_map_base}: expected finite numbers')
        if self._frame is None or self._layers is None or self._registry is None:
            self._frame = window.frame
            self._layers = Layers(window.frame.resolution, self.config)
            self._registry = Registry(window.frame, self.config)
        return self._frame, self._layers, self._registry


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


class Job(Protocol):
    """A graph that is being rebuilt."""

    def done(self) -> bool:
        """Whether it is complete."""

    def result(self) -> TopologyBuilder:
        """The graph; waits for it."""


class Finished:
    """A job that was done at once."""

    def __init__(self, work: Callable[[], TopologyBuilder]) -> None:
        self._result = work()

    def done(self) -> bool:
        """Whether it is complete."""
        return True

    def result(self) -> TopologyBuilder:
        """The graph."""
        return self._result


class Topology(Stage[MapUpdate, TopologicalMap]):
    """The stage of the graph, which follows the map and its corrections.

    While the map is rendered again the graph takes no cells, nor later those of a map that follows
    another correction than the graph. It is rebuilt when the whole map of a newer one comes;
    changes that come meanwhile are added to the new graph. Nodes keep their ids. A graph that an
    error has left half changed is rebuilt from the next whole map.
    """

    def __init__(
        self, config: TopologyConfig | None = None, begin: Callable[..., Job] = Finished
    ) -> None:
        """begin: calls a function, at once or in a thread."""
        self._config = config
        self._begin = begin
        self.reset()

    @property
    def map(self) -> TopologicalMap:
        """The graph."""
        return self.builder.map

    def reset(self) -> None:
        """Begin again with an empty graph."""
        self.replace(TopologyBuilder(self._config))

    def replace(self, builder: TopologyBuilder) -> None:
        """Continue with another graph, which has followed the corrections of its map."""
        self.builder = builder
        # Of the correction that changes must have undergone: None until there are some.
        self._corrected_ns: int | None = None
        self._newest: MapUpdate | None = None
        self._whole: WholeMap | None = None  # the newest one, until the graph has it
        self._job: Job | None = None
        self._pending: list[MapUpdate] = []

    def state(self) -> State:
        """The graph, and the correction that it follows."""
        # A graph that is being rebuilt does not follow the correction yet.
        corrected_ns = 0 if self._job is not None else max(self._corrected_ns or 0, 0)
        return {**self.builder.state(), 'corrected_ns': np.array(corrected_ns)}

    def restore(self, state: State) -> None:
        """Continue from a state. Raises InputError if it is invalid."""
        corrected_ns, graph = snapshot.split_number(state, 'corrected_ns')
        self.replace(TopologyBuilder.from_state(graph, self._config))
        self._corrected_ns = corrected_ns

    def step(self, update: MapUpdate) -> TopologicalMap | None:
        """Add what has changed in the map; returns the graph if it is another one.

        Raises InputError where the changes do not fit the map.
        """
        self._newest = update
        self._adopt(update)
        if update.whole is not None:
            self._whole = update.whole
        self._paste_changes()
        self._begin_to_rebuild()
        is_changed = self._add_changes(update)
        return self.map if self._add_whole_map() or is_changed else None

    def add_map(self, whole: WholeMap) -> TopologicalMap | None:
        """Add all of the map, once it can be used; returns the graph if it is another one.

        Raises InputError where the newest changes do not fit it.
        """
        self._whole = whole
        self._paste_changes()
        self._begin_to_rebuild()
        is_rebuilt = self._take_rebuilt()
        return self.map if self._add_whole_map() or is_rebuilt else None

    def finish(self) -> None:
        """Wait for the graph that is being rebuilt."""
        if self._job is None:
            return
        job = self._job
        pending = self._pending
        self._job = None
        self._pending = []
        with self._rebuilt_after_errors():
            self.builder = job.result()
        for update in pending:
            self._add(update.changes, update)

    def _adopt(self, update: MapUpdate) -> None:
        """Learn which correction the graph follows, from changes of its map."""
        if self._corrected_ns is None:
            whole = update.whole
            self._corrected_ns = update.corrected_ns if whole is None else whole.previous_ns
        elif update.corrected_ns < self._corrected_ns <= update.localized.scan.stamp_ns:
            # The mapper was restarted: its map knows of no correction.
            self._corrected_ns = update.corrected_ns

    def _paste_changes(self) -> None:
        """Paste the newest changes into the whole map: they are newer."""
        whole = self._whole
        newest = self._newest
        if whole is None or newest is None or newest.changes is None:
            return
        if newest.corrected_ns == whole.corrected_ns:
            self._whole = None  # unless they fit
            received = MapReceiver()
            received.replace(whole.patch)
            self._whole = replace(whole, patch=received.paste(newest.changes))

    def _accepts_changes(self) -> bool:
        newest = self._newest
        if newest is None or newest.is_rerendering:
            return False
        return newest.corrected_ns == self._corrected_ns

    def _add_changes(self, update: MapUpdate) -> bool:
        """Add changes, now or once the graph is rebuilt; returns whether the graph is another."""
        if self._accepts_changes():
            if self._job is None:
                return self._add(update.changes, update)
            self._pending.append(update)
        return self._take_rebuilt()

    def _add(self, cells: GridPatch | None, update: MapUpdate) -> bool:
        places = update.localized.T_map_base if update.places is None else update.places
        with self._rebuilt_after_errors():
            return cells is not None and self.builder.update(cells, places)

    @contextmanager
    def _rebuilt_after_errors(self) -> Iterator[None]:
        """Rebuild the graph from the next whole map if a change of it ends half done."""
        try:
            yield
        except InputError:
            raise  # changes that do not fit are refused before anything is done
        except Exception:
            self._corrected_ns = _STALE_NS
            raise

    def _take_rebuilt(self) -> bool:
        if self._job is None or not self._job.done():
            return False
        self.finish()
        return True

    def _add_whole_map(self) -> bool:
        """Update the graph by the newest whole map: beams may end outside of the windows."""
        whole = self._whole
        if whole is None or self._newest is None or self._job is not None:
            return False
        if whole.corrected_ns != self._corrected_ns or not self._accepts_changes():
            return False
        self._whole = None
        return self._add(whole.patch, self._newest)

    def _begin_to_rebuild(self) -> None:
        whole = self._whole
        corrected_ns = self._corrected_ns
        if whole is None or corrected_ns is None or corrected_ns >= whole.corrected_ns:
            return
        self.finish()
        # Where another correction is missing, nodes are searched for where they were.
        is_next = whole.previous_ns == corrected_ns
        moved = whole.moved if is_next else CorrectedPoses(whole.moved.after, whole.moved.after)
        self._corrected_ns = whole.corrected_ns
        self._whole = None
        with self._rebuilt_after_errors():
            self._job = self._begin(partial(self.builder.rebuilt, whole.patch, *moved))


class MapGraph:
    """Builds the graph of the whole map again when it has changed, at most every two seconds.

    Maps above a million cells are processed proportionally less often. Nodes and edges keep their
    ids from one map to the next.
    """

    def __init__(self, config: TopologyConfig) -> None:
        self._config = config
        self._registry: Registry | None = None
        self._patch: GridPatch | None = None
        self._built_ns = 0

    def update(self, patch: GridPatch, T_map_base: Array, stamp_ns: int) -> TopologicalMap:
        """Graph of what can be reached from a pose (3,) in a map.

        An earlier one within the period, and where the robot stands in no free space.
        """
        if self._registry is not None and not self._is_due(patch, stamp_ns):
            return self._registry.map
        self._patch = patch
        self._built_ns = stamp_ns
        seed_xy = (float(T_map_base[0]), float(T_map_base[1]))
        registry = build_again(self._registry, patch, seed_xy, self._config)
        if self._registry is None or registry.map.nodes:
            self._registry = registry
        return self._registry.map

    def _is_due(self, patch: GridPatch, stamp_ns: int) -> bool:
        if patch is self._patch:
            return False
        period_ns = _GRAPH_PERIOD_NS * max(1.0, patch.cells.size / _CELLS_A_PERIOD)
        return not 0 <= stamp_ns - self._built_ns < period_ns


def join_topologies(
    patch: GridPatch,
    first: TopologicalMap,
    second: TopologicalMap,
    next_id: int,
    config: TopologyConfig | None = None,
) -> tuple[TopologyBuilder, Ids]:
    """Builder with the map of a joined grid, and the id of each node of the second map in it.

    first, second: with their nodes at their places in the joined grid; next_id: smallest number
    that no node or edge of the first map has had. Ids of the first map stay. A node of the second
    one within MATCH_RADIUS_M of one of the first takes its id, nearest pairs first; others,
    and all edges, get new ids. Nodes that the joined grid does not have are left out.
    """
    config = config or TopologyConfig()
    ids = _new_ids(first, second, next_id)
    nodes = [
        *first.nodes.values(),
        *(
            replace(node, id=ids[node.id])
            for node in second.nodes.values()
            if ids[node.id] not in first.nodes
        ),
    ]
    edges = [
        replace(edge, id=ids[edge.id], a=ids[edge.a], b=ids[edge.b])
        for edge in second.edges.values()
        if not {ids[edge.a], ids[edge.b]} <= first.nodes.keys()
    ]
    predecessor = TopologicalMap(nodes, [*first.edges.values(), *edges])
    after = max([next_id - 1, *ids.values()]) + 1
    builder = TopologyBuilder.continued(patch, predecessor, after, config)
    there = builder.map.nodes
    return builder, {own: ids[own] for own in second.nodes if ids[own] in there}


def with_ids_of(known: TopologicalMap, other: TopologicalMap, next_id: int) -> TopologicalMap:
    """Another map of the same place with the ids of a known one.

    A node within MATCH_RADIUS_M of a known one takes its id, nearest pairs first, and an edge that
    of the known one between the same nodes. All others get ids from next_id on.
    """
    ids = _new_ids(known, other, next_id)
    between = {frozenset((edge.a, edge.b)): edge.id for edge in known.edges.values()}
    edges = [
        replace(
            edge,
            id=between.pop(frozenset((ids[edge.a], ids[edge.b])), ids[edge.id]),
            a=ids[edge.a],
            b=ids[edge.b],
        )
        for edge in other.edges.values()
    ]
    return TopologicalMap([replace(n, id=ids[n.id]) for n in other.nodes.values()], edges)


def _new_ids(first: TopologicalMap, second: TopologicalMap, next_id: int) -> Ids:
    """Ids of the nodes and edges of the second map in the joined one."""
    ids: Ids = {}
    pairs = []
    for node in second.nodes.values():
        for other in first.nodes_near(node.x, node.y, MATCH_RADIUS_M):
            away = (node.x - other.x) ** 2 + (node.y - other.y) ** 2
            if away <= MATCH_RADIUS_M**2:
                pairs.append((away, node.id, other.id))
    used: set[int] = set()
    for _, own, other_id in sorted(pairs):
        if own not in ids and other_id not in used:
            ids[own] = other_id
            used.add(other_id)
    for own in sorted([*second.nodes, *second.edges]):
        if own not in ids:
            ids[own] = next_id
            next_id += 1
    return ids
