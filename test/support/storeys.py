"""Maps of storeys of one building: one outline and corridor, other walls between the rooms."""

import numpy as np

from thinmap_ros.core.grid.fields import distance_cells
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.places.piece import MapPiece, drawn_scans
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build

_CELL_M = 0.1
_LENGTH_M = 40.0
_ROOMS_M = (5.6, 4.7)  # depth on either side of the corridor
_CORRIDOR_M = 2.4
_DOOR_M = 1.0
_THICK_CELLS = 1.5


def storey(moved_m=0.0, cupboards=0, seed=0):
    """A storey whose walls between rooms are moved, every other one, by a length in m.

    cupboards: 1.2 m long, as many as are put into rooms, at places by the seed.
    """
    low, high = _ROOMS_M
    width = low + _CORRIDOR_M + high
    cells = np.zeros((_cells(width) + 1, _cells(_LENGTH_M) + 1), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    rng = np.random.default_rng(5)
    for first, depth, row in ((0.0, low, low), (low + _CORRIDOR_M, high, low + _CORRIDOR_M)):
        cells[_cells(row)] = 100
        walls = np.cumsum(rng.uniform(3.2, 5.6, 8))
        for left, right in zip([0.0, *walls], [*walls, _LENGTH_M], strict=True):
            door = _cells(0.5 * (left + right))
            cells[_cells(row), door : door + _cells(_DOOR_M)] = 0
        for k, wall in enumerate(walls[walls < _LENGTH_M - 2.0]):
            x = _cells(wall + (moved_m if k % 2 else 0.0))
            cells[_cells(first) : _cells(first + depth), x] = 100
    places = np.random.default_rng(seed)
    for place in places.choice(18, cupboards, replace=False):
        x = _cells(2.0 * place + 1.0)
        y = _cells(places.choice([1.0, low + _CORRIDOR_M + 2.5]))
        cells[y : y + 4, x : x + 12] = 100
    cells[distance_cells(cells == 0) > _THICK_CELLS] = UNKNOWN
    return GridPatch(GridFrame(0.0, 0.0, _CELL_M), cells)


def piece_of(patch, tag=''):
    """A map as a piece, with its topological map and scans that are drawn from it."""
    graph = build(patch, None, TopologyConfig())
    return MapPiece(drawn_scans(patch, graph), patch, graph, tag=tag)


def _cells(length_m):
    return round(length_m / _CELL_M)
