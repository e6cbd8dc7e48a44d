"""Errors of a map against its world."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.world import World, surfaces
from thinmap_ros.view.plots import MapLayer, Panel, Raster, Segments


@dataclass(frozen=True)
class _Distances:
    """How surfaces are compared with occupied cells, m.

    min_length: of a surface. spacing: of the points on it. found: largest distance of a point that
    is found from an occupied cell. shown: largest error in the colour scale of the picture.
    """

    min_length: float
    spacing: float
    found: float
    shown: float


_METRES = _Distances(min_length=0.2, spacing=0.05, found=0.2, shown=0.3)


@dataclass(frozen=True, eq=False)
class MapError:
    """Distance of each occupied cell centre from the nearest obstacle, m, (H, W), NaN elsewhere.

    found: share of surfaces found.
    """

    off_m: Array
    patch: GridPatch
    found: float

    @property
    def cells_off_m(self) -> Array:
        """Distances of the occupied cells, m, (N,)."""
        return self.off_m[np.isfinite(self.off_m)]


def map_error(patch: GridPatch, world: World) -> MapError:
    """Compare a map with its world, in the same frame.

    A surface point is found if a cell within 0.2 m is occupied.
    """
    off_m = np.full(patch.shape, np.nan)
    cells = np.argwhere(patch.occupied)
    to_solid_m = ndimage.distance_transform_edt(world.occupied == 0) * world.frame.resolution
    at = world.frame.cells_of(patch.frame.centres_of(cells))
    at = np.clip(at, 0, np.array(world.occupied.shape) - 1)
    off_m[cells[:, 0], cells[:, 1]] = to_solid_m[at[:, 0], at[:, 1]]
    points = _points_on(surfaces(world, _METRES.min_length))
    to_cell_m = ndimage.distance_transform_edt(np.pad(~patch.occupied, 1, constant_values=True))[
        1:-1, 1:-1
    ]
    inside = patch.contains(points)
    there = patch.frame.cells_of(points[inside])
    near = to_cell_m[there[:, 0], there[:, 1]] * patch.frame.resolution <= _METRES.found
    return MapError(off_m, patch, float(near.sum() / len(points)))


def panels(error: MapError, world: World) -> list[Panel]:
    """Panels of the world, the map and the error of the map."""
    lines = surfaces(world, 0.1)
    corners = lines.reshape(-1, 2)
    (left, bottom) = corners.min(axis=0) - 0.5
    (right, top) = corners.max(axis=0) + 0.5
    limits = (left, right, bottom, top)
    raster = Raster(error.off_m, error.patch.frame, 'cell off by (m)', (0.0, _METRES.shown))
    return [
        Panel([Segments(lines)], '(a) the world (CAD data)', limits=limits),
        Panel([MapLayer(error.patch)], '(b) grid map', limits=limits),
        Panel([raster], '(c) distance of occupied cells from obstacles', limits=limits),
    ]


def row(name: str, error: MapError) -> list[object]:
    """Name, occupied cells, mean error, 95th percentile, share within a cell.

    Also the share of surfaces found.
    """
    off = error.cells_off_m
    within = float((off <= error.patch.frame.resolution).mean())
    return [name, len(off), float(off.mean()), float(np.percentile(off, 95)), within, error.found]


COLUMNS = [
    'map',
    'occupied_cells',
    'mean_off_m',
    'p95_off_m',
    'share_within_a_cell',
    'surfaces_found',
]


def _points_on(lines: Array) -> Array:
    """Points (N, 2) along segments (M, 4)."""
    parts = []
    for line in lines:
        count = max(2, round(float(np.hypot(*(line[2:] - line[:2]))) / _METRES.spacing))
        parts.append(line[:2] + np.linspace(0.0, 1.0, count)[:, None] * (line[2:] - line[:2]))
    return np.concatenate(parts)
