"""Tiles show the cells of the map, and only changed ones are sent."""

import base64
import json
import zlib

import numpy as np
import pytest

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.web.pages import Board
from thinmap_ros.web.picture import MapTiles

SIDE = 128


class Page:
    """What a page makes of the items."""

    def __init__(self, board):
        self.board = board
        self.change = 0
        self.head = None
        self.tiles = {}
        self.received = []

    def update(self):
        self.change, text = self.board.since(self.change)
        self.received = [name for name, _ in json.loads(text or '[]')]
        for name, value in json.loads(text or '[]'):
            if name == 'map':
                self.head = value
                self.tiles = {}
            else:
                place = tuple(int(number) for number in name.split('/')[1:])
                cells = zlib.decompress(base64.b64decode(value))
                self.tiles[place] = np.frombuffer(cells, dtype=np.uint8).reshape(SIDE, SIDE)

    def at(self, x, y):
        """Class of the cell at a point, m."""
        head = self.head
        col = int(np.floor((x - head['x']) / head['resolution'] + 1e-9))
        row = int(np.floor((y - head['y']) / head['resolution'] + 1e-9))
        tile = self.tiles.get((row // SIDE, col // SIDE))
        return 0 if tile is None else int(tile[row % SIDE, col % SIDE])


def random_map(rows, cols, x, y, seed=1):
    cells = np.random.default_rng(seed).choice(
        np.array([-1, 0, 50, 100], dtype=np.int8), (rows, cols)
    )
    return GridPatch(GridFrame(x, y, 0.05), cells)


@pytest.mark.parametrize('origin', [(0.0, 0.0), (-3.55, -9.95), (6.4, -6.4), (0.012, -0.031)])
def test_each_cell_is_where_it_is_in_the_map(origin):
    patch = random_map(150, 280, *origin)
    board = Board()
    MapTiles(board).show(patch)
    page = Page(board)
    page.update()
    expected = np.select([patch.free, patch.occupied], [1, 2], 0)
    for row in range(0, 150, 7):
        for col in range(0, 280, 11):
            x, y = patch.frame.centres_of(np.array([[row, col]]))[0]
            assert page.at(x, y) == expected[row, col]


def test_a_map_that_grows_sends_the_tiles_that_changed_alone():
    board = Board()
    tiles = MapTiles(board)
    page = Page(board)
    patch = random_map(300, 300, 0.0, 0.0)
    tiles.show(patch)
    page.update()
    assert len(page.received) == 1 + 9
    grown = patch.padded((128, 0, 0, 0))
    cells = grown.cells.copy()
    cells[128 + 5, 5] = 100 if cells[128 + 5, 5] != 100 else 0
    cells[0, 0] = 0
    grown = GridPatch(grown.frame, cells)
    tiles.show(grown)
    page.update()
    assert set(page.received) == {'tile/0/0', 'tile/-1/0'}
    tiles.show(grown)
    page.update()
    assert page.received == []


@pytest.mark.parametrize(
    'other',
    [
        GridPatch(GridFrame(0.0, 0.0, 0.05), np.full((20, 20), -1, dtype=np.int8)),
        GridPatch(GridFrame(0.02, 0.0, 0.05), np.zeros((20, 20), dtype=np.int8)),
        GridPatch(GridFrame(0.0, 0.0, 0.1), np.zeros((20, 20), dtype=np.int8)),
    ],
    ids=['forgotten', 'another lattice', 'another resolution'],
)
def test_another_map_replaces_the_tiles_of_the_one_before(other):
    board = Board()
    tiles = MapTiles(board)
    page = Page(board)
    tiles.show(GridPatch(GridFrame(0.0, 0.0, 0.05), np.zeros((20, 20), dtype=np.int8)))
    page.update()
    before = page.head['generation']
    tiles.show(other)
    page.update()
    assert page.head['generation'] == before + 1
    late = Page(board)
    late.update()
    assert late.tiles.keys() == page.tiles.keys()
