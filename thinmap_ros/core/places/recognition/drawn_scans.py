"""Scans drawn from a grid along its topological map, for a map without keyframes."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.places.recognition.piece import MapPiece
from thinmap_ros.core.scan import NO_RETURN_CLEAR_RANGE_M, Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import Edge, TopologicalMap

_BEAMS = 360
_SPACING_M = 0.7  # of path, as of keyframes
_INSIDE = 1e-6  # of a cell: a ray ends on the edge of the cell that it enters


@dataclass(frozen=True, eq=False)
class DrawnScan:
    """A scan that is drawn from a map: points (N, 2) on walls, robot frame, and its pose (3,)."""

    scan: Scan
    points: Array
    T_map_base: Array


def drawn_piece(patch: GridPatch, graph: TopologicalMap) -> MapPiece:
    """Piece of a bare map: grid, topological map, and the scans drawn along this."""
    return MapPiece(drawn_scans(patch, graph), patch, graph)


def drawn_scans(patch: GridPatch, graph: TopologicalMap) -> list[DrawnScan]:
    """Scans along the edges of a topological map, as a laser with a range of 8 m makes them.

    Beams into unknown cells are invalid.
    """
    margin = patch.padded((1, 1, 1, 1))
    obstacles = (~margin.free).astype(np.uint8)
    places = [place for path in _walk(graph) for place in _spaced(path)]
    return [_drawn(margin, obstacles, k, x, y) for k, (x, y) in enumerate(places)]


def _drawn(
    patch: GridPatch, obstacles: NDArray[np.uint8], number: int, x: float, y: float
) -> DrawnScan:
    """Scan at a place; obstacles (H, W): what is not free."""
    cell_m = patch.frame.resolution
    angles = 2.0 * math.pi * (np.arange(_BEAMS, dtype=np.float64) / _BEAMS - 0.5)
    x_cell, y_cell = patch.frame.in_cells(np.array([[x, y]]))[0].tolist()
    cells = cast_rays(obstacles, x_cell, y_cell, angles, NO_RETURN_CLEAR_RANGE_M / cell_m)
    ends = np.isfinite(cells)
    reach = cells[ends] + _INSIDE
    cols = np.floor(x_cell + reach * np.cos(angles[ends])).astype(np.int64)
    rows = np.floor(y_cell + reach * np.sin(angles[ends])).astype(np.int64)
    ranges = cells * cell_m
    ranges[ends] = np.where(patch.occupied[rows, cols], ranges[ends], np.nan)
    scan = Scan.create(
        number, ranges, -math.pi, 2.0 * math.pi / _BEAMS, 0.0, NO_RETURN_CLEAR_RANGE_M
    )
    return DrawnScan(scan, scan.points_base(), np.array([x, y, 0.0]))


def _spaced(path: Array) -> Array:
    """Points (N, 2) along a path (K, 2), a spacing apart."""
    steps = np.hypot(*np.diff(path, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.arange(0.0, along[-1] + 1e-9, _SPACING_M)
    return np.column_stack([np.interp(at, along, path[:, i]) for i in (0, 1)])


def _walk(graph: TopologicalMap) -> Iterator[Array]:
    """Paths of all edges; each begins where the last one ends, where that is possible."""
    left: dict[int, Edge] = dict(sorted(graph.edges.items()))
    here: int | None = None
    while left:
        ahead = [edge for edge in graph.edges_at(here) if edge.id in left] if here else []
        edge = ahead[0] if ahead else next(iter(left.values()))
        del left[edge.id]
        start = here if ahead and here else edge.a
        yield edge.path_from(start)
        here = edge.other(start)
