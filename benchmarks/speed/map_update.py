"""Map update: scans a second in one thread."""

from pathlib import Path

import numpy as np

from benchmarks.rows import Row, at_least
from benchmarks.time_and_memory import best_seconds
from benchmarks.worlds import floors
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig

_TARGET = 20_000.0
_SCANS = 200


def run(worlds: Path, quick: bool) -> list[Row]:
    """One row: 181 beams, 8 m, 10 cm, a real floor, rotation in place at ten places."""
    floor = floors(worlds, 'kth/50052748')[0]
    laser = LaserScanner(LaserScannerConfig(), 0)
    turns = [
        np.array([*start[:2], start[2] + 0.3 * k])
        for start in floor.starts
        for k in range(_SCANS // 10)
    ]
    scans = [(laser.scan(floor.world, T, 0), T) for T in turns]
    grid = OccupancyGrid(PAPER_GRID)
    seconds = best_seconds({'update': lambda: _update(grid, scans)}, 10 if quick else 40)['update']
    return [at_least('map update, 181 beams, 8 m, 10 cm', len(scans) / seconds, _TARGET, 'scans/s')]


def _update(grid: OccupancyGrid, scans: list[tuple[Scan, Array]]) -> None:
    for scan, T in scans:
        grid.add_scan(scan, T)
