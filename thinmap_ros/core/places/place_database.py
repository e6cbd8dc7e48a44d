"""What a finished map shows at each place: walls near by, ranges all round, nodes in sight."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import axis_setup, line_is_clear
from thinmap_ros.core.places.config import GlobalLocalizationConfig
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.jit import kernel

Mask = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Short = NDArray[np.int16]

DIRECTIONS = 72
# Side of the square round the robot in which the nodes of a scan are observed and compared.
NODE_WINDOW_M = 10.0
NEAR_UNIT_M = 0.004  # of the distance to the nearest wall: up to 1.02 m in a byte
RANGE_UNIT_M = 0.05  # of the ranges all round: up to 12.75 m in a byte
_NEAR_CAP = 255
_SPACING_M = 0.3
_MAX_PLACES = 100_000
_BLOCK_M = 0.5  # nodes in sight are listed for blocks of this size
SIGHT_UNIT_M = 0.002  # of where these lie, from the corner of their block: up to 65 m in two bytes

FREE = 0
WALL = 1
UNKNOWN = 2


@dataclass(frozen=True, eq=False)
class Places:
    """A map as a lost robot looks at it; all in the map frame.

    frame: of the cells; states (H, W) uint8: FREE, WALL or UNKNOWN; near (H, W) uint8: distance
    from a cell to the nearest wall, in NEAR_UNIT_M, at most 255; standing (N, 2) int32: cells in
    which the robot can stand; spots (P, 2): places among these, a spacing apart, and
    around (P, DIRECTIONS) uint8: what a laser would measure from there towards the headings
    k / DIRECTIONS of a turn, in RANGE_UNIT_M; spacing_m: between the spots; nodes (M, 2): of the
    topological map; blocks, first, in_sight (2, K): x and y, in SIGHT_UNIT_M from the corner of
    block (i, j) of the map, of the nodes in sight of it are
    in_sight[:, first[blocks[i, j]] : first[blocks[i, j] + 1]]; blocks are block_cells wide.
    """

    frame: GridFrame
    states: Bytes
    near: Bytes
    standing: NDArray[np.int32]
    spots: Array
    around: Bytes
    spacing_m: float
    nodes: Array
    blocks: NDArray[np.int32]
    first: NDArray[np.int32]
    in_sight: Short
    block_cells: int

    @property
    def free_area_m2(self) -> float:
        """Area on which the robot can stand."""
        return len(self.standing) * self.frame.resolution**2

    def memory_bytes(self) -> int:
        """What all arrays take."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, np.ndarray))

    @staticmethod
    def of(
        patch: GridPatch, topology: TopologicalMap, config: GlobalLocalizationConfig
    ) -> 'Places':
        """Places of a map and its topological map.

        Raises InputError where there is no free cell on which the robot can stand, no wall, or no
        node.
        """
        if not topology.nodes:
            raise InputError('topology without nodes: expected that of the map')
        others = np.where(patch.occupied, WALL, UNKNOWN)
        states = np.where(patch.free, FREE, others).astype(np.uint8)
        if not patch.occupied.any():
            raise InputError(f'map of {patch.shape} cells without an occupied one: expected walls')
        near = _near_walls(states, patch.frame.resolution)
        has_room = near * NEAR_UNIT_M >= config.robot_radius_m
        standing = np.argwhere((states == FREE) & has_room).astype(np.int32)
        if not len(standing):
            raise InputError(
                f'map of {patch.shape} cells: no free place for a robot '
                f'of {config.robot_radius_m} m'
            )
        spots, spacing_m = _spots(standing, patch.frame)
        around = ranges_around(states, patch.frame.in_cells(spots), patch.frame.resolution)
        nodes = np.array([node.position for node in topology.nodes.values()])
        block_cells = max(1, round(_BLOCK_M / patch.frame.resolution))
        blocks, first, in_sight = _sights(states, standing, nodes, patch.frame, block_cells)
        return Places(
            patch.frame,
            states,
            near,
            standing,
            spots,
            around,
            spacing_m,
            nodes,
            blocks,
            first,
            in_sight,
            block_cells,
        )


def _spots(standing: NDArray[np.int32], frame: GridFrame) -> tuple[Array, float]:
    """Of the cells (N, 2), the one nearest to the middle of each square of a spacing.

    Returns points (P, 2), and the spacing in m.
    """
    spacing = max(_SPACING_M, math.sqrt(len(standing) * frame.resolution**2 / _MAX_PLACES))
    edge = max(1, round(spacing / frame.resolution))
    squares = standing // edge
    off = np.abs(standing - squares * edge - (edge - 1) / 2.0).sum(axis=1)
    order = np.lexsort((off, squares[:, 1], squares[:, 0]))
    sorted_squares = squares[order]
    leads = np.ones(len(order), dtype=np.bool_)
    leads[1:] = (sorted_squares[1:] != sorted_squares[:-1]).any(axis=1)
    return frame.centres_of(standing[order[leads]].astype(np.int64)), edge * frame.resolution


