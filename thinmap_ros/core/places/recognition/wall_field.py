"""Distances to the walls of a map, and what it knows of each cell."""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.places.recognition import field_kernels
from thinmap_ros.core.places.recognition.field_kernels import FAR, FREE, UNKNOWN, WALL, FieldArrays
from thinmap_ros.core.places.views import LATTICE_M, View
from thinmap_ros.core.se2 import Array

REACH_M = 1.0  # larger distances to walls count as this
# Walls farther from all keyframes were seen in part. Where these contradicted views, the right
# place of a real building was refused: views of it have fewer walls there than this map.
_KNOWN_M = 8.0
# Of the loss, m: from candidates to walls, and from there to the place.
_WIDE = np.array([0.6, 0.25])
_NARROW = np.array([0.25, 0.12])
_MAX_POINTS = 120  # of a view, for refinements


class WallField:
    """Wall distances of a map, to refine the poses of views and to compare views with the map."""

    def __init__(self, patch: GridPatch, keyframes_xy: Array) -> None:
        """keyframes_xy (N, 2): where the scans of the map were made; without any, all is known."""
        cell_m = patch.frame.resolution
        pad = round(REACH_M / cell_m) + 2
        padded = patch.padded((pad, pad, pad, pad))
        near = np.minimum(distance_cells(padded.occupied), REACH_M / cell_m)
        others = np.where(padded.free, FREE, UNKNOWN)
        state = np.where(padded.occupied, WALL, others).astype(np.uint8)
        has_room = (state == FREE) & (near * cell_m >= LATTICE_M)
        self._standing = padded.frame.centres_of(np.argwhere(has_room))
        if len(keyframes_xy):
            state[_is_far(padded, keyframes_xy)] = FAR
        self._arrays = FieldArrays(
            near.astype(np.float32),
            state,
            padded.frame.origin_x,
            padded.frame.origin_y,
            cell_m,
            REACH_M / cell_m,
        )

    def random_poses(self, count: int, rng: np.random.Generator) -> Array:
        """Poses (N, 3) where a robot may stand; none if there is no such place."""
        if not len(self._standing):
            return np.empty((0, 3))
        xy = self._standing[rng.integers(len(self._standing), size=count)]
        return np.column_stack([xy, rng.uniform(-np.pi, np.pi, count)])

    def refined_widely(self, view: View, poses: Array) -> tuple[Array, Array]:
        """Poses (N, 3) of a view moved to walls up to half a metre away; how well it fits (N,)."""
        return field_kernels.refine_all(self._arrays, poses, thinned(view.walls), _WIDE)

    def refined(self, view: View, pose: Array) -> tuple[Array, Array, float]:
        """Pose (3,) of a view moved to the nearest walls; information (3, 3); how well it fits."""
        return field_kernels.refine(self._arrays, pose, thinned(view.walls), _NARROW)

    def agreement(self, view: View, T_map_view: Array) -> tuple[float, float]:
        """Share of the walls that the map shows again, of those of which it tells, at a pose (3,).

        And of how many of the walls of the view it tells, as a share.
        """
        matched, contrary, blocked = field_kernels.count_agreement(
            self._arrays, T_map_view, view.walls, view.free, LATTICE_M
        )
        told = matched + contrary + blocked
        return matched / max(told, 1), (matched + contrary) / max(len(view.walls), 1)


def thinned(walls: Array) -> Array:
    """At most _MAX_POINTS of the points (N, 2), evenly."""
    step = -(-len(walls) // _MAX_POINTS)
    return np.ascontiguousarray(walls[:: max(1, step)])


def _is_far(patch: GridPatch, keyframes_xy: Array) -> NDArray[np.bool_]:
    """Which cells (H, W) are farther than _KNOWN_M from all keyframes (N, 2)."""
    cells = patch.frame.cells_of(keyframes_xy)
    inside = np.all((cells >= 0) & (cells < patch.shape), axis=1)
    stands = np.zeros(patch.shape, dtype=np.bool_)
    stands[cells[inside, 0], cells[inside, 1]] = True
    return distance_cells(stands) * patch.frame.resolution > _KNOWN_M
