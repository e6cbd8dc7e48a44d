"""Keep-out masks of Nav2: map_server maps whose occupied cells no robot is to enter."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.edits import MAX_CORNERS, MAX_OUTLINE_M
from thinmap_ros.core.grid.moved import resampled
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.se2 import Array, Mask
from thinmap_ros.core.topology.segmentation import outline_of
from thinmap_ros.files.occupancy_maps import read_map

_FORBIDDEN = 100
_SQUARE = np.ones((3, 3), dtype=np.bool_)


def read_mask(path: Path | str, patch: GridPatch, folder: Path | None = None) -> GridPatch:
    """Read a mask of a map: cells of 100 where no robot is to be, all others unknown.

    patch: the map, in whose frame the origin of the mask is, with cells of any size. folder: as in
    `read_map`. Raises InputError as `read_map`, where nothing is forbidden, and where the mask lies
    beside the map.
    Source: KeepoutFilter of nav2_costmap_2d (Jazzy): 100 is lethal, less is a cost, -1 is nothing.
    """
    mask = read_map(path, folder, lambda _line: None)
    forbidden = mask.cells == _FORBIDDEN
    if not forbidden.any():
        raise InputError(
            f'{path}: no cell is 100: expected a keep-out mask, with pixels darker than '
            'occupied_thresh (mode raw: of value 100)'
        )
    low, high = _rectangle(mask)
    map_low, map_high = _rectangle(patch)
    if (low >= map_high).any() or (high <= map_low).any():
        raise InputError(
            f'{path}: mask of {_range_text(low, high)}: expected one that overlaps the map, '
            f'{_range_text(map_low, map_high)}'
        )
    return replace(mask, cells=np.where(forbidden, np.int8(_FORBIDDEN), np.int8(UNKNOWN)))


def outlines_of(mask: GridPatch, patch: GridPatch) -> list[Array]:
    """Polygons (M, 2), m, of a mask of `read_mask`, each of a size that a keep-out area may have.

    What is a wall of the map anyway, or beside one, is left out: many masks are edited maps. An
    area with holes, or with too many corners, becomes several.
    """
    walls = ndimage.binary_dilation(resampled(patch, mask).occupied, _SQUARE)
    return list(_outlines(mask.occupied & ~walls, mask.frame))


def _outlines(cells: Mask, frame: GridFrame) -> Iterator[Array]:
    labels, _ = ndimage.label(cells)
    for number, (rows, cols) in enumerate(ndimage.find_objects(labels), 1):
        part = labels[rows, cols] == number
        own = frame.with_origin_at(rows.start, cols.start)
        outline = outline_of(part, own)
        length_m = float(np.abs(np.diff(outline, axis=0, append=outline[:1])).sum())
        holes = np.argwhere(ndimage.binary_fill_holes(part) & ~part)
        if holes.size:
            yield from _halves(part, own, int(holes[0, 1]), axis=1)
        elif len(outline) > MAX_CORNERS or length_m > MAX_OUTLINE_M:
            axis = int(np.argmax(part.shape))
            yield from _halves(part, own, part.shape[axis] // 2, axis)
        else:
            yield outline


def _halves(part: Mask, frame: GridFrame, cut: int, axis: int) -> Iterator[Array]:
    """Outlines of the cells (H, W) before a row or column, and of those from it on."""
    first, second = np.split(part, [cut], axis)
    yield from _outlines(first, frame)
    yield from _outlines(second, frame.with_origin_at(*((cut, 0) if axis == 0 else (0, cut))))


def _rectangle(patch: GridPatch) -> tuple[Array, Array]:
    """Lowest and highest x and y (2,) of a map, m."""
    frame = patch.frame
    low = np.array([frame.origin_x, frame.origin_y])
    return low, low + frame.resolution * np.array(patch.shape[::-1])


def _range_text(low: Array, high: Array) -> str:
    return f'x {low[0]:.1f} to {high[0]:.1f} m, y {low[1]:.1f} to {high[1]:.1f} m'
