"""A map as it is drawn: each wall as one line, or as one solid strip."""

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion

from thinmap_ros.core.grid.patch import GridPatch

# Unknown space up to this thickness between two surfaces is the inside of a wall, m.
_WALL_M = 0.5
_PASSES = 2  # the second one closes what the first one left between filled cells
# The largest side of a drawn map, cells: a cell of a smaller size than a pixel may vanish.
_MAX_CELLS = 1100
# Codes of cells.
_UNKNOWN = 0
_FREE = 1
_OCCUPIED = 2
_OUTSIDE = 3
_Codes = NDArray[np.uint8]
_Mask = NDArray[np.bool_]
Cell = TypeVar('Cell', np.bool_, np.int32)


class DrawnCells(NamedTuple):
    """Free and occupied cells (H, W); the others are unknown."""

    free: _Mask
    occupied: _Mask


class _Runs(NamedTuple):
    """Runs of equal codes along the rows of a map, and the codes before and after each (N,)."""

    lengths: NDArray[np.int64]
    code: _Codes
    before: _Codes
    after: _Codes


def drawn_cells(patch: GridPatch) -> DrawnCells:
    """Cells of a measured map with each wall as one line.

    Range noise and rounding fill cells behind a surface and leave gaps within a wall. Along rows
    and columns:

    - unknown space up to 0.5 m thick between two occupied cells is occupied;
    - a single unknown cell between a free and an occupied cell is free;
    - of occupied cells up to 0.5 m thick in front of unknown space, only the one that faces free
      space is occupied;
    - an occupied cell beside unknown space and without a free neighbour is unknown.
    """
    codes = np.full(patch.shape, _UNKNOWN, dtype=np.uint8)
    codes[patch.free] = _FREE
    codes[patch.occupied] = _OCCUPIED
    thickness = max(1, round(_WALL_M / patch.frame.resolution))
    for _ in range(_PASSES):
        filled = codes.copy()
        for view, target in ((codes, filled), (codes.T, filled.T)):
            _fill_gaps(view, target, thickness)
        codes = filled
    behind = np.zeros(patch.shape, dtype=np.bool_)
    facing = np.zeros(patch.shape, dtype=np.bool_)
    for view, hidden, shown in ((codes, behind, facing), (codes.T, behind.T, facing.T)):
        _mark_layers(view, hidden, shown, thickness)
    free = codes == _FREE
    occupied = (codes == _OCCUPIED) & (facing | ~behind)
    square = np.ones((3, 3), dtype=np.bool_)
    known = binary_erosion(free | occupied, square, border_value=1)
    return DrawnCells(free, occupied & (known | binary_dilation(free, square)))


def reduction(shape: tuple[int, int]) -> int:
    """Cells of a map per side of a drawn cell."""
    return -(-max(shape) // _MAX_CELLS)


def reduced(cells: DrawnCells, factor: int) -> DrawnCells:
    """Cells in blocks: a block is occupied if any of its cells is, and else free if any is."""
    occupied = block_maximum(cells.occupied, factor)
    return DrawnCells(block_maximum(cells.free, factor) & ~occupied, occupied)


def block_maximum(cells: NDArray[Cell], factor: int) -> NDArray[Cell]:
    """Greatest value in each block of factor x factor cells."""
    if factor == 1:
        return cells
    rows, cols = (-(-count // factor) for count in cells.shape)
    padded = np.zeros((rows * factor, cols * factor), dtype=cells.dtype)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    blocks: NDArray[Cell] = padded.reshape(rows, factor, cols, factor).max(axis=(1, 3))
    return blocks


def _fill_gaps(codes: _Codes, target: _Codes, thickness: int) -> None:
    """Fill unknown space within walls, and single unknown cells in front of them."""
    runs = _runs(codes)
    unknown = runs.code == _UNKNOWN
    between = unknown & (runs.before == _OCCUPIED) & (runs.after == _OCCUPIED)
    wall = _cells_of(runs, between & (runs.lengths <= thickness), codes.shape)
    in_front = (runs.before == _FREE) & (runs.after == _OCCUPIED)
    in_front |= (runs.before == _OCCUPIED) & (runs.after == _FREE)
    gap = _cells_of(runs, unknown & in_front & (runs.lengths == 1), codes.shape)
    target[gap & (target == _UNKNOWN)] = _FREE
    target[wall] = _OCCUPIED


def _mark_layers(codes: _Codes, behind: _Mask, facing: _Mask, thickness: int) -> None:
    """Mark occupied cells that face free space, and those behind the face of a wall."""
    runs = _runs(codes)
    is_one_sided = (runs.before == _FREE) ^ (runs.after == _FREE)
    thin = (runs.code == _OCCUPIED) & (runs.lengths <= thickness)
    behind |= _cells_of(runs, thin & is_one_sided, codes.shape)
    free = codes == _FREE
    facing[:, 1:] |= free[:, :-1]
    facing[:, :-1] |= free[:, 1:]


def _runs(codes: _Codes) -> _Runs:
    """Runs along the rows; between two rows there is one cell outside of the map."""
    rows, cols = codes.shape
    padded = np.full((rows, cols + 1), _OUTSIDE, dtype=np.uint8)
    padded[:, :cols] = codes
    flat = padded.ravel()
    starts = np.concatenate([[0], np.flatnonzero(flat[1:] != flat[:-1]) + 1])
    code = flat[starts]
    around = np.concatenate([[_OUTSIDE], code, [_OUTSIDE]]).astype(np.uint8)
    lengths = np.diff(np.append(starts, flat.size))
    return _Runs(lengths, code, around[:-2], around[2:])


def _cells_of(runs: _Runs, chosen: _Mask, shape: tuple[int, ...]) -> _Mask:
    """The cells (H, W) of the chosen runs (N,)."""
    flat = np.repeat(chosen, runs.lengths)
    return flat.reshape(shape[0], shape[1] + 1)[:, : shape[1]]
