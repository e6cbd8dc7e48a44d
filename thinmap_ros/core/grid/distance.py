"""Exact Euclidean distance of each cell to the nearest cell of a set."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.jit import kernel

FAR = 1.0e6  # squared distance in cells if the set is empty


def distance_cells(marked: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Distance, in cells between centres, from each cell (H, W) to the nearest marked one.

    1000 if no cell is marked.

    Source: Felzenszwalb and Huttenlocher, "Distance transforms of sampled functions", 2012: the
    lower envelope of parabolas, along columns and then along rows.
    """
    return np.asarray(_distance(np.ascontiguousarray(marked)))


@kernel
def _distance(marked: NDArray[np.bool_]) -> NDArray[np.float64]:
    rows, cols = marked.shape
    squared = np.full((rows, cols), FAR)
    # Along columns, two sweeps count the steps from marked cells.
    for col in range(cols):
        steps = 1.0e3
        for row in range(rows):
            steps = 0.0 if marked[row, col] else min(steps + 1.0, 1.0e3)
            squared[row, col] = steps * steps
        steps = 1.0e3
        for row in range(rows - 1, -1, -1):
            steps = 0.0 if marked[row, col] else min(steps + 1.0, 1.0e3)
            squared[row, col] = min(squared[row, col], steps * steps)
    vertex = np.empty(cols, dtype=np.int64)
    border = np.empty(cols + 1)
    heights = np.empty(cols)
    for row in range(rows):
        heights[:] = squared[row]
        last = 0
        vertex[0] = 0
        border[0] = -np.inf
        border[1] = np.inf
        for col in range(1, cols):
            while True:
                other = vertex[last]
                meet = (heights[col] + col * col - heights[other] - other * other) / (
                    2.0 * (col - other)
                )
                if meet > border[last]:
                    break
                last -= 1
            last += 1
            vertex[last] = col
            border[last] = meet
            border[last + 1] = np.inf
        last = 0
        for col in range(cols):
            while border[last + 1] < col:
                last += 1
            step = col - vertex[last]
            squared[row, col] = np.sqrt(min(step * step + heights[vertex[last]], FAR))
    return squared
