"""Wavefront planner (gradient method): navigation function and gradient descent.

F(P) = sum I(p_i) + sum A(p_i, p_i+1): the intrinsic cost I falls from `inflation_cost` at the
closest allowed distance to an obstacle to zero at `inflation_radius_m`, the adjacency cost A is the
distance moved. The wave propagates from cell to cell by solving |grad F| = 1 + I, so that the cost
of a path does not depend on its direction.
Source: topological map paper section 3.2; Konolige, "A gradient method for realtime robot control",
2000; Sethian, "A fast marching level set method for monotonically advancing fronts", 1996.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.config import Config, parameter, robot_radius
from thinmap_ros.core.grid.fields import nearest_true, reachable
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.grid_search import disc
from thinmap_ros.core.se2 import Array, Cell, Cells, Mask
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.thinning import column_distance, known_free
from thinmap_ros.jit import inlined, kernel

_STEP_CELLS = 0.5
_TOPOLOGY = TopologyConfig()
_INFLATION_RADIUS_M = 0.6
_BESIDE_BODY_M = 0.35  # so much wider than the usual radius is the usual inflation
# Distances are whole cells times the resolution:
# rounding must not close a passage as wide as the robot.
_HAIR_M = 1e-6


@dataclass(frozen=True)
class WavefrontConfig(Config):
    """Parameters of the costs of cells."""

    robot_radius_m: float = robot_radius()
    inflation_radius_m: float = parameter(
        _INFLATION_RADIUS_M,
        'Distance from obstacles below which cells cost more (m). Raise it to keep to the middle '
        'of rooms, lower it to cut corners.',
        low=0.0,
        high=10.0,
    )
    inflation_cost: float = parameter(
        2.0,
        'Additional cost per metre next to an obstacle. Raise it to keep away from obstacles, '
        'lower it for shorter paths.',
        low=0.0,
        high=100.0,
    )
    allow_unknown: bool = parameter(
        False, 'Whether paths may cross unknown space, as for the planners of Nav2.'
    )
    unknown_cost: float = parameter(
        3.0,
        'Cost per metre of unknown space, where it is allowed. Raise it to drive through unknown '
        'space only where there is no other path.',
        low=0.0,
        high=1000.0,
    )
    goal_search_radius_m: float = parameter(
        0.3,
        'A goal in collision is moved by at most this distance (m). 0: such a goal fails.',
        low=0.0,
        high=5.0,
    )
    escape_cost: float = 10.0  # of these cells, and of those of the recent path


def start_escape_m(robot_radius_m: float) -> float:
    """Distance, m, within which a start in collision may leave inflated cells.

    That of the usual inflation, which is farther from the centre of a larger body: lasers at its
    corners do not see the floor below it, so that it starts amid unknown cells.
    """
    return max(_INFLATION_RADIUS_M, robot_radius_m + _BESIDE_BODY_M)


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Points (N, 2), m, map frame, that the map need not contain, and the distance to keep, m."""

    points: Array
    radius_m: float


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """A path (K, 2), m, map frame.

    cost_m: F at its start; is_exact: whether it ends at the goal, and not beside it.
    """

    points: Array
    cost_m: float
    is_exact: bool


def plan(
    patch: GridPatch,
    start_xy: tuple[float, float],
    goal_xy: tuple[float, float],
    config: WavefrontConfig,
) -> Array | None:
    """Path (K, 2) from start to goal, m, map frame; None: no path. See `find_path`."""
    found = find_path(patch, start_xy, goal_xy, config)
    return None if found is None else found.points


