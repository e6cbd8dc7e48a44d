"""Outer boundary of a set of cells as a polygon."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinmap_ros.core.grid.patch import GridFrame
from thinmap_ros.core.se2 import Array
from thinmap_ros.jit import inlined, kernel

Mask = NDArray[np.bool_]


def outline_of(cells: Mask, frame: GridFrame) -> Array:
    """Outer boundary (K, 2) of the largest edge-connected part of cells (H, W), m, map frame.

    Counterclockwise and not closed, with a point at each corner; (0, 2) of no cells.
    """
    parts, count = ndimage.label(cells)
    if not count:
        return np.empty((0, 2))
    largest = 1 + int(np.bincount(parts.ravel())[1:].argmax())
    corners = _boundary(np.pad(parts == largest, 1)) - 1.0  # (column, row) of lower left corners
    return corners * frame.resolution + (frame.origin_x, frame.origin_y)


@kernel
def _boundary(cells: Mask) -> NDArray[np.float64]:
    """Corners (K, 2), as (column, row), of the outer boundary of a connected part with a clear rim.

    The cells lie on the left. Where two cells meet at a corner only, it stays with its own.
    """
    cols = cells.shape[1]
    first = 0
    while not cells[first // cols, first % cols]:
        first += 1
    row = first // cols
    col = first % cols
    corners = np.empty((4 * cells.size, 2))
    count = 0
    heading = 0  # east, north, west, south
    previous = 0
    while count == 0 or row != first // cols or col != first % cols:
        if not cells[_ahead(row, col, heading)]:
            heading = (heading + 1) % 4
        elif cells[_ahead(row, col, (heading + 3) % 4)]:
            heading = (heading + 3) % 4
        if count == 0 or heading != previous:
            corners[count] = (col, row)
            count += 1
        previous = heading
        row += (heading == 1) - (heading == 3)
        col += (heading == 0) - (heading == 2)
    return corners[:count].copy()


@inlined
def _ahead(row: int, col: int, heading: int) -> tuple[int, int]:
    """The cell ahead of a corner on the left of a heading; that on the right is the next one's."""
    return row - (heading >= 2), col - (heading in (1, 2))
