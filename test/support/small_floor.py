"""A small floor for global localization: world, map and drives."""

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig
from thinmap_ros.sim.world import World

CELL_M = 0.1


def floor(*walls, rows=60, cols=90):
    """Cells (H, W) of a closed hall with walls (row, col, end row, end col)."""
    cells = np.zeros((rows, cols), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    for row, col, end_row, end_col in walls:
        cells[row:end_row, col:end_col] = 100
    return cells


# Without similar places.
OFFICE = floor(
    (0, 30, 35, 32),
    (20, 60, 60, 62),
    (40, 10, 45, 18),
    (8, 70, 12, 76),
    (30, 44, 34, 48),
    (50, 70, 53, 80),
)


def map_of(cells):
    patch = GridPatch(GridFrame(-1.0, 2.0, CELL_M), cells)
    return patch, build(patch, None, TopologyConfig())


def world_of(cells):
    patch, _ = map_of(cells)
    return World.from_patch('floor', patch, np.full(3, np.nan))


def drive(cells, start, moves, seed=0, odometry_at=(5.0, -3.0, 0.7)):
    """Scan, odometry pose and true pose of each step from a start.

    Moves: (m ahead, rad of rotation), one per step.
    """
    world = world_of(cells)
    laser = LaserScanner(LaserScannerConfig(), seed)
    rng = np.random.default_rng(seed)
    T = se2.pose(*start)
    odometry = se2.pose(*odometry_at)
    for k, (ahead, turn) in enumerate([(0.0, 0.0), *moves]):
        step = se2.pose(ahead, 0.0, turn)
        T = se2.compose(T, step)
        noise = rng.normal(size=3) * (0.02 * ahead, 0.01 * ahead, 0.02 * abs(turn) + 0.01 * ahead)
        odometry = se2.compose(odometry, step + noise)
        yield laser.scan(world, T, 200_000_000 * k), odometry, T


# Round a corner of the office: start and moves.
START = (0.8, 3.5, 1.2)
WAY = [(0.15, 0.0)] * 14 + [(0.0, -0.3)] * 4 + [(0.15, 0.0)] * 12
