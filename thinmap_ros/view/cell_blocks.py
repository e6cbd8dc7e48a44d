"""Cells of a map as they are drawn: one by one, or in blocks where the map is large."""

from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

# The largest side of a drawn map, cells: a cell of a smaller size than a pixel may vanish.
_MAX_CELLS = 1100
Cell = TypeVar('Cell', np.bool_, np.int32)


class DrawnCells(NamedTuple):
    """Free and occupied cells (H, W); the others are unknown."""

    free: NDArray[np.bool_]
    occupied: NDArray[np.bool_]


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
