"""Layers from the grid to the edges of the map; each receives the cells that changed."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import Array, Cell, Cells, Mask
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.layers.deletion_times import update_skeleton
from thinmap_ros.core.topology.layers.free_space import FreeSpace, kept_above, nearest_free
from thinmap_ros.core.topology.layers.lattice import Lattice, rows_and_cols
from thinmap_ros.core.topology.layers.pruning import (
    COLUMNS,
    Limits,
    Paths,
    edge_cells,
    find_paths,
    measure,
    node_hash,
    prune,
)
from thinmap_ros.core.topology.layers.skeleton_graph import CELL, NONE, A, SkeletonGraph, components
from thinmap_ros.core.topology.registry import EMPTY_BOX, Changes

_BLOCK = 10  # cells; one place of the robot in a block is enough
_REACH = 160  # cells from a place to the skeleton that are tried first
_MAX_REACH = 2560


class RobotPlaces:
    """Places of the robot: parts of the skeleton without any are not published.

    A place that is no longer traversable is removed.
    """

    def __init__(self, reach: int) -> None:
        """reach: largest distance from the robot to a traversable cell, in cells."""
        self._reach = reach
        # Of each place a traversable cell, and a skeleton cell of its part; 0: removed.
        self._cells: Cells = np.empty(0, dtype=np.int64)
        self._kept: Cells = np.empty(0, dtype=np.int64)
        self._numbers: dict[tuple[int, int], int] = {}

    @property
    def cells(self) -> Cells:
        """A traversable cell (N,) at or near each place."""
        return np.asarray(self._cells[self._cells != 0])

    def add(self, lattice: Lattice, row: int, col: int) -> bool:
        """Add the place at a row and column; returns whether it is new."""
        block = (row // _BLOCK, col // _BLOCK)
        number = self._numbers.get(block)
        if number is not None and lattice.cells[self._cells[number]]['free']:
            return False
        cell = int(nearest_free(lattice, row, col, self._reach))
        if cell == 0:
            return False
        self._numbers[block] = len(self._cells)
        self._cells = np.append(self._cells, cell)
        self._kept = np.append(self._kept, 0)
        return True

    def owners(self, lattice: Lattice) -> Cells:
        """Chain or vertex of the skeleton in the part of each place, as `owner` of a cell."""
        is_gone = lattice.cells['free'][self._cells] == 0
        self._cells[is_gone] = 0
        self._kept[is_gone] = 0
        is_stale = (lattice.cells['kept'][self._kept] == 0) & ~is_gone
        for k in np.flatnonzero(is_stale).tolist():
            self._kept[k] = _kept_near(lattice, int(self._cells[k]))
        return np.asarray(lattice.cells['owner'][self._kept], dtype=np.int64)


def _kept_near(lattice: Lattice, cell: int) -> int:
    """A skeleton cell of the part of a traversable cell; 0: none."""
    reach = _REACH
    found = int(kept_above(lattice, cell, reach))
    while found == 0 and reach < _MAX_REACH:
        reach *= 2
        found = int(kept_above(lattice, cell, reach))
    return found


class Span(NamedTuple):
    """A rectangle of cells."""

    row: int
    col: int
    rows: int
    cols: int

    def bounds_m(self, lattice: GridFrame) -> Array:
        """x, y, end x and end y, m, map frame."""
        low = np.array([lattice.origin_x, lattice.origin_y])
        corners = np.array([self.col, self.row, self.col + self.cols, self.row + self.rows])
        return np.concatenate((low, low)) + corners * lattice.resolution


class Layers:
    """Free space, deletion times and skeleton graph of the whole map, and the robot's places.

    `lattice`: the cells, valid until the next update.
    """

    def __init__(self, resolution_m: float, config: TopologyConfig) -> None:
        self._space = FreeSpace(config, resolution_m)
        self._skeleton = SkeletonGraph(self._space.lattice)
        self._limits = Limits.of(config, resolution_m)
        self._robot = RobotPlaces(round(config.seed_search_radius_m / resolution_m))
        self._measured = np.full((0, COLUMNS), NONE, dtype=np.int64)
        # Since the last changes of the edges: cells of the grid that changed.
        self._changed: Cells = np.empty(0, dtype=np.int64)
        self._flipped: Cells = np.empty(0, dtype=np.int64)
        self._has_new_place = False

    @property
    def lattice(self) -> Lattice:
        """The cells, for kernels; valid until the next update."""
        return self._space.lattice

    def fill(
        self,
        patch: GridPatch,
        place: Cell,
        free: Mask | None = None,
        lines: Mask | None = None,
    ) -> None:
        """Set all cells at once by a patch whose first cell is at a place; empty before.

        free (H, W): traversable cells; None: all where the robot fits. lines (H, W): cells that are
        thinned instead of these.
        """
        kept = self._space.fill(patch, free, *place, lines)
        self._skeleton.update(self.lattice, kept)

    def update_free_space(self, window: GridPatch, place: Cell) -> int:
        """Update the free space by a window whose first cell is at a place.

        Returns the number of cells that changed.
        """
        if self._space.is_empty:
            self.fill(window, place)
            return window.cells.size
        self._changed, self._flipped = self._space.update(window.cells, *place)
        return self._changed.size

    def update_skeleton(self) -> None:
        """Thin the free space where it changed, and trace the skeleton again there."""
        changed = update_skeleton(self.lattice, self._flipped)
        self._flipped = self._flipped[:0]
        self._skeleton.update(self.lattice, changed)

    def mark_robot(self, place: Cell) -> None:
        """Add a place of the robot: only parts of the map where it has been are published."""
        self._has_new_place |= self._robot.add(self.lattice, *place)

    def has_new_parts(self) -> bool:
        """Whether the robot has been at a new place since the last changes of the edges."""
        return self._has_new_place

    def robot_places(self) -> Cells:
        """Row and column (N, 2) of the places of the robot."""
        return rows_and_cols(self.lattice, self._robot.cells)

    def states(self) -> tuple[Cells, NDArray[np.uint8]]:
        """Row and column (N, 2) of the tiles with known states, and these (N, TILE, TILE)."""
        return self._space.states()

    def edge_changes(self, known: set[int], is_everywhere: bool = False) -> Changes:
        """Changes of the edges since those with the known hashes.

        is_everywhere: also parts in which the robot has not been.
        """
        places = rows_and_cols(self.lattice, self._changed)
        self._changed = self._changed[:0]
        self._has_new_place = False
        paths, degree = self._paths(places)
        arrays = self._skeleton.arrays
        is_shown = arrays.vertices[:, CELL] != NONE
        if not is_everywhere:
            is_shown &= self._is_reached()
        edges = paths.edges[is_shown[paths.ends[paths.edges, 0]]]
        rows = dict(zip(paths.hashes[edges].tolist(), edges.tolist(), strict=True))
        lone = arrays.vertices[(degree == 0) & is_shown, CELL].tolist()
        cells = {int(node_hash(arrays, cell)): cell for cell in lone}
        fresh = {key: edge_cells(arrays, paths, rows[key]) for key in rows.keys() - known}
        fresh |= {key: np.array([cells[key]]) for key in cells.keys() - known}
        return Changes(fresh, known - rows.keys() - cells.keys(), places)

    def _paths(self, places: Cells) -> tuple[Paths, Cells]:
        """Paths between nodes, and the degree of each vertex (V,); places (K, 2) have changed."""
        arrays = self._skeleton.arrays
        missing = len(arrays.vertices) - len(self._measured)
        if missing > 0:
            blank = np.full((missing, COLUMNS), NONE, dtype=np.int64)
            self._measured = np.concatenate((self._measured, blank))
        box = EMPTY_BOX
        if len(places):
            box = np.concatenate((places.min(axis=0), places.max(axis=0)))
        measure(arrays, self._measured, box)
        alive, degree = prune(arrays, self._measured, self._limits)
        paths = find_paths(arrays, self._measured, alive, degree, self._limits.merge_distance)
        return paths, degree

    def _is_reached(self) -> Mask:
        """Whether each vertex (V,) belongs to a part in which the robot has been."""
        arrays = self._skeleton.arrays
        part = components(arrays)
        owners = self._robot.owners(self.lattice)
        reached = np.zeros(part.max(initial=0) + 1, dtype=np.bool_)
        reached[part[arrays.chains[owners[owners > 0] - 1, A]]] = True
        reached[part[-owners[owners < 0] - 1]] = True
        return np.asarray(reached[part])
