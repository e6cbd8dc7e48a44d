"""Travel times: where a robot can drive from where it is, and in how many seconds.

One object for all that choose where to drive. Cells cost what they cost the planner that will drive
there; a search from the robot gives the time to every cell at once. A path begins with a turn to
its first piece, not to the goal, and ends with a turn and a stop.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.planning.grid_search import MAX_WEIGHT, distance_field_from, values_at
from thinmap_ros.core.planning.obstacles import RecentPath
from thinmap_ros.core.planning.path_follower import SpeedConfig
from thinmap_ros.core.planning.wavefront import (
    WavefrontConfig,
    cost_of_free,
    lowest_around,
    ways_out,
)
from thinmap_ros.core.se2 import Array, Cells, Mask
from thinmap_ros.jit import kernel

Array32 = NDArray[np.float32]

_END_M = 0.6  # of a path: the pieces with whose directions it begins and ends


class Arrivals(NamedTuple):
    """When and with which heading a robot arrives at some places, before it turns there.

    seconds (N,): inf where it cannot get; headings (N,), rad, map frame.
    """

    seconds: Array
    headings: Array


class TravelTimes:
    """Times from the pose of a robot to all cells of a map.

    traversable (H, W): cells where the robot fits, reachable or not; allowed (H, W): these, and
    what it may cross to leave its place; seconds (H, W): time to drive to each cell, without turns;
    inf where it cannot get; all on the cells of `frame`.
    """

    def __init__(self, planner: WavefrontConfig, controller: SpeedConfig) -> None:
        self.frame = GridFrame(0.0, 0.0, 1.0)
        self.traversable: Mask = np.zeros((0, 0), dtype=np.bool_)
        self.allowed = self.traversable
        self.seconds: Array32 = np.zeros((0, 0), dtype=np.float32)
        self._planner = planner
        self._controller = controller
        self._recent_path = RecentPath()
        self._weights = np.zeros((0, 0), dtype=np.uint8)  # of traversable cells; 0 elsewhere
        self._passable = self.traversable
        self._pose: Array = np.zeros(3)

    @property
    def speed_m_s(self) -> float:
        """Largest speed of the robot."""
        return self._controller.max_speed_m_s

    @property
    def start(self) -> tuple[int, int]:
        """Cell where the robot is."""
        return self._cell_of(self._pose)

    @property
    def reachable(self) -> Mask:
        """Traversable cells (H, W) to which the robot can get."""
        return np.isfinite(self.seconds) & self.traversable

    def add_pose(self, T_map_base: Array) -> None:
        """Add a pose (3,): the robot can return over its recent path."""
        self._recent_path.add_pose(T_map_base)

    def update(self, free: Mask, passable: Mask, frame: GridFrame, T_map_base: Array) -> None:
        """Find all times from a pose (3,).

        free, passable (H, W): known free cells, gaps closed, and all that are not occupied.
        """
        self.frame = frame
        self._pose = T_map_base
        self._passable = passable
        cost = cost_of_free(free, passable, frame.resolution, self._planner)
        self.traversable = np.isfinite(cost)
        cost[~self.traversable] = 0.0
        self._weights = np.rint(np.minimum(cost, MAX_WEIGHT)).astype(np.uint8)
        weights = self._weights_from(T_map_base, self._recent_path.cells(frame, free.shape))
        self.allowed = weights > 0
        self.seconds = self._search(weights, T_map_base)

    def arrivals(self, cells: Cells) -> Arrivals:
        """When the robot stops at some cells (N, 2), and with which heading it comes."""
        reach = _END_M / self.frame.resolution
        first, last = _ends(self.seconds, cells, self.start, reach)
        # Beside the robot there is no path whose ends have directions.
        begins = np.where(np.isnan(first), self._pose[2], first)
        headings = np.where(np.isnan(last), self._pose[2], last)
        turns_s = (
            np.abs(se2.wrap(begins - self._pose[2])) / self._controller.max_angular_speed_rad_s
        )
        stop_s = self.speed_m_s / self._controller.max_acceleration_m_s2
        return Arrivals(values_at(self.seconds, cells) + turns_s + stop_s, headings)

    def seconds_to(self, goals: Array) -> Array:
        """Time (N,), s, to goals (N, 3) from where the robot is, turns and stop included."""
        arrivals = self.arrivals(self.frame.cells_of(goals[:, :2]))
        return arrivals.seconds + self.turn_s(goals[:, 2] - arrivals.headings)

    def seconds_from(self, T_map_base: Array, goals: Array) -> Array:
        """Time (N,), s, to drive to goals (N, 3) from the pose (3,) of another robot.

        Where the map shows no path, that of a straight line: the other one may have one.
        """
        field = self._search(self._weights_from(T_map_base), T_map_base)
        found = values_at(field, self.frame.cells_of(goals[:, :2]))
        straight_s = np.hypot(*(goals[:, :2] - T_map_base[:2]).T) / self.speed_m_s
        return np.asarray(np.where(np.isfinite(found), np.maximum(found, straight_s), straight_s))

    def turn_s(self, angles: Array) -> Array:
        """Time (N,), s, of turns by some angles (N,), rad."""
        return np.abs(se2.wrap(angles)) / self._controller.max_angular_speed_rad_s

    def _weights_from(self, T_map_base: Array, trail: Cells | None = None) -> NDArray[np.uint8]:
        """Cost of each cell (H, W) as a small number, 0: none; trail (N, 2): of the recent path."""
        weights = self._weights.copy()
        start = self._cell_of(T_map_base)
        if self._holds(start):
            occupied = ~self._passable
            cell_m = self.frame.resolution
            ways = ways_out(self.traversable, occupied, start, cell_m, self._planner, trail)
            weights[tuple(ways[~self.traversable[tuple(ways.T)]].T)] = MAX_WEIGHT
        return weights

    def _search(self, weights: NDArray[np.uint8], T_map_base: Array) -> Array32:
        lengths = distance_field_from(weights, self._cell_of(T_map_base))
        # Half the memory; the order of lengths is that of whole numbers of steps.
        return (lengths * (self.frame.resolution / self.speed_m_s)).astype(np.float32)

    def _cell_of(self, T_map_base: Array) -> tuple[int, int]:
        row, col = self.frame.cells_of(T_map_base[None, :2])[0].tolist()
        return row, col

    def _holds(self, cell: tuple[int, int]) -> bool:
        rows, cols = self._weights.shape
        return bool(0 <= cell[0] < rows and 0 <= cell[1] < cols)


@kernel
def _ends(
    seconds: Array32, cells: Cells, start: tuple[int, int], reach: float
) -> tuple[Array, Array]:
    """Directions, rad, of the first and the last piece of the path to each cell (N, 2).

    Each piece ends `reach` cells away from its end of the path; NaN where there is no path, or
    where it is no longer than a cell or two.
    """
    rows, cols = seconds.shape
    first = np.full(cells.shape[0], np.nan)
    last = np.full(cells.shape[0], np.nan)
    # Where the path of a cell leaves the first piece, as index + 1: paths to many cells join.
    gates = np.zeros(seconds.size, dtype=np.int32)
    steps = np.empty(seconds.size, dtype=np.int32)
    for i in range(cells.shape[0]):
        row, col = cells[i]
        if not (0 <= row < rows and 0 <= col < cols and seconds[row, col] < np.inf):
            continue
        count = 0
        has_end = False
        gate = 0
        while math.hypot(row - start[0], col - start[1]) > reach:
            here = row * cols + col
            if gate == 0:
                gate = gates[here]
            if gate > 0 and has_end:
                break
            steps[count] = here
            count += 1
            row, col = lowest_around(seconds, row, col)
            if row * cols + col == here:
                break
            if not has_end and math.hypot(row - cells[i, 0], col - cells[i, 1]) >= reach:
                last[i] = math.atan2(cells[i, 0] - row, cells[i, 1] - col)
                has_end = True
        if gate == 0:
            gate = (cells[i, 0] * cols + cells[i, 1] if count == 0 else row * cols + col) + 1
        for k in range(count):
            gates[steps[k]] = gate
        down = (gate - 1) // cols - start[0]
        right = (gate - 1) % cols - start[1]
        if math.hypot(down, right) > 1.5:
            first[i] = math.atan2(down, right)
        if not has_end:
            last[i] = first[i]
    return first, last
