"""The map as tiles: a page receives those in which cells have changed."""

import base64
import zlib
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.web.board import Board

_SIDE = 128  # cells
_UNKNOWN = 0
_FREE = 1
_OCCUPIED = 2
_LEVEL = 1  # of compression: the fastest
Classes = NDArray[np.uint8]


class MapTiles:
    """Puts the tiles of a map on a board.

    Tiles lie on the lattice of the cells whatever the origin of the map, which moves as it grows.
    """

    def __init__(self, board: Board) -> None:
        self._board = board
        self._lattice: tuple[float, float, float] | None = None
        self._generation = 0
        self._tiles: dict[tuple[int, int], bytes] = {}

    def show(self, patch: GridPatch) -> None:
        """Show a map: tiles that it no longer has, or another lattice, begin a new map."""
        row, col, lattice = _place(patch.frame)
        tiles = dict(_tiles(_classes(patch), row, col))
        if lattice != self._lattice or self._tiles.keys() - tiles.keys():
            self._lattice = lattice
            self._generation += 1
            self._tiles = {}
            self._board.keep('tile/', set())
            self._board.put('map', self._head(lattice))
        for place, classes in tiles.items():
            content = classes.tobytes()
            if self._tiles.get(place) != content:
                self._tiles[place] = content
                packed = base64.b64encode(zlib.compress(content, _LEVEL)).decode()
                self._board.put(f'tile/{place[0]}/{place[1]}', packed)

    def _head(self, lattice: tuple[float, float, float]) -> dict[str, float]:
        resolution, x, y = lattice
        return {
            'generation': self._generation,
            'resolution': resolution,
            'x': x,
            'y': y,
            'side': _SIDE,
        }


def _place(frame: GridFrame) -> tuple[int, int, tuple[float, float, float]]:
    """Row and column of cell (0, 0) on the lattice, and resolution and origin of that lattice."""
    resolution = frame.resolution
    col = round(frame.origin_x / resolution)
    row = round(frame.origin_y / resolution)
    x = round(frame.origin_x - col * resolution, 4)
    y = round(frame.origin_y - row * resolution, 4)
    return row, col, (resolution, x, y)


def _classes(patch: GridPatch) -> Classes:
    classes = np.full(patch.shape, _UNKNOWN, dtype=np.uint8)
    classes[patch.free] = _FREE
    classes[patch.occupied] = _OCCUPIED
    return classes


def _tiles(classes: Classes, row: int, col: int) -> Iterator[tuple[tuple[int, int], Classes]]:
    """Tiles that hold known cells, by their row and column among the tiles."""
    rows, cols = classes.shape
    for tile_row in range(row // _SIDE, -(-(row + rows) // _SIDE)):
        for tile_col in range(col // _SIDE, -(-(col + cols) // _SIDE)):
            first_row = tile_row * _SIDE - row
            first_col = tile_col * _SIDE - col
            part = classes[
                max(first_row, 0) : max(first_row + _SIDE, 0),
                max(first_col, 0) : max(first_col + _SIDE, 0),
            ]
            if not part.any():
                continue
            tile = np.full((_SIDE, _SIDE), _UNKNOWN, dtype=np.uint8)
            at_row = max(-first_row, 0)
            at_col = max(-first_col, 0)
            tile[at_row : at_row + part.shape[0], at_col : at_col + part.shape[1]] = part
            yield (tile_row, tile_col), tile
