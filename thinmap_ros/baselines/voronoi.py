"""Topological map from the Voronoi diagram, which the papers compare with thinning.

Source: topological map paper sections 1 and 4 (hierarchical map building); Zwynsvoorde et al.,
"Incremental topological modeling using local Voronoi-like graphs", 2000.
"""

import numpy as np
from scipy import ndimage
from scipy.spatial import Voronoi

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array, Cells, Mask
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.thinning import known_free, select_free_space
from thinmap_ros.core.topology.topology import build_along

_EIGHT = np.ones((3, 3), dtype=np.bool_)
_STEP_CELLS = 0.5  # distance of the points of a ridge that become cells


def build_voronoi(patch: GridPatch, config: TopologyConfig | None = None) -> TopologicalMap:
    """Topological map (m, map frame) along the Voronoi diagram of the cells that bound free space.

    Free space, pruning, merging of branch nodes and corner nodes are those of `build`: only the
    lines differ.
    """
    config = config or TopologyConfig()
    free = select_free_space(patch, None, config)
    return build_along(patch, free, voronoi_lines(patch, free, config), config)


def voronoi_lines(patch: GridPatch, free: Mask, config: TopologyConfig) -> Mask:
    """Cells (H, W) along the Voronoi diagram, among traversable cells (H, W).

    Sites are the centres of the cells that bound the free space. A ridge counts if it is nowhere
    nearer than robot_radius_m to its sites, less half a cell for the places of cells. Its points
    are moved to the nearest traversable cell, if that is a neighbour. Cells between two ridges
    without an obstacle between them are lines, too: they are the same passage.
    """
    sites = _border(known_free(patch, config)).astype(np.float64)
    lines = np.zeros(patch.shape, dtype=np.bool_)
    if len(sites) < 4 or not free.any():
        return lines
    points = _ridge_points(sites, config.robot_radius_m / patch.frame.resolution)
    cells = np.clip(np.rint(points).astype(np.int64), 0, np.array(patch.shape) - 1)
    distance, nearest = ndimage.distance_transform_edt(~free, return_indices=True)
    is_near = distance[cells[:, 0], cells[:, 1]] < 2.0
    rows, cols = cells[is_near].T
    lines[nearest[0][rows, cols], nearest[1][rows, cols]] = True
    return _without_empty_holes(lines, free)


def _border(known: Mask) -> Cells:
    """Row and column (N, 2) of the cells beside known free cells; those of the rim are outside."""
    padded = np.pad(known, 1)
    return np.asarray(np.argwhere(ndimage.binary_dilation(padded, _EIGHT) & ~padded) - 1)


def _ridge_points(sites: Array, radius: float) -> Array:
    """Points (N, 2), in cells, along the ridges that are nowhere too near to sites (M, 2)."""
    diagram = Voronoi(sites)
    ends = np.array(diagram.ridge_vertices)
    is_finite = (ends >= 0).all(axis=1)
    first, last = diagram.vertices[ends[is_finite]].transpose(1, 0, 2)
    site = diagram.points[diagram.ridge_points[is_finite, 0]]
    is_clear = _distance(site, first, last) >= radius - 0.5
    first = first[is_clear]
    line = last[is_clear] - first
    counts = np.ceil(np.hypot(*line.T) / _STEP_CELLS).astype(np.int64) + 1
    ridge = np.repeat(np.arange(len(counts)), counts)
    step = np.arange(len(ridge)) - np.repeat(np.cumsum(counts) - counts, counts)
    share = step / np.maximum(counts[ridge] - 1, 1)
    return np.asarray(first[ridge] + share[:, None] * line[ridge])


def _distance(points: Array, first: Array, last: Array) -> Array:
    """Distance (N,) of each point (N, 2) from the line between two others."""
    line = last - first
    squared = np.maximum((line**2).sum(axis=1), 1e-12)
    share = np.clip(((points - first) * line).sum(axis=1) / squared, 0.0, 1.0)
    return np.asarray(np.hypot(*(first + share[:, None] * line - points).T))


def _without_empty_holes(lines: Mask, free: Mask) -> Mask:
    """Lines, and the cells that they enclose where all of these are traversable."""
    labels, count = ndimage.label(~np.pad(lines, 1))
    has_other = np.zeros(count + 1, dtype=np.bool_)
    has_other[labels[~np.pad(free, 1)]] = True
    return np.asarray(~has_other[labels][1:-1, 1:-1] | lines)
