"""Short paths: planned in a window of the map, so that the cost does not grow with the map.

The window holds start and goal with some room around. A path that leaves it is at least as long as
the way to the rim and on to the goal; a cheaper one in the window is the best of the whole map. In
all other cases the wavefront plans on the whole map.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.wavefront import (
    START_ESCAPE_M,
    Obstacles,
    WavefrontConfig,
    find_path,
)
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologyConfig

Cells = NDArray[np.int64]
XY = tuple[float, float]
Mask = NDArray[np.bool_]
_GAP_M = TopologyConfig().max_unknown_gap_m
_ROOM_M = 3.0  # around start and goal
_ROOM_SHARE = 0.5  # of the distance between them, in addition
_MAX_SHARE = 0.5  # of the map: a larger window saves nothing


@dataclass(frozen=True, eq=False)
class _Window:
    """Part of a map; row, col: its first cell; bound_m: least length of a path that leaves it."""

    patch: GridPatch
    row: int
    col: int
    bound_m: float

    def cells(self, cells: Cells) -> Cells:
        """Those of the map's cells (N, 2) that lie in the window, as its own cells (M, 2)."""
        moved = cells - (self.row, self.col)
        return moved[np.all((moved >= 0) & (moved < self.patch.shape), axis=1)]


def plan_short_path(
    patch: GridPatch,
    start_xy: XY,
    goal_xy: XY,
    config: WavefrontConfig,
    obstacles: Obstacles | None,
    trail: Cells,
) -> Array | None:
    """Path (K, 2) from start to goal, m, map frame; None: no path.

    obstacles: points that the map need not contain; trail: cells (N, 2) of the recent path.
    """
    window = _window(patch, start_xy, goal_xy, config, obstacles)
    if window is not None:
        inside = window.cells(trail)
        found = find_path(window.patch, start_xy, goal_xy, config, obstacles, inside)
        if found is not None and found.is_exact and found.cost_m <= window.bound_m:
            return found.points
    found = find_path(patch, start_xy, goal_xy, config, obstacles, trail)
    return None if found is None else found.points


def _window(
    patch: GridPatch,
    start_xy: XY,
    goal_xy: XY,
    config: WavefrontConfig,
    obstacles: Obstacles | None,
) -> _Window | None:
    """Window around start and goal; None where it is no smaller than most of the map."""
    resolution = patch.frame.resolution
    ends = patch.frame.cells_of(np.array([start_xy, goal_xy]))
    shape = np.array(patch.shape)
    if np.any(ends < 0) or np.any(ends >= shape):
        return None
    rim = _rim_cells(resolution, config, obstacles)
    room_m = _ROOM_M + _ROOM_SHARE * math.dist(start_xy, goal_xy)
    room = rim + math.ceil(room_m / resolution)
    low = np.maximum(ends.min(axis=0) - room, 0)
    high = np.minimum(ends.max(axis=0) + room + 1, shape)
    if np.prod(high - low) > _MAX_SHARE * np.prod(shape):
        return None
    row, col = (int(first) for first in low)
    cells = np.ascontiguousarray(patch.cells[row : high[0], col : high[1]])
    bound_m = _least_detour(ends, low + rim, high - 1 - rim, low > 0, high < shape) * resolution
    return _Window(GridPatch(patch.frame.with_origin_at(row, col), cells), row, col, bound_m)


def _least_detour(
    ends: Cells, low: Cells, high: Cells, opens_below: Mask, opens_above: Mask
) -> float:
    """Least length, cells, of a path between two cells (2, 2) over the rim of a window.

    low, high (2,): rows and columns of the rim; opens_below, opens_above (2,): whether the map
    continues beyond it.
    """
    lengths = [math.inf]
    for axis in (0, 1):
        along = float(np.ptp(ends[:, 1 - axis]))
        if opens_below[axis]:
            lengths.append(math.hypot(along, float((ends[:, axis] - low[axis]).sum())))
        if opens_above[axis]:
            lengths.append(math.hypot(along, float((high[axis] - ends[:, axis]).sum())))
    return min(lengths)


def _rim_cells(resolution: float, config: WavefrontConfig, obstacles: Obstacles | None) -> int:
    """Cells at the rim whose cost may differ from that in the map."""
    reach_m = max(config.inflation_radius_m, config.robot_radius_m, START_ESCAPE_M)
    if obstacles is not None:
        reach_m = max(reach_m, obstacles.radius_m)
    return math.ceil((reach_m + _GAP_M) / resolution) + 1