def find_path(
    patch: GridPatch,
    start_xy: tuple[float, float],
    goal_xy: tuple[float, float],
    config: WavefrontConfig,
    obstacles: Obstacles | None = None,
    trail: Cells | None = None,
    band: Mask | None = None,
) -> PlannedPath | None:
    """Path from start to goal, m, map frame, points half a cell apart; None: no path.

    The path ends at the goal, or at the nearest allowed cell within goal_search_radius_m. Obstacle
    points are not rounded to cells: noise would make walls one cell thicker, and passages too
    narrow. trail: cells
    (N, 2) of the recent path; the robot may return over them unless they are occupied now. band:
    cells (H, W) that the path may use; all, if None.
    """
    cells = patch.frame.cells_of(np.array([start_xy, goal_xy]))
    if not patch.contains(np.array([start_xy, goal_xy])).all():
        return None
    cost = cost_of_cells(patch, config)
    occupied = patch.occupied.copy()
    cell_m = patch.frame.resolution
    if obstacles is not None:
        points = obstacles.points[patch.contains(obstacles.points)]
        at = patch.frame.cells_of(points)
        occupied[at[:, 0], at[:, 1]] = True
        inflation_radius = config.inflation_radius_m / cell_m
        _inflate_points(
            cost,
            patch.frame.in_cells(points),
            obstacles.radius_m / cell_m,
            inflation_radius,
            config.inflation_cost,
        )
    start = (int(cells[0, 0]), int(cells[0, 1]))
    wished = (int(cells[1, 0]), int(cells[1, 1]))
    ways = tuple(ways_out(np.isfinite(cost), occupied, start, cell_m, config, trail).T)
    cost[ways] = np.minimum(cost[ways], config.escape_cost)
    if band is not None:
        cost[~band] = np.inf
    goal = nearest_true(
        reachable(np.isfinite(cost), np.array([start])),
        wished,
        config.goal_search_radius_m / patch.frame.resolution,
    )
    if goal is None:
        return None
    field = navigation_function(cost, goal, start)
    x, y = patch.frame.in_cells(np.array([start_xy]))[0].tolist()
    path = trace_gradient_path(field, x, y, *goal) * patch.frame.resolution
    path += (patch.frame.origin_x, patch.frame.origin_y)
    path[0] = start_xy
    is_exact = goal == wished
    return PlannedPath(
        np.concatenate([path, [goal_xy]]) if is_exact else path,
        float(field[start]) * patch.frame.resolution,
        is_exact,
    )


def cost_of_cells(patch: GridPatch, config: WavefrontConfig) -> Array:
    """Cost per unit of distance in each cell (H, W): 1 + I; inf if the robot would collide."""
    # With the gaps between beams that the graph closes: without them, a tenth of the reachable
    # cells is lost while a robot maps. Scans show an obstacle in a gap before it gets there.
    free = known_free(patch, _TOPOLOGY)
    return cost_of_free(free, ~patch.occupied, patch.frame.resolution, config)


def cost_of_free(free: Mask, passable: Mask, resolution: float, config: WavefrontConfig) -> Array:
    """As `cost_of_cells`, where free cells (H, W), and those that are not occupied, are known."""
    reach = max(math.ceil(max(config.inflation_radius_m, config.robot_radius_m) / resolution), 1)
    distance_m = np.sqrt(np.arange(2 * (reach + 1) ** 2 + 1)) * resolution
    spread = max(config.inflation_radius_m - config.robot_radius_m, 1e-6)
    nearness = np.clip((config.inflation_radius_m - distance_m) / spread, 0.0, 1.0)
    allowed = distance_m >= config.robot_radius_m - _HAIR_M
    table = np.where(allowed, 1.0 + config.inflation_cost * nearness * nearness, np.inf)
    cost = _look_up(column_distance(passable if config.allow_unknown else free), reach, table)
    if config.allow_unknown:
        cost += np.where(free, 0.0, config.unknown_cost)
    return cost


def navigation_function(
    cost: Array, goal: tuple[int, int], start: tuple[int, int] | None = None
) -> Array:
    """Minimum cost F, in cells, from each cell (H, W) to the goal (row, col); inf: no path.

    The wave steps over the edges of cells, and over a corner where neither cell beside it is
    allowed: it passes what the graph passes. With a start (row, col), it stops shortly after it has
    reached the start, and more distant cells remain inf.
    """
    row, col = (-1, -1) if start is None else start
    return np.asarray(_march(cost, goal[0], goal[1], row, col))


