"""The maps of several robots on one lattice as one map, by the evidence of all."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.patch import UNKNOWN, GridPatch
from thinmap_ros.core.se2 import Array, Mask

_P_LEAST = 0.004  # of a cell of 0 %: the percents of a single map come back as they were
_FOOTPRINT_M = 0.22  # around the path of a small robot
_MAX_STRIDE_M = 1.0  # between two places of a path; farther ones may have a wall between them
_STEP_M = 0.05


def _odds() -> Array:
    """Log odds of each value of a cell; 0 where it is unknown."""
    values = np.arange(256, dtype=np.uint8).view(np.int8)
    p = np.clip(values / 100.0, _P_LEAST, 1.0 - _P_LEAST)
    return np.where(values == UNKNOWN, 0.0, np.log(p / (1.0 - p)))


_ODDS = _odds()
_FREE = float(_ODDS[0])


@dataclass(frozen=True, eq=False)
class Layer:
    """The map of a robot, and places (N, 2), m, in its frame where the robot has been, in order."""

    patch: GridPatch
    driven: Array


def fused(layers: Sequence[Layer], apart_m: float) -> GridPatch:
    """One map of several on the same cells (H, W): log odds of a cell add up.

    A wall that two maps show up to apart_m from each other is one, where the first of them has it.
    What a robot drove over is free, unless its own map shows something there: before their maps are
    joined, robots take each other for walls.
    Source: Moravec, "Sensor fusion in certainty grids for mobile robots", 1988, for log odds that
    add up.
    """
    odds = [_ODDS[layer.patch.cells.view(np.uint8)] for layer in layers]
    is_known = np.any([layer.patch.cells != UNKNOWN for layer in layers], axis=0)
    for a, b in combinations(range(len(layers)), 2):
        odds[b][_same_walls(layers[a].patch, layers[b].patch, apart_m)] = 0.0
    total = np.sum(odds, axis=0)
    for layer in layers:
        driven = _driven_over(layer)
        is_known |= driven
        total[driven] = np.minimum(total[driven], _FREE)
    percents = np.round(100.0 / (1.0 + np.exp(-total))).astype(np.int8)
    return GridPatch(layers[0].patch.frame, _with_unknown(percents, is_known))


def _with_unknown(percents: NDArray[np.int8], is_known: Mask) -> NDArray[np.int8]:
    return np.where(is_known, percents, np.int8(UNKNOWN))


def _same_walls(a: GridPatch, b: GridPatch, apart_m: float) -> Mask:
    """Cells (H, W) in which two maps differ only in where a wall is that both have."""
    differs = (a.occupied & b.free) | (a.free & b.occupied)
    if not differs.any():
        return differs
    reach = max(apart_m / a.frame.resolution, math.sqrt(2.0))
    for patch in (a, b):
        differs &= distance_cells(patch.occupied) <= reach
    return differs


def _driven_over(layer: Layer) -> Mask:
    """Cells (H, W) over which a robot has driven, and that its own map does not show occupied."""
    patch = layer.patch
    over = np.zeros(patch.shape, dtype=np.bool_)
    if not len(layer.driven):
        return over
    path = _along(layer.driven)
    reach = math.ceil(_FOOTPRINT_M / patch.frame.resolution)
    beside = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
    near = np.unique((patch.frame.cells_of(path)[:, None] + beside).reshape(-1, 2), axis=0)
    near = near[((near >= 0) & (near < patch.shape)).all(axis=1)]
    away, _ = cKDTree(path).query(patch.frame.centres_of(near))
    over[tuple(near[away < _FOOTPRINT_M].T)] = True
    return over & ~patch.occupied


def _along(places: Array) -> Array:
    """Places (M, 2), close together, on the line through places (N, 2)."""
    parts = [places]
    for a, b in pairwise(places):
        length_m = math.dist(a, b)
        if _STEP_M < length_m <= _MAX_STRIDE_M:
            share = np.arange(_STEP_M, length_m, _STEP_M) / length_m
            parts.append(a + share[:, None] * (b - a))
    return np.vstack(parts)
