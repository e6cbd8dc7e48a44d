"""Straight surfaces of a world, which a laser observes as lines."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.fields import reachable
from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.world import World


def surfaces(world: World, shortest_m: float) -> Array:
    """Axis-parallel obstacle faces that bound the free space around the start: ends (N, 4), m.

    Each is at least shortest_m long; the two sides of a thin wall are two faces. Columns: x and y
    of one end, x and y of the other. Oblique surfaces consist of short steps and are omitted.
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


def inside_of(world: World) -> NDArray[np.bool_]:
    """Free cells (H, W) that are connected with the start."""
    return reachable(world.occupied == 0, world.frame.cells_of(world.start[None, :2]))


def _rows_of_faces(
    inside: NDArray[np.bool_],
    free: NDArray[np.bool_],
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