def ways_out(
    allowed: Mask,
    occupied: Mask,
    start: Cell,
    resolution: float,
    config: WavefrontConfig,
    trail: Cells | None = None,
) -> Cells:
    """Cells (N, 2) that a robot may cross, at a high cost, to leave its place.

    The inflated ones around a start that is not allowed, and those of its recent path (M, 2).
    Occupied cells (H, W) stay forbidden, except the cell of the robot itself. So do cells from
    which a step over a corner leads through a wall.
    """
    back = np.zeros((0, 2), dtype=np.int64) if trail is None else trail
    back = back[~occupied[tuple(back.T)]]
    if allowed[start]:
        return np.asarray(back[~_beside_thin_wall(occupied, back)])
    where, within = disc(allowed, start, start_escape_m(config.robot_radius_m) / resolution)
    opened = np.argwhere(within & ~allowed[where] & ~occupied[where])
    opened += (where[0].start, where[1].start)
    ways = np.concatenate([opened, back])
    return np.concatenate([ways[~_beside_thin_wall(occupied, ways)], [start]])


def _beside_thin_wall(occupied: Mask, cells: Cells) -> Mask:
    """Whether a diagonal step from cells (N, 2) leads between two occupied ones (H, W): (N,)."""
    rows, cols = cells.T
    found = np.zeros(len(cells), dtype=np.bool_)
    for down, right in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        r = np.clip(rows + down, 0, occupied.shape[0] - 1)
        c = np.clip(cols + right, 0, occupied.shape[1] - 1)
        found |= occupied[r, cols] & occupied[rows, c] & ~occupied[r, c]
    return found


@kernel
def _inflate_points(
    cost: Array, points: Array, radius: float, inflation_radius: float, weight: float
) -> None:
    """Inflate points (N, 2), in cells: raise the cost of the cells (H, W) near them.

    Cells within `radius` are forbidden; the cost falls to zero at `inflation_radius`.
    """
    reach = int(math.ceil(max(radius, inflation_radius))) + 1
    spread = max(inflation_radius - radius, 1e-6)
    for i in range(points.shape[0]):
        x = points[i, 0] - 0.5
        y = points[i, 1] - 0.5
        row = int(round(y))
        col = int(round(x))
        for r in range(max(row - reach, 0), min(row + reach + 1, cost.shape[0])):
            for c in range(max(col - reach, 0), min(col + reach + 1, cost.shape[1])):
                away = math.hypot(r - y, c - x)
                nearness = max(inflation_radius - away, 0.0) / spread
                near_cost = 1.0 + weight * nearness * nearness
                cost[r, c] = np.inf if away < radius else max(cost[r, c], near_cost)


@kernel
def _look_up(distance: NDArray[np.int16], reach: int, table: Array) -> Array:
    """table[squared distance in cells to the nearest obstacle cell] for each cell (H, W).

    Cells outside the array are obstacles. distance: from `column_distance`. Distances beyond
    `reach` cells along a row or column count as reach + 1.
    """
    rows, cols = distance.shape
    result = np.empty((rows, cols))
    # Obstacle columns on both sides; int16, so that the loops vectorize.
    line = np.zeros(cols + 2 * reach, dtype=np.int16)
    most = np.int16(reach + 1)
    squared = np.empty(cols, dtype=np.int16)
    for row in range(rows):
        for col in range(cols):
            here = min(distance[row, col], most)
            line[reach + col] = here * here
        squared[:] = line[reach : reach + cols]
        for k in range(1, reach + 1):
            step = np.int16(k * k)
            # Slices that are indexed from 0: the compiler vectorizes the comparisons.
            left = line[reach - k : reach - k + cols]
            right = line[reach + k : reach + k + cols]
            for col in range(cols):
                beside = np.int16((left[col] if left[col] < right[col] else right[col]) + step)
                squared[col] = beside if beside < squared[col] else squared[col]
        for col in range(cols):
            result[row, col] = table[squared[col]]
    return result


