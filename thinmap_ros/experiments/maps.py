"""Maps that several experiments begin with."""

from collections.abc import Iterable

import numpy as np

from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.experiments.drives import world_of
from thinmap_ros.sim.drives import DriveSample
from thinmap_ros.sim.world import World, inside_of

CELL_M = PAPER_GRID.resolution_m


def grid_of(samples: Iterable[DriveSample]) -> OccupancyGrid:
    """Grid of scans at their true poses."""
    grid = OccupancyGrid(PAPER_GRID)
    for sample in samples:
        grid.add_scan(sample.scan, sample.T_world_base)
    return grid


def patch_at_rest(name: str) -> GridPatch:
    """The map of a world as it is: what the start is joined with is free, 0.1 m a cell."""
    return patch_of_world(world_of(name))


def patch_of_world(world: World) -> GridPatch:
    """0.1 m cells: free where wholly so and joined to the start, unknown outside, else occupied."""
    low = np.floor(np.array([world.frame.origin_x, world.frame.origin_y]) / CELL_M - 1e-6)
    rows, cols = world.occupied.shape
    cells = np.floor(world.frame.centres_of(np.array([[rows - 1, cols - 1]]))[0] / CELL_M) - low + 1
    frame = GridFrame(float(low[0]) * CELL_M, float(low[1]) * CELL_M, CELL_M)
    states = np.full((int(cells[1]), int(cells[0])), -1, dtype=np.int8)
    free = frame.cells_of(world.frame.centres_of(np.argwhere(inside_of(world))))
    solid = frame.cells_of(world.frame.centres_of(np.argwhere(world.occupied)))
    states[free[:, 0], free[:, 1]] = 0
    states[solid[:, 0], solid[:, 1]] = 100
    return GridPatch(frame, states)
