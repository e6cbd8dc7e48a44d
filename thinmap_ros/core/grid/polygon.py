"""Maps that are limited to a polygon."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array

_WALL = np.int8(100)


def inside(points: Array, polygon: Array) -> NDArray[np.bool_]:
    """Which points (N, 2) lie in a polygon (M, 2), by the even-odd rule, (N,)."""
    result = np.zeros(len(points), dtype=np.bool_)
    x = points[:, 0]
    y = points[:, 1]
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        crosses = (ay > y) != (by > y)
        if ay != by:
            result ^= crosses & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return result


def masked_outside(patch: GridPatch, polygon: Array) -> GridPatch:
    """Map with all cells outside a polygon (M, 2) as walls; polygon in the map frame, m."""
    centres = patch.frame.centres_of(np.argwhere(np.ones(patch.shape, dtype=np.bool_)))
    within = inside(centres, polygon).reshape(patch.shape)
    cells = np.where(within, patch.cells, _WALL).astype(np.int8)
    return replace(patch, cells=cells)