def _near_walls(states: Bytes, resolution: float) -> Bytes:
    """Distance between the centres of each cell (H, W) and of the nearest wall; exact.

    In NEAR_UNIT_M, at most 255.
    """
    units = distance_cells(states == WALL) * resolution / NEAR_UNIT_M
    return np.minimum(units + 0.5, _NEAR_CAP).astype(np.uint8)


@kernel
def free_way(states: Bytes, x: float, y: float, angle: float, most: float) -> tuple[float, int]:
    """Distance from a point (x, y) to the edge of the first cell that is not free, and its state.

    Distance, x and y in cells.
    FREE if there is none within `most`; UNKNOWN if the ray leaves the map.
    """
    rows, cols = states.shape
    col, step_x, next_x, delta_x = axis_setup(x, math.cos(angle))
    row, step_y, next_y, delta_y = axis_setup(y, math.sin(angle))
    way = 0.0
    while way <= most:
        if row < 0 or col < 0 or row >= rows or col >= cols:
            return way, UNKNOWN
        if states[row, col] != FREE:
            return way, int(states[row, col])
        if next_x < next_y:
            way = next_x
            next_x = next_x + delta_x
            col = col + step_x
        else:
            way = next_y
            next_y = next_y + delta_y
            row = row + step_y
    return most, FREE


@kernel
def ranges_around(states: Bytes, points: Array, resolution: float) -> Bytes:
    """Ranges (P, DIRECTIONS) in all directions from points (P, 2), x and y in cells.

    In RANGE_UNIT_M; 255: farther.
    """
    around = np.empty((len(points), DIRECTIONS), dtype=np.uint8)
    most = 255 * RANGE_UNIT_M / resolution
    for i in range(len(points)):
        for k in range(DIRECTIONS):
            angle = 2.0 * math.pi * k / DIRECTIONS
            way, _ = free_way(states, points[i, 0], points[i, 1], angle, most)
            around[i, k] = min(int(way * resolution / RANGE_UNIT_M + 0.5), 255)
    return around


def _sights(
    states: Bytes,
    standing: NDArray[np.int32],
    nodes: Array,
    frame: GridFrame,
    block_cells: int,
) -> tuple[NDArray[np.int32], NDArray[np.int32], Short]:
    """Nodes in sight of each block in which the robot can stand: see Places."""
    rows, cols = states.shape
    blocks = np.full((rows // block_cells + 1, cols // block_cells + 1), -1, dtype=np.int32)
    numbers, leads = np.unique(
        (standing // block_cells) @ np.array([blocks.shape[1], 1], dtype=np.int64),
        return_index=True,
    )
    blocks.ravel()[numbers] = np.arange(len(numbers), dtype=np.int32)
    cells = frame.cells_of(nodes)
    reach = NODE_WINDOW_M / 2.0 / frame.resolution + block_cells
    first, in_sight = _list_sights(states == FREE, standing[leads].astype(np.int64), cells, reach)
    # Coordinates, not numbers of nodes: samples look at these lists in no order, and each look is
    # one short run of whole numbers, which the compiler compares several at a time.
    across = blocks.shape[1]
    corners = np.stack([numbers % across, numbers // across], axis=1) * block_cells
    corner = np.repeat(corners, np.diff(first), axis=0) * frame.resolution
    away = nodes[in_sight] - (frame.origin_x, frame.origin_y) - corner
    return blocks, first, np.ascontiguousarray(np.round(away / SIGHT_UNIT_M).astype(np.int16).T)


@kernel
def _list_sights(
    free: Mask, places: NDArray[np.int64], nodes: NDArray[np.int64], reach: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Of the nodes (M, 2) within a square round each place (N, 2), those in line of sight.

    Before them, the index of the first of each place.
    """
    first = np.zeros(len(places) + 1, dtype=np.int32)
    in_sight = np.empty(max(len(places), 64), dtype=np.int32)
    order = np.argsort(nodes[:, 1])
    sorted_cols = nodes[order, 1]
    count = 0
    for i in range(len(places)):
        row, col = places[i]
        for k in range(np.searchsorted(sorted_cols, col - reach), len(order)):
            node = order[k]
            if nodes[node, 1] > col + reach:
                break
            if abs(nodes[node, 0] - row) <= reach and line_is_clear(
                free, row, col, nodes[node, 0], nodes[node, 1]
            ):
                if count == len(in_sight):
                    in_sight = np.concatenate((in_sight, np.empty_like(in_sight)))
                in_sight[count] = node
                count += 1
        first[i + 1] = count
    return first, in_sight[:count].copy()
