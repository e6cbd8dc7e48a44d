"""Coverage: share of the observable cells that are known as free.

A cell is observable if it is in range and line of sight of a position that the robot can reach.
Door leaves that never move are obstacles, as the laser and the robot meet them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import begin_ray, next_cell
from thinmap_ros.core.se2 import Array, Mask
from thinmap_ros.jit import kernel
from thinmap_ros.sim.robot import RobotConfig
from thinmap_ros.sim.world import World

CELL_M = 0.1
_RAY_SPACING_M = 0.05
_ALIGNED = 1e-3
_PER_CELL = 10  # points of a leaf, so that no ray passes between two of its cells


@dataclass(frozen=True, eq=False)
class ObservableCells:
    """Observable free cells (H, W) bool, 10 cm wide, world frame."""

    cells: Mask
    frame: GridFrame

    @staticmethod
    def share(known: Sequence[Mask]) -> float:
        """Share of these cells that one of several maps knows; known: of each, (N,)."""
        together = np.logical_or.reduce(known)
        return float(together.mean()) if together.size else 1.0

    @property
    def area_m2(self) -> float:
        """Area of all of them."""
        return float(self.cells.sum()) * self.frame.resolution**2

    def coverage(self, patch: GridPatch, T_world_map: Array | None = None) -> float:
        """Share of these cells at whose centres the map is free.

        T_world_map (3,): pose of the map frame in the world; None: identity.
        """
        count = len(self._centres)
        if count == 0:
            return 1.0
        offset = self._offset_of(patch.frame)
        if T_world_map is None and offset is not None:
            return self._count_known(patch, *offset) / count
        return float(self.known(patch, T_world_map).sum()) / count

    def known(self, patch: GridPatch, T_world_map: Array | None = None) -> Mask:
        """Whether the map is free at the centre of each of these cells, (N,); see `coverage`."""
        centres = self._centres
        if T_world_map is not None:
            centres = se2.transform_points(se2.invert(T_world_map), centres)
        at = patch.frame.cells_of(centres)
        rows, cols = patch.shape
        inside = (at[:, 0] >= 0) & (at[:, 0] < rows) & (at[:, 1] >= 0) & (at[:, 1] < cols)
        inside[inside] = patch.free[at[inside, 0], at[inside, 1]]
        return inside

    def _offset_of(self, frame: GridFrame) -> tuple[int, int] | None:
        """Offset (row, col) of a frame from these cells, if it is on the same lattice."""
        if frame.resolution != self.frame.resolution:
            return None
        offset = (frame.as_array() - self.frame.as_array())[1::-1] / frame.resolution
        whole = np.round(offset)
        return (int(whole[0]), int(whole[1])) if np.abs(offset - whole).max() < _ALIGNED else None

    def _count_known(self, patch: GridPatch, row: int, col: int) -> int:
        rows, cols = self.cells.shape
        here = (slice(max(row, 0), row + patch.shape[0]), slice(max(col, 0), col + patch.shape[1]))
        there = (slice(max(-row, 0), max(rows - row, 0)), slice(max(-col, 0), max(cols - col, 0)))
        return int(np.count_nonzero(self.cells[here] & patch.free[there]))

    @cached_property
    def _centres(self) -> Array:
        return self.frame.centres_of(np.argwhere(self.cells))


def robot_observable_cells(
    world: World, start: Array, robot: RobotConfig, range_m: float
) -> ObservableCells:
    """Cells that a robot can observe with a range and 360 degrees, from a start (3,).

    It does not enter what is narrower than the radius with which paths are planned, unless it
    starts there. Raises InputError if the robot does not fit at its start.
    """
    row, col = world.frame.cells_of(start[None, :2])[0]
    rows, cols = world.occupied.shape
    planned_m = robot.planned_radius_m
    inside = 0 <= row < rows and 0 <= col < cols
    has_room = inside and world.distance_to_wall_m[row, col] > planned_m
    return observable_cells(world, start, planned_m if has_room else robot.radius_m, range_m)


def observable_cells(
    world: World, start: Array, radius_m: float, range_m: float
) -> ObservableCells:
    """Cells that a robot of a radius can observe, with a range and 360 degrees, from a start (3,).

    All reachable positions count, at the resolution of the world. Visibility is symmetric: each
    free cell casts rays until it meets a reachable position. Rays are 5 cm apart at the full range,
    so that narrower gaps at this distance may be missed.
    Raises InputError if the robot does not fit at its start.
    """
    world = _with_standing_leaves(world, start, radius_m)
    reached = _reachable_from(world, start, radius_m)
    # The lattice of maps: its lines pass through the origin of the world.
    low = np.floor(np.array([world.frame.origin_x, world.frame.origin_y]) / CELL_M + 1e-6) * CELL_M
    frame = GridFrame(float(low[0]), float(low[1]), CELL_M)
    rows, cols = world.occupied.shape
    last = frame.cells_of(world.frame.centres_of(np.array([[rows - 1, cols - 1]])))[0]
    cells = np.argwhere(_without_solids(world, frame, (int(last[0]) + 1, int(last[1]) + 1)))
    origin = (world.frame.origin_x, world.frame.origin_y)
    places = (frame.centres_of(cells) - origin) / world.frame.resolution
    angles = np.arange(0.0, 2.0 * math.pi, _RAY_SPACING_M / max(range_m, 1.0))
    seen = _sees_reachable(
        world.occupied, reached, places, angles, range_m / world.frame.resolution
    )
    coverable_cells = np.zeros(tuple(last + 1), dtype=np.bool_)
    coverable_cells[cells[:, 0], cells[:, 1]] = seen
    return ObservableCells(coverable_cells, frame)


def _with_standing_leaves(world: World, start: Array, radius_m: float) -> World:
    """World with the door leaves that never move as obstacles, but for those at the start (3,)."""
    if world.moving is None:
        return world
    occupied = world.occupied.copy()
    for leaf in world.moving.doors.standing():
        length_m = math.dist(leaf[:2], leaf[2:])
        share = np.linspace(0.0, 1.0, 2 + math.ceil(_PER_CELL * length_m / world.frame.resolution))
        points = leaf[:2] + share[:, None] * (leaf[2:] - leaf[:2])
        if np.hypot(*(points - start[:2]).T).min() <= radius_m + CELL_M:
            continue  # the robot stands in its door
        rows, cols = world.frame.cells_of(points).T
        inside = (rows >= 0) & (rows < occupied.shape[0]) & (cols >= 0) & (cols < occupied.shape[1])
        occupied[rows[inside], cols[inside]] = 1
    return World(world.name, occupied, world.frame, world.start)


def _reachable_from(world: World, start: Array, radius_m: float) -> Mask:
    """Cells (H, W) that the centre of the robot can reach from its start."""
    from scipy import ndimage

    standing = world.distance_to_wall_m > radius_m
    row, col = world.frame.cells_of(start[None, :2])[0]
    rows, cols = standing.shape
    if not (0 <= row < rows and 0 <= col < cols and standing[row, col]):
        raise InputError(
            f'{world.name}: start {start[:2].tolist()}: a robot of {radius_m} m does not fit there'
        )
    labels, _ = ndimage.label(standing)
    return np.asarray(labels == labels[row, col])


def _without_solids(world: World, frame: GridFrame, shape: tuple[int, int]) -> Mask:
    """Cells without obstacles, (H, W)."""
    solid = frame.cells_of(world.frame.centres_of(np.argwhere(world.occupied)))
    free = np.ones(shape, dtype=np.bool_)
    free[solid[:, 0], solid[:, 1]] = False
    return free


@kernel
def _sees_reachable(
    solid: NDArray[np.uint8],
    wanted: Mask,
    places: Array,
    angles: Array,
    max_cells: float,
) -> Mask:
    """Whether rays from each place (N, 2; x, y in cells) meet a wanted cell before an obstacle."""
    rows, cols = solid.shape
    found = np.zeros(len(places), dtype=np.bool_)
    for i in range(len(places)):
        for k in range(angles.size):
            ray = begin_ray(places[i, 0], places[i, 1], math.cos(angles[k]), math.sin(angles[k]))
            travelled, row, col = ray[:3]
            while (
                travelled <= max_cells
                and 0 <= row < rows
                and 0 <= col < cols
                and not solid[row, col]
            ):
                if wanted[row, col]:
                    found[i] = True
                    break
                ray = next_cell(ray)
                travelled, row, col = ray[:3]
            if found[i]:
                break
    return found
