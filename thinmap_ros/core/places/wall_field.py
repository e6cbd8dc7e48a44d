"""Distances to the walls of a map, and what it knows of each cell."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.places.views import LATTICE_M, View
from thinmap_ros.core.se2 import Array, Mask
from thinmap_ros.jit import inlined, kernel

# States of a cell.
UNKNOWN = 0
FREE = 1
WALL = 2
FAR = 3  # from all keyframes: known in part only

_POINT_SIGMA_M = 0.05  # of a point around its wall, once it is matched

# Levenberg-Marquardt: a view without information in a direction does not move that way.
_DAMPING = 1.0
_MAX_STEP_M = 0.3
_MAX_STEP_RAD = 0.08
_CONVERGED = 0.01  # of the largest step
_ITERATIONS = 5  # for each width


class FieldArrays(NamedTuple):
    """Wall distances of a map as arrays.

    near (H, W): distance to the nearest wall in cells, at most reach; state (H, W): UNKNOWN, FREE,
    WALL or FAR; origin_x, origin_y: corner of cell (0, 0), m.
    """

    near: NDArray[np.float32]
    state: NDArray[np.uint8]
    origin_x: float
    origin_y: float
    cell_m: float
    reach: float


@inlined
def _distance_at(field: FieldArrays, x: float, y: float) -> tuple[float, float, float]:
    """Distance to the nearest wall at (x, y), all in cells, and its gradient; bilinear."""
    col = int(math.floor(x - 0.5))
    row = int(math.floor(y - 0.5))
    near = field.near
    if row < 0 or col < 0 or row >= near.shape[0] - 1 or col >= near.shape[1] - 1:
        return field.reach, 0.0, 0.0
    u = x - 0.5 - col
    v = y - 0.5 - row
    a = near[row, col]
    b = near[row, col + 1]
    c = near[row + 1, col]
    d = near[row + 1, col + 1]
    value = (1.0 - v) * ((1.0 - u) * a + u * b) + v * ((1.0 - u) * c + u * d)
    by_x = (1.0 - v) * (b - a) + v * (d - c)
    by_y = (1.0 - u) * (c - a) + u * (d - b)
    return value, by_x, by_y


@inlined
def _weight(away: float, width: float) -> float:
    """Weight of a point at a distance from a wall: the loss of Geman and McClure."""
    return 1.0 / (1.0 + (away / width) ** 2) ** 2


@kernel
def _normal_equations(
    field: FieldArrays, T: Array, walls: Array, width: float
) -> tuple[Array, Array, float]:
    """Normal equations H (3, 3), g (3,) of wall points (N, 2) at a pose (3,), and mean weight.

    width: of the loss, m.
    """
    H = np.zeros((3, 3))
    g = np.zeros(3)
    total = 0.0
    c = math.cos(T[2])
    s = math.sin(T[2])
    for i in range(len(walls)):
        rx = c * walls[i, 0] - s * walls[i, 1]
        ry = s * walls[i, 0] + c * walls[i, 1]
        x = (T[0] + rx - field.origin_x) / field.cell_m
        y = (T[1] + ry - field.origin_y) / field.cell_m
        away, by_x, by_y = _distance_at(field, x, y)
        w = _weight(away, width / field.cell_m)
        total += w
        if away >= field.reach or (by_x == 0.0 and by_y == 0.0):
            continue
        by_turn = by_y * rx - by_x * ry
        H[0, 0] += w * by_x * by_x
        H[0, 1] += w * by_x * by_y
        H[0, 2] += w * by_x * by_turn
        H[1, 1] += w * by_y * by_y
        H[1, 2] += w * by_y * by_turn
        H[2, 2] += w * by_turn * by_turn
        off = away * field.cell_m
        g[0] += w * by_x * off
        g[1] += w * by_y * off
        g[2] += w * by_turn * off
    H[1, 0] = H[0, 1]
    H[2, 0] = H[0, 2]
    H[2, 1] = H[1, 2]
    return H, g, total / max(len(walls), 1)


@kernel
def refine(
    field: FieldArrays, pose: Array, walls: Array, widths: Array
) -> tuple[Array, Array, float]:
    """Pose (3,) at which wall points (N, 2) are nearest to walls, by Gauss-Newton.

    widths (K,): of the loss, m, one after the other. Returns the pose, its information (3, 3), and
    the mean weight of the points.
    """
    T = pose.copy()
    H = np.zeros((3, 3))
    mean = 0.0
    for width in widths:
        for _ in range(_ITERATIONS):
            H, g, mean = _normal_equations(field, T, walls, width)
            step = np.linalg.solve(H + _DAMPING * np.eye(3), g)
            size = math.hypot(step[0], step[1])
            if size > _MAX_STEP_M:
                step *= _MAX_STEP_M / size
            step[2] = min(max(step[2], -_MAX_STEP_RAD), _MAX_STEP_RAD)
            T -= step
            if size < _CONVERGED * _MAX_STEP_M and abs(step[2]) < _CONVERGED * _MAX_STEP_RAD:
                break
    return T, H / _POINT_SIGMA_M**2, mean


@kernel
def _refine_all(
    field: FieldArrays, poses: Array, walls: Array, widths: Array
) -> tuple[Array, Array]:
    """Refine poses (N, 3); returns them, and the mean weights (N,) of the points."""
    found = np.empty_like(poses)
    means = np.empty(len(poses))
    for k in range(len(poses)):
        found[k], _, means[k] = refine(field, poses[k], walls, widths)
    return found, means


@inlined
def _state_at(field: FieldArrays, x: float, y: float) -> tuple[int, float]:
    """State of the cell at (x, y), m from the origin, and its distance to a wall in cells."""
    col = int(math.floor(x / field.cell_m))
    row = int(math.floor(y / field.cell_m))
    if row < 0 or col < 0 or row >= field.state.shape[0] or col >= field.state.shape[1]:
        return FAR, field.reach
    return int(field.state[row, col]), float(field.near[row, col])


@kernel
def _count_agreement(
    field: FieldArrays, pose: Array, walls: Array, free: Array, tolerance_m: float
) -> tuple[int, int, int]:
    """Count what a map says of the wall points (N, 2) and free places (M, 2) of a view at a pose.

    Returns the wall points with a wall of the map within the tolerance, those where the map is
    free, and the free places where the map has a wall.
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    left = pose[0] - field.origin_x
    low = pose[1] - field.origin_y
    matched = 0
    contrary = 0
    blocked = 0
    for i in range(len(walls)):
        x = left + c * walls[i, 0] - s * walls[i, 1]
        y = low + s * walls[i, 0] + c * walls[i, 1]
        state, near = _state_at(field, x, y)
        is_matched = near * field.cell_m <= tolerance_m
        matched += is_matched and state != FAR
        contrary += not is_matched and state == FREE
    for i in range(len(free)):
        x = left + c * free[i, 0] - s * free[i, 1]
        y = low + s * free[i, 0] + c * free[i, 1]
        state, _ = _state_at(field, x, y)
        blocked += state == WALL
    return matched, contrary, blocked


