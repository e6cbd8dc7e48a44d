"""The free space of a map as rooms have it: without furniture, specks and hollow walls."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinmap_ros.core.grid import fields
from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.regions.config import RegionConfig

Mask = NDArray[np.bool_]
# Least area of furniture in relation to its squared length: a square has a half, a wall 0.15 m
# thick and 1 m long 0.13.
_COMPACT = 0.15
_LEG = 0.2  # length up to which any shape is furniture, as a share of the largest


def room_space(patch: GridPatch, config: RegionConfig) -> Mask:
    """Cells (H, W) that the robot's disc covers where it fits, with furniture taken for free.

    Pillars and tables would make rings of narrow passages, and no two rooms. A free slit in which
    the robot does not fit, as between the two faces of a wall, would join what the wall separates.
    """
    radius = config.robot_radius_m / patch.frame.resolution
    free = patch.free | _furniture(patch, config.max_furniture_m / patch.frame.resolution)
    standing = _clearance_cells(free) > radius
    return np.asarray(distance_cells(standing) < radius)


def clearance_m(space: Mask, resolution_m: float) -> NDArray[np.float64]:
    """Distance of each cell (H, W) to the nearest cell outside a space, m; the rim is outside."""
    return _clearance_cells(space) * resolution_m


def wide_cells(clearance: NDArray[np.float64], width_m: float, resolution_m: float) -> Mask:
    """Cells (H, W) of a space that a disc of a diameter covers where it fits, by clearances, m.

    Niches leave them as they are, where they lower the mean clearance of a room.
    """
    fits = clearance > 0.5 * width_m
    if not fits.any():
        return fits
    return np.asarray(distance_cells(fits) * resolution_m < 0.5 * width_m) & (clearance > 0.0)


def _clearance_cells(space: Mask) -> NDArray[np.float64]:
    return distance_cells(np.pad(~space, 1, constant_values=True))[1:-1, 1:-1]


def _furniture(patch: GridPatch, longest: float) -> Mask:
    """Obstacles and unknown specks (H, W) apart from walls, no longer than so many cells.

    A thin piece is one of a wall between two doors, unless it is no longer than a table's leg.
    """
    numbers, sizes = fields.label(~patch.free)
    small = np.zeros(len(sizes), dtype=np.bool_)
    for number, box in enumerate(ndimage.find_objects(numbers), 1):
        extent = _extent(box)
        is_compact = sizes[number] >= _COMPACT * extent**2 or extent <= _LEG * longest
        small[number] = extent <= longest and is_compact and not _at_rim(box, patch.shape)
    return np.asarray(small[numbers])


def _extent(box: Any) -> float:
    """Diagonal of a box of slices, cells."""
    return math.hypot(*(side.stop - side.start for side in box))


def _at_rim(box: Any, shape: tuple[int, int]) -> bool:
    """Whether a box of slices touches the rim of an array."""
    return any(s.start == 0 or s.stop == n for s, n in zip(box, shape, strict=True))
