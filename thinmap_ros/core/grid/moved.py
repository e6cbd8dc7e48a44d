"""Maps that are moved: turned by an angle, or bent as their places have moved."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import OCCUPIED_AT_LEAST, UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.grid.tiles import MAX_CELLS
from thinmap_ros.core.se2 import Array, Cells, Mask

_ALIGNED_RAD = 1e-6
_BLOCK = 8  # edge, in cells, of blocks that move as one


@dataclass(frozen=True, eq=False)
class MapMotion:
    """Poses (N >= 1, 3) of places in a map, before and after it was moved or bent.

    All else moves as the pose nearest to it.
    """

    before: Array
    after: Array

    @staticmethod
    def rigid(T: Array) -> 'MapMotion':
        """The motion of a map whose frame comes to a pose (3,)."""
        return MapMotion(np.zeros((1, 3)), T[None])

    def moved(self, points: Array) -> Array:
        """Where points (M, 2) of the map are afterwards."""
        return se2.transform_each(self._forward[_nearest(self.before, points)], points)

    def moved_poses(self, poses: Array) -> Array:
        """Where poses (M, 3) in the map are afterwards."""
        return se2.compose_each(self._forward[_nearest(self.before, poses[:, :2])], poses)

    def undone(self, points: Array, moved_as: NDArray[np.int64]) -> Array:
        """Where points (M, 2) were before; moved_as (M,): the pose as which each was moved."""
        return se2.transform_each(self._backward[moved_as], points)

    def nearest_after(self, points: Array) -> NDArray[np.int64]:
        """The pose nearest to each of the points (M, 2) afterwards, (M,)."""
        return _nearest(self.after, points)

    @cached_property
    def _forward(self) -> Array:
        pairs = zip(self.before, self.after, strict=True)
        return np.array([se2.compose(after, se2.invert(before)) for before, after in pairs])

    @cached_property
    def _backward(self) -> Array:
        return np.array([se2.invert(T) for T in self._forward])


def _nearest(poses: Array, points: Array) -> NDArray[np.int64]:
    if len(poses) == 1:
        return np.zeros(len(points), dtype=np.int64)
    # Imported here: maps that do not bend need no tree.
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(poses[:, :2]).query(points)[1], dtype=np.int64)


def aligned_patch(
    T_map_origin: Array, resolution_m: float, cells: NDArray[np.int8], max_cells: int = MAX_CELLS
) -> GridPatch:
    """Patch of cells (H, W) whose first corner and rows have a pose T_map_origin (3,) in the map.

    Rotated cells are resampled: each new cell has the value of the old cell at its centre, and one
    that contains the centre of an occupied cell is occupied, so that walls keep no gaps.
    Raises InputError where the resampled map would have more than max_cells.
    """
    if abs(T_map_origin[2]) < _ALIGNED_RAD:
        x, y, _ = T_map_origin.tolist()
        return GridPatch(GridFrame(x, y, resolution_m), cells)
    patch = GridPatch(GridFrame(0.0, 0.0, resolution_m), cells)
    motion = MapMotion.rigid(T_map_origin)
    frame, (rows, cols) = _bounds(patch, motion)
    if rows * cols > max_cells:
        raise InputError(
            f'map rotated by {T_map_origin[2]:.3f} rad: {rows} x {cols} cells: '
            f'expected {max_cells} at most'
        )
    return GridPatch(frame, _resampled(patch, motion, frame, (rows, cols)))


def resampled(patch: GridPatch, like: GridPatch) -> GridPatch:
    """A map on the cells of another one, which may be larger or smaller; see `aligned_patch`."""
    cells = _resampled(patch, MapMotion.rigid(np.zeros(3)), like.frame, like.shape)
    return GridPatch(like.frame, cells)


def overlaid(base: GridPatch, other: GridPatch, T_base_other: Array) -> GridPatch:
    """A map with what another one knows besides, whose frame has a pose (3,) in it.

    The cells are those of the base, which may be larger or smaller than those of the other map.
    Raises InputError where the map would have more than MAX_CELLS cells.
    """
    return overlaid_bent(base, other, MapMotion.rigid(T_base_other))


def overlaid_bent(base: GridPatch, other: GridPatch, motion: MapMotion) -> GridPatch:
    """As `overlaid`, with the other map moved into the frame of the base part by part."""
    wide, laid = laid_on(base, other, motion)
    return GridPatch(wide.frame, np.where(wide.cells == UNKNOWN, laid.cells, wide.cells))


def laid_on(base: GridPatch, other: GridPatch, motion: MapMotion) -> tuple[GridPatch, GridPatch]:
    """A map with room for another one, and that one moved, on the same cells.

    Raises InputError where the map would have more than MAX_CELLS cells.
    """
    cell_m = base.frame.resolution
    own, shape = _bounds(other, motion)
    rows_cols = base.frame.cells_of(np.array([[own.origin_x, own.origin_y]]))[0]
    ends = rows_cols + np.ceil(np.array(shape) * own.resolution / cell_m).astype(int) + 1
    before = np.maximum(-rows_cols, 0)
    after = np.maximum(ends - base.shape, 0)
    rows, cols = (base.shape + before + after).tolist()
    if rows * cols > MAX_CELLS:
        raise InputError(f'joined map: {rows} x {cols} cells: expected {MAX_CELLS} at most')
    padded = base.padded((int(before[0]), int(before[1]), int(after[0]), int(after[1])))
    laid = _resampled(other, motion, padded.frame, padded.shape)
    return padded, GridPatch(padded.frame, laid)


def _resampled(
    patch: GridPatch, motion: MapMotion, frame: GridFrame, shape: tuple[int, int]
) -> NDArray[np.int8]:
    """Cells (H, W) of a moved map on the lattice of another frame; see `aligned_patch`."""
    rows, cols = shape
    resampled = np.full((rows, cols), UNKNOWN, dtype=np.int8)
    reached = _reached_blocks(patch, motion, frame, shape)
    for block in np.flatnonzero(reached.any(axis=1)).tolist():
        # A row of blocks at a time: a large map needs little more memory than its cells.
        row = block * _BLOCK
        some = np.arange(row, min(row + _BLOCK, rows))
        there = np.flatnonzero(np.repeat(reached[block], _BLOCK)[:cols])
        new_cells = np.stack(np.meshgrid(some, there, indexing='ij'), axis=-1).reshape(-1, 2)
        moved_as = motion.nearest_after(frame.centres_of(_middles(row, cols)))[there // _BLOCK]
        old = motion.undone(frame.centres_of(new_cells), np.tile(moved_as, len(some)))
        old_cells = np.floor(patch.frame.in_cells(old)[:, ::-1] + 1e-9).astype(np.int64)
        inside = ((old_cells >= 0) & (old_cells < patch.shape)).all(axis=1)
        resampled[tuple(new_cells[inside].T)] = patch.cells[tuple(old_cells[inside].T)]
    occupied = np.argwhere(patch.cells >= OCCUPIED_AT_LEAST)
    centres = patch.frame.centres_of(occupied)
    walls = frame.cells_of(motion.moved(centres))
    inside = ((walls >= 0) & (walls < shape)).all(axis=1)
    resampled[tuple(walls[inside].T)] = patch.cells[tuple(occupied[inside].T)]
    return resampled


def _reached_blocks(
    patch: GridPatch, motion: MapMotion, frame: GridFrame, shape: tuple[int, int]
) -> Mask:
    """Blocks (H, W) of the cells of another frame in which known cells of a moved map may lie."""
    known = np.pad(patch.cells != UNKNOWN, [(0, -size % _BLOCK) for size in patch.shape])
    down, across = (size // _BLOCK for size in known.shape)
    blocks = np.argwhere(known.reshape(down, _BLOCK, across, _BLOCK).any(axis=(1, 3)))
    size = [-(-each // _BLOCK) for each in shape]
    reached = np.zeros(size, dtype=np.bool_)
    middles = patch.frame.centres_of(blocks * _BLOCK + _BLOCK // 2)
    there = frame.cells_of(motion.moved(middles)) // _BLOCK
    # Half a diagonal, and one block for what does not move exactly as the middle does.
    far = 1 + math.ceil(math.sqrt(0.5) * patch.frame.resolution / frame.resolution)
    for off in np.ndindex(2 * far + 1, 2 * far + 1):
        row, col = (there + off - far).T
        inside = (row >= 0) & (row < size[0]) & (col >= 0) & (col < size[1])
        reached[row[inside], col[inside]] = True
    return reached


def _middles(row: int, cols: int) -> Cells:
    """The middle cell of each block in a row of them."""
    across = np.arange(0, cols, _BLOCK) + _BLOCK // 2
    return np.column_stack([np.full(len(across), row + _BLOCK // 2), across])


def _bounds(patch: GridPatch, motion: MapMotion) -> tuple[GridFrame, tuple[int, int]]:
    """Frame and shape of an aligned grid around a moved one."""
    resolution_m = patch.frame.resolution
    edges = [np.append(np.arange(0, size, _BLOCK), size) for size in patch.shape]
    corners = np.stack(np.meshgrid(*edges, indexing='ij'), axis=-1).reshape(-1, 2)
    moved = motion.moved(patch.frame.centres_of(corners) - 0.5 * resolution_m)
    low = moved.min(axis=0)
    # Rounded, so that a quarter turn keeps the number of cells.
    cols, rows = np.ceil(np.round((moved.max(axis=0) - low) / resolution_m, 6)).astype(int)
    return GridFrame(float(low[0]), float(low[1]), resolution_m), (int(rows), int(cols))