_OTHER_M = 0.5  # from all walls: a wall there is another one

REACH_M = 1.0  # larger distances to walls count as this

# Walls farther from all keyframes were seen in part. Where these contradicted views, the right
# place of a real building was refused: views of it have fewer walls there than this map.
_KNOWN_M = 8.0

# Of the loss, m: from candidates to walls, and from there to the place.
BASIN_M = 0.6  # distance from which a refinement finds a wall
_WIDE = np.array([BASIN_M, 0.25])

_NARROW = np.array([0.25, 0.12])

_MAX_POINTS = 120  # of a view, for refinements


class WallField:
    """Wall distances of a map, to refine the poses of views and to compare views with the map."""

    def __init__(self, patch: GridPatch, keyframes_xy: Array) -> None:
        """keyframes_xy (N, 2): where the scans of the map were made; without any, all is known."""
        cell_m = patch.frame.resolution
        pad = round(REACH_M / cell_m) + 2
        padded = patch.padded((pad, pad, pad, pad))
        near = np.minimum(distance_cells(padded.occupied), REACH_M / cell_m)
        others = np.where(padded.free, FREE, UNKNOWN)
        state = np.where(padded.occupied, WALL, others).astype(np.uint8)
        has_room = (state == FREE) & (near * cell_m >= LATTICE_M)
        self._standing = padded.frame.centres_of(np.argwhere(has_room))
        if len(keyframes_xy):
            state[_is_far(padded, keyframes_xy)] = FAR
        self._arrays = FieldArrays(
            near.astype(np.float32),
            state,
            padded.frame.origin_x,
            padded.frame.origin_y,
            cell_m,
            REACH_M / cell_m,
        )

    def random_poses(self, count: int, rng: np.random.Generator) -> Array:
        """Poses (N, 3) where a robot may stand; none if there is no such place."""
        if not len(self._standing):
            return np.empty((0, 3))
        xy = self._standing[rng.integers(len(self._standing), size=count)]
        return np.column_stack([xy, rng.uniform(-np.pi, np.pi, count)])

    def refined_widely(self, view: View, poses: Array) -> tuple[Array, Array]:
        """Poses (N, 3) of a view moved to walls up to half a metre away; how well it fits (N,)."""
        return _refine_all(self._arrays, poses, _thinned(view.walls), _WIDE)

    def refined(self, view: View, pose: Array) -> tuple[Array, Array, float]:
        """Pose (3,) of a view moved to the nearest walls; information (3, 3); how well it fits."""
        return refine(self._arrays, pose, _thinned(view.walls), _NARROW)

    def agreement(self, view: View, T_map_view: Array) -> tuple[float, float]:
        """Share of the walls that the map shows again, of those of which it tells, at a pose (3,).

        And of how many of the walls of the view it tells, as a share.
        """
        matched, contrary, blocked = _count_agreement(
            self._arrays, T_map_view, view.walls, view.free, LATTICE_M
        )
        told = matched + contrary + blocked
        return matched / max(told, 1), (matched + contrary) / max(len(view.walls), 1)

    def told(self, walls: Array) -> tuple[Mask, Mask]:
        """Which wall points (N, 2) the map shows again, and which lie in its free space, (N,)."""
        field = self._arrays
        cells = GridFrame(field.origin_x, field.origin_y, field.cell_m).cells_of(walls)
        is_inside = np.all((cells >= 0) & (cells < field.state.shape), axis=1)
        rows, cols = np.where(is_inside[:, None], cells, 0).T  # the first cell is in the margin
        state = field.state[rows, cols]
        near_m = field.near[rows, cols] * field.cell_m
        return (near_m <= LATTICE_M) & (state != FAR), (near_m > _OTHER_M) & (state == FREE)


def _thinned(walls: Array) -> Array:
    """At most _MAX_POINTS of the points (N, 2), evenly."""
    step = -(-len(walls) // _MAX_POINTS)
    return np.ascontiguousarray(walls[:: max(1, step)])


def _is_far(patch: GridPatch, keyframes_xy: Array) -> NDArray[np.bool_]:
    """Which cells (H, W) are farther than _KNOWN_M from all keyframes (N, 2)."""
    cells = patch.frame.cells_of(keyframes_xy)
    inside = np.all((cells >= 0) & (cells < patch.shape), axis=1)
    stands = np.zeros(patch.shape, dtype=np.bool_)
    stands[cells[inside, 0], cells[inside, 1]] = True
    return distance_cells(stands) * patch.frame.resolution > _KNOWN_M