@kernel
def _push(keys: Array, cells: Cells, count: int, key: float, cell: int) -> None:
    place = count
    while place > 0:
        parent = (place - 1) // 2
        if keys[parent] <= key:
            break
        keys[place] = keys[parent]
        cells[place] = cells[parent]
        place = parent
    keys[place] = key
    cells[place] = cell


@kernel
def _drop_first(keys: Array, cells: Cells, count: int) -> None:
    """Remove the smallest key from a binary heap of `count` entries."""
    key = keys[count - 1]
    cell = cells[count - 1]
    place = 0
    while True:
        child = 2 * place + 1
        if child >= count - 1:
            break
        if child + 1 < count - 1 and keys[child + 1] < keys[child]:
            child += 1
        if key <= keys[child]:
            break
        keys[place] = keys[child]
        cells[place] = cells[child]
        place = child
    keys[place] = key
    cells[place] = cell


@kernel
def _march(cost: Array, goal_row: int, goal_col: int, start_row: int, start_col: int) -> Array:
    rows, cols = cost.shape
    field = np.full((rows, cols), np.inf)
    done = np.zeros((rows, cols), dtype=np.bool_)
    keys = np.empty(4 * rows * cols + 1)
    cells = np.empty(4 * rows * cols + 1, dtype=np.int64)
    field[goal_row, goal_col] = 0.0
    keys[0] = 0.0
    cells[0] = goal_row * cols + goal_col
    count = 1
    stop = np.inf
    # A cell pushes at most four others: a corner counts where both edges beside it are blocked.
    while count > 0 and keys[0] <= stop:
        row = cells[0] // cols
        col = cells[0] % cols
        _drop_first(keys, cells, count)
        count -= 1
        if done[row, col]:
            continue
        done[row, col] = True
        if row == start_row and col == start_col:
            # Some cells more, so that the gradient at the start is that of the complete field.
            stop = field[row, col] + 3.0 * cost[row, col]
        blocked = 0
        for side in range(4):
            r = row + (side == 0) - (side == 1)
            c = col + (side == 2) - (side == 3)
            if r < 0 or r >= rows or c < 0 or c >= cols or cost[r, c] == np.inf:
                blocked += 1
                continue
            if done[r, c]:
                continue
            across = np.inf
            along = np.inf
            if r > 0:
                across = field[r - 1, c]
            if r < rows - 1:
                across = min(across, field[r + 1, c])
            if c > 0:
                along = field[r, c - 1]
            if c < cols - 1:
                along = min(along, field[r, c + 1])
            low = min(across, along)
            gap = abs(across - along)
            f = cost[r, c]
            value = low + f
            if gap < f:
                value = 0.5 * (across + along + math.sqrt(2.0 * f * f - gap * gap))
            if value < field[r, c]:
                field[r, c] = value
                _push(keys, cells, count, value, r * cols + c)
                count += 1
        for corner in range(4 if blocked > 1 else 0):
            r = row + 1 - 2 * (corner // 2)
            c = col + 1 - 2 * (corner % 2)
            if r < 0 or r >= rows or c < 0 or c >= cols or done[r, c]:
                continue
            value = field[row, col] + math.sqrt(2.0) * cost[r, c]
            if cost[row, c] == np.inf and cost[r, col] == np.inf and value < field[r, c]:
                field[r, c] = value
                _push(keys, cells, count, value, r * cols + c)
                count += 1
    return field


@kernel
def _slope(field: Array, row: int, col: int, out: Array) -> bool:
    """Downhill direction (x, y) in a cell from its lower neighbours; False if there is none."""
    rows, cols = field.shape
    here = field[row, col]
    out[0] = 0.0
    out[1] = 0.0
    if here == np.inf:
        return False
    left = field[row, col - 1] if col > 0 else np.inf
    right = field[row, col + 1] if col < cols - 1 else np.inf
    below = field[row - 1, col] if row > 0 else np.inf
    above = field[row + 1, col] if row < rows - 1 else np.inf
    if min(left, right) < here:
        out[0] = here - right if right < left else left - here
    if min(below, above) < here:
        out[1] = here - above if above < below else below - here
    length = math.hypot(out[0], out[1])
    if length == 0.0:
        return False
    out[0] = out[0] / length
    out[1] = out[1] / length
    return True


@inlined
def _is_over_corner(field: Array, row: int, col: int, r: int, c: int) -> bool:
    """Whether a step from (row, col) to a neighbour leads between two cells without a path."""
    return bool(r != row and c != col and field[row, c] == np.inf and field[r, col] == np.inf)


@kernel
def lowest_around(field: NDArray[np.floating[Any]], row: int, col: int) -> tuple[int, int]:
    """The lowest of the eight neighbours; diagonal if both cells beside have a path, or neither."""
    rows, cols = field.shape
    best_row = row
    best_col = col
    for r in range(max(row - 1, 0), min(row + 2, rows)):
        for c in range(max(col - 1, 0), min(col + 2, cols)):
            is_cut = (field[row, c] < np.inf) != (field[r, col] < np.inf)
            if not is_cut and field[r, c] < field[best_row, best_col]:
                best_row = r
                best_col = c
    return best_row, best_col


@kernel
def trace_gradient_path(field: Array, x: float, y: float, goal_row: int, goal_col: int) -> Array:
    """Path (K, 2) by gradient descent on a navigation function (H, W), in cells (x, y).

    It leads from a point to the centre of the goal cell, in steps of half a cell, with bilinear
    interpolation of the gradient. Each new cell is lower than the previous one. Where the gradient
    does not lead to a lower cell (beside walls, or after several steps in one cell), the path goes
    to the centre of the lowest neighbour. Over a corner between two cells without a path it goes
    from centre to centre.
    """
    rows, cols = field.shape
    path = np.empty((8 * field.size + 8, 2))
    slope = np.empty(2)
    path[0, 0] = x
    path[0, 1] = y
    row = int(math.floor(y))
    col = int(math.floor(x))
    count = 1
    stays = 0
    while (row != goal_row or col != goal_col) and count < path.shape[0] - 2:
        dx = 0.0
        dy = 0.0
        first_row = int(math.floor(y - 0.5))
        first_col = int(math.floor(x - 0.5))
        for r in range(max(first_row, 0), min(first_row + 2, rows)):
            for c in range(max(first_col, 0), min(first_col + 2, cols)):
                if _slope(field, r, c, slope):
                    share = (1.0 - abs(x - c - 0.5)) * (1.0 - abs(y - r - 0.5))
                    dx = dx + share * slope[0]
                    dy = dy + share * slope[1]
        length = max(math.hypot(dx, dy), 1e-9)
        next_x = x + _STEP_CELLS * dx / length
        next_y = y + _STEP_CELLS * dy / length
        r = int(math.floor(next_y))
        c = int(math.floor(next_x))
        stays = stays + 1 if r == row and c == col else 0
        inside = 0 <= r < rows and 0 <= c < cols
        if (
            stays > 3
            or not inside
            or (stays == 0 and not field[r, c] < field[row, col])
            or _is_over_corner(field, row, col, r, c)
        ):
            r, c = lowest_around(field, row, col)
            next_x = c + 0.5
            next_y = r + 0.5
            stays = 0
            if _is_over_corner(field, row, col, r, c):
                path[count, 0] = col + 0.5
                path[count, 1] = row + 0.5
                count += 1
        x = next_x
        y = next_y
        row = r
        col = c
        path[count, 0] = x
        path[count, 1] = y
        count += 1
    path[count, 0] = goal_col + 0.5
    path[count, 1] = goal_row + 0.5
    return path[: count + 1].copy()
