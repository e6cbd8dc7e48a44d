"""Saved states of the topological map: cells of the grid, robot places, nodes and edges."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import (
    MAX_RESOLUTION_M,
    MIN_RESOLUTION_M,
    UNKNOWN,
    GridFrame,
    GridPatch,
)
from thinmap_ros.core.grid.tiles import MAX_CELLS, MAX_TILE_INDEX, TILE
from thinmap_ros.core.snapshot import MAX_CELL_INDEX, MAX_COORDINATE_M, MAX_ID, Field
from thinmap_ros.core.topology.graph import Edge, Node, NodeKind, TopologicalMap
from thinmap_ros.core.topology.layers.lattice import Cells

_PERCENT = np.array([UNKNOWN, 0, 100, UNKNOWN], dtype=np.int8)  # of each state
_A_BYTE = 4  # states
FIELDS = {
    'frame': Field(
        np.float64,
        (3,),
        (-MAX_COORDINATE_M, -MAX_COORDINATE_M, MIN_RESOLUTION_M),
        (MAX_COORDINATE_M, MAX_COORDINATE_M, MAX_RESOLUTION_M),
    ),
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
    ids = np.concatenate((nodes[:, 0], edges[:, 0]))
    snapshot.require_unique(ids, 'topology: id')
    snapshot.require_known(edges[:, 1:].ravel(), nodes[:, 0], 'topology: node of an edge')
    try:
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
    except ValueError as error:
        raise InputError(f'saved topology: {error}') from error
