"""Worlds: obstacles, and the start of a robot."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.errors import InputError, quoted, require_type
from thinmap_ros.core.grid.fields import distance_cells, reachable
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.se2 import Array, Mask
from thinmap_ros.sim.moving_obstacles import MovingObstacles


@dataclass(frozen=True, eq=False)
class World:
    """Obstacles: `occupied` (H, W) uint8 on a lattice in the world frame.

    start (3,): initial pose of a robot; `glass` (H, W): obstacles without laser returns; `moving`:
    moving obstacles.
    """

    name: str
    occupied: NDArray[np.uint8]
    frame: GridFrame
    start: Array
    glass: Mask | None = None
    moving: MovingObstacles | None = None

    @staticmethod
    def from_patch(name: str, patch: GridPatch, start: Array) -> 'World':
        """World of a map; cells that are not free are obstacles. start (3,): NaN if unknown."""
        require_type('name', name, str)
        require_type('patch', patch, GridPatch)
        if np.shape(start) != (3,):
            raise InputError(f'start = {quoted(start)}: expected a pose (3,)')
        return World(name, (~patch.free).astype(np.uint8), patch.frame, start)

    @cached_property
    def distance_to_wall_m(self) -> Array:
        """Distance of each cell centre from the edge of the nearest obstacle cell, m, (H, W).

        Up to 0.2 cells too long in diagonal directions.
        """
        return (distance_cells(self.occupied != 0) - 0.5) * self.frame.resolution

    def moving_ranges(
        self, seconds: float, T_world_laser: Array, angles: Array, reach_m: float
    ) -> Array | None:
        """Distance, m, at which beams (N,) at world angles hit a moving obstacle; None: none."""
        if self.moving is None:
            return None
        return self.moving.ranges(seconds, T_world_laser, angles, reach_m)

    def is_clear(self, x: float, y: float, radius_m: float) -> bool:
        """Whether a disc with its centre in the world touches no obstacle cell; exact."""
        if not (math.isfinite(x) and math.isfinite(y)):
            return False
        frame = self.frame
        (rows, cols) = self.occupied.shape
        row = math.floor((y - frame.origin_y) / frame.resolution)
        col = math.floor((x - frame.origin_x) / frame.resolution)
        if not (0 <= row < rows and 0 <= col < cols):
            return False
        # The point is up to 0.71 cells from the centre, and the distance there is up to 0.2 cells
        # too long.
        spare = (float(self.distance_to_wall_m[row, col]) - radius_m) / frame.resolution
        if abs(spare) > 1.0:
            return spare > 0.0
        return self._squared_gap(x, y, row, col, radius_m) > radius_m**2

    def _squared_gap(self, x: float, y: float, row: int, col: int, reach_m: float) -> float:
        """Squared distance, m^2, from a point to the nearest obstacle cell within reach.

        inf if there is none.
        """
        reach = math.ceil(reach_m / self.frame.resolution) + 1
        first = np.maximum([row - reach, col - reach], 0)
        near = self.occupied[first[0] : row + reach + 1, first[1] : col + reach + 1]
        centres = self.frame.centres_of(np.argwhere(near) + first)
        beside = np.maximum(np.abs(centres - (x, y)) - self.frame.resolution / 2.0, 0.0)
        return float((beside**2).sum(axis=1).min(initial=np.inf))


def surfaces(world: World, shortest_m: float) -> Array:
    """Axis-parallel obstacle faces that bound the free space around the start: ends (N, 4), m.

    A laser observes them as lines. Each is at least shortest_m long; the two sides of a thin wall
    are two faces. Columns: x and y of one end, x and y of the other. Oblique surfaces consist of
    short steps and are omitted.
    """
    free = world.occupied == 0
    inside = inside_of(world)
    found = [_rows_of_faces(inside, free, world.frame, shortest_m, side) for side in (-1, 1)]
    turned = GridFrame(world.frame.origin_y, world.frame.origin_x, world.frame.resolution)
    across = [
        _rows_of_faces(inside.T, free.T, turned, shortest_m, side)[:, [1, 0, 3, 2]]
        for side in (-1, 1)
    ]
    return np.concatenate([*found, *across])


def inside_of(world: World) -> Mask:
    """Free cells (H, W) that are connected with the start."""
    return reachable(world.occupied == 0, world.frame.cells_of(world.start[None, :2]))


def _rows_of_faces(
    inside: Mask,
    free: Mask,
    frame: GridFrame,
    shortest_m: float,
    side: int,
) -> Array:
    """Faces along rows, (N, 4): free cells with an obstacle one row below (-1) or above (1)."""
    faces = np.zeros((inside.shape[0], inside.shape[1] + 2), dtype=np.int8)
    beyond = np.ones_like(free)
    beyond[max(-side, 0) : len(free) - max(side, 0)] = free[
        max(side, 0) : len(free) - max(-side, 0)
    ]
    faces[:, 1:-1] = inside & ~beyond
    rows, first = np.nonzero(np.diff(faces, axis=1) > 0)
    _, end = np.nonzero(np.diff(faces, axis=1) < 0)
    long = (end - first) * frame.resolution >= shortest_m - 1e-9
    y = frame.origin_y + (rows[long] + (side > 0)) * frame.resolution
    x, end_x = (frame.origin_x + columns[long] * frame.resolution for columns in (first, end))
    return np.column_stack([x, y, end_x, y])
