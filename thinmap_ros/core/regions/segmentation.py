"""Regions of a grid: flooded, and described by kind, area, outline and doors."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.regions.config import RegionConfig
from thinmap_ros.core.regions.flood import Neck, flood
from thinmap_ros.core.regions.outline import outline_of
from thinmap_ros.core.regions.passages import (
    Passage,
    gets_wider,
    has_flat_jamb,
    joined,
    mean_widths_m,
    passages_at,
)
from thinmap_ros.core.regions.region_map import Door, Region, RegionKind, RegionMap
from thinmap_ros.core.regions.room_space import clearance_m, room_space, wide_cells
from thinmap_ros.core.se2 import Array

Labels = NDArray[np.int32]
Mask = NDArray[np.bool_]
# Area of a basin above its saddle, as a share of the least area of a region: more and small rooms
# join the corridor, less and noise divides regions.
_SEED = 1 / 3
# Free cells this near to a region lie within its outline: regions end before the walls, m.
_MIN_AREA_M2 = 3.0  # a smaller part is a niche of the one behind its widest passage
_WALL_MARGIN_M = 0.5


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Cells of a grid by region, not yet described.

    labels (H, W): region of each cell from 1, 0 for none; clearance (H, W), m.
    """

    patch: GridPatch
    labels: Labels
    clearance: NDArray[np.float64]
    passages: list[Passage]


def find_regions(patch: GridPatch, config: RegionConfig | None = None) -> RegionMap:
    """Rooms, corridors and halls of a grid, with ids from 1."""
    config = config or RegionConfig()
    segmentation = segment(patch, config)
    return describe(segmentation, np.arange(1 + int(segmentation.labels.max(initial=0))), config)


def segment(patch: GridPatch, config: RegionConfig) -> Segmentation:
    """Divide the free space of a grid at its necks."""
    resolution = patch.frame.resolution
    space = room_space(patch, config)
    clearance = clearance_m(space, resolution)
    least_cells = int(_MIN_AREA_M2 / resolution**2)
    seed_cells = max(1, int(_SEED * least_cells))
    neck = Neck(config.neck_ratio, 0.5 * config.max_door_width_m, seed_cells)
    basins, saddles = flood(clearance, neck)
    passages = passages_at(saddles, basins, clearance, config.min_door_width_m)
    reach = math.ceil(config.max_door_depth_m / resolution)
    widths_m = mean_widths_m(basins, clearance)
    is_door = [
        max(widths_m[p.a], widths_m[p.b]) > config.max_corridor_width_m
        or (
            gets_wider(p, basins, clearance, reach, config.neck_ratio)
            and not has_flat_jamb(p, space, resolution)
        )
        for p in passages
    ]
    labels, doors = joined(basins, passages, is_door, patch.free, least_cells)
    labels[np.bincount(labels[patch.free], minlength=labels.max() + 1)[labels] < least_cells] = 0
    return Segmentation(patch, labels, clearance, doors)


def describe(segmentation: Segmentation, ids: NDArray[np.int64], config: RegionConfig) -> RegionMap:
    """Kinds, areas, outlines and doors of regions; ids (R + 1,): id by number, ids[0] unused."""
    found = segmentation
    cell_m2 = found.patch.frame.resolution**2
    free = np.where(found.patch.free, found.labels, 0)
    areas = np.bincount(free.ravel(), minlength=len(ids)) * cell_m2
    wide = wide_cells(found.clearance, config.max_corridor_width_m, found.patch.frame.resolution)
    regions = {}
    for number, box in enumerate(ndimage.find_objects(found.labels), 1):
        if box is None:
            continue
        own = found.labels[box] == number
        clearance = np.where(own, found.clearance[box], 0.0)
        kind = _kind(clearance, wide[box], float(own.sum()) * cell_m2, config)
        low = (box[0].start, box[1].start)
        x, y = _centre(clearance * found.patch.free[box], low, found.patch)
        regions[int(ids[number])] = Region(
            int(ids[number]), kind, x, y, float(areas[number]), _outline(found, number, box)
        )
    labels = np.asarray(ids, dtype=np.int32)[found.labels]
    return RegionMap(found.patch.frame, labels, regions, _doors(found, ids))


def _outline(found: Segmentation, number: int, box: tuple[slice, ...]) -> Array:
    """Outline (K, 2) of a region and of the free cells between it and its walls, m, map frame."""
    margin = round(_WALL_MARGIN_M / found.patch.frame.resolution)
    low = (max(box[0].start - margin, 0), max(box[1].start - margin, 0))
    wider = (slice(low[0], box[0].stop + margin), slice(low[1], box[1].stop + margin))
    labels = found.labels[wider]
    own = labels == number
    if margin:
        beside = own | (found.patch.free[wider] & (labels == 0))
        square = np.ones((3, 3), dtype=np.bool_)
        own = ndimage.binary_dilation(own, square, iterations=margin, mask=beside)
    return outline_of(own, found.patch.frame.with_origin_at(*low))


def _kind(
    clearance: NDArray[np.float64], wide: Mask, area_m2: float, config: RegionConfig
) -> RegionKind:
    """Kind of a region by its clearances, m, 0 outside, and where it is wider than a corridor."""
    inside = clearance > 0.0
    width_m = 4.0 * float(clearance[inside].mean())  # as in mean_widths_m
    is_long = area_m2 >= config.corridor_ratio * width_m**2
    if is_long and float(wide[inside].mean()) <= 0.5:
        return RegionKind.CORRIDOR
    is_wide = 2.0 * float(clearance.max()) >= config.min_hall_width_m
    return RegionKind.HALL if is_wide else RegionKind.ROOM


def _centre(
    clearance: NDArray[np.float64], low: tuple[int, int], patch: GridPatch
) -> tuple[float, float]:
    """Centre of the cell with the largest clearance in a part of a grid that begins at low."""
    cell = np.unravel_index(int(clearance.argmax()), clearance.shape)
    x, y = patch.frame.centres_of(np.array([cell], dtype=np.int64) + low)[0]
    return float(x), float(y)


def _doors(found: Segmentation, ids: NDArray[np.int64]) -> tuple[Door, ...]:
    """The passages that are left between regions, as doors."""
    doors = []
    for passage in found.passages:
        place = np.array([divmod(passage.cell, found.labels.shape[1])], dtype=np.int64)
        x, y = found.patch.frame.centres_of(place)[0]
        ends = (int(ids[passage.a]), int(ids[passage.b]))
        doors.append(Door(*ends, float(x), float(y), passage.width_m))
    return tuple(doors)
