"""Storage in tiles: it grows with the building, for any shape, without long copies."""

import copy
import mmap
import os
import pickle
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.tiles import TILE, TileStore
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import pose

KILOMETRE = 313  # tiles of 64 cells of 0.05 m
CELL = np.dtype([('hits', np.uint8), ('x', np.float64)])


def line_of_tiles(first, end):
    return np.column_stack([np.zeros(end - first, dtype=np.int64), np.arange(first, end)])


def resident_bytes():
    return int(Path('/proc/self/statm').read_text().split()[1]) * mmap.PAGESIZE


def test_a_cell_of_a_tile_takes_the_memory_of_a_page():
    tiles = TileStore(np.float64)
    before = resident_bytes()
    tiles.grow_to(0, 0, 0, KILOMETRE - 1)
    tiles.allocate(line_of_tiles(0, KILOMETRE))
    tiles.pool[:KILOMETRE, 0, 0] = 1.0
    assert resident_bytes() - before < 4 * KILOMETRE * mmap.PAGESIZE


def test_a_process_with_many_stores_can_fork():
    # Together more than the memory of any machine that runs this.
    stores = [TileStore(np.float64, (6,)) for _ in range(64)]
    child = os.fork()
    if child == 0:
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert len(stores) == 64


def test_the_directory_of_a_corridor_of_a_kilometre_grows_a_few_times():
    tiles = TileStore()
    grown = 0
    for col in range(KILOMETRE):
        before = tiles.directory.shape
        tiles.grow_to(0, col, 0, col)
        grown += tiles.directory.shape != before
    rows, cols = tiles.directory.shape
    assert rows == 1 and cols >= KILOMETRE
    assert grown < 20


def test_only_a_side_that_grew_gets_room_to_spare():
    tiles = TileStore()
    tiles.grow_to(0, 0, 0, 100)
    assert (tiles.first_row, tiles.first_col) == (0, 0)
    tiles.grow_to(-1, 0, 0, 0)
    assert tiles.first_row < -1
    assert tiles.first_row + tiles.directory.shape[0] == 1
    assert tiles.first_col == 0


def test_the_directory_may_take_all_the_tiles_that_there_can_be():
    tiles = TileStore()
    tiles.grow_to(0, 0, 180, 180)
    before = tiles.directory.shape
    with pytest.raises(InputError, match='tiles: expected'):
        tiles.grow_to(0, 0, 181, 181)
    assert tiles.directory.shape == before


def test_room_that_was_never_used_is_given_up_before_a_map_is_too_large():
    tiles = TileStore()
    for col in range(0, 250, 10):
        tiles.write(0, col * TILE, np.ones((1, 1), dtype=np.int16))
    assert tiles.directory.shape[1] > 250
    tiles.grow_to(0, 0, 130, 240)
    assert tiles.directory.shape == (131, 241)
    with pytest.raises(InputError, match='tiles: expected'):
        tiles.grow_to(0, 0, 137, 240)
    assert (tiles.read(0, 0, 1, 241 * TILE)[0, :: 10 * TILE] == 1).all()


def test_tiles_stay_where_they_are_when_the_directory_grows():
    tiles = TileStore()
    cells = np.arange(TILE * TILE, dtype=np.int16).reshape(TILE, TILE)
    tiles.write(-TILE, 5 * TILE, cells)
    for row, col in [(-9, 5), (7, 5), (0, -12), (0, 40)]:
        tiles.grow_to(row, col, row, col)
        np.testing.assert_array_equal(tiles.read(-TILE, 5 * TILE, TILE, TILE), cells)


@pytest.mark.parametrize('first, step', [(0, 40.0), (980, -40.0)])
def test_a_corridor_of_a_kilometre_in_cells_of_5_cm_is_mapped(first, step):
    grid = OccupancyGrid(OccupancyConfig(resolution_m=0.05))
    bearings = np.radians(np.arange(-90, 91))
    ranges = np.minimum(1.2 / np.maximum(np.abs(np.sin(bearings)), 1e-9), 29.0)
    scan = Scan.create(0, ranges, bearings[0], np.radians(1.0), 0.05, 30.0)
    for k in range(26):
        grid.add_scan(scan, pose(first + step * k, 0.02, 0.0))
    patch = grid.known_area()
    assert patch.shape[1] > 1000.0 / 0.05
    middle = patch.frame.cells_of(np.array([[0.5, 0.02], [1000.5, 0.02]]))
    assert (patch.cells[tuple(middle.T)] == 35).all()


@pytest.mark.skipif(
    resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY,
    reason='the address space is limited here',
)
def test_the_pool_is_not_copied_and_takes_memory_where_it_is_written():
    tiles = TileStore(CELL)
    tiles.grow_to(0, 0, 0, 5000)
    pool = tiles.pool
    before = resident_bytes()
    tiles.allocate(line_of_tiles(0, 4000))
    assert tiles.pool is pool
    tile_bytes = pool[0].nbytes
    assert resident_bytes() - before < 200 * tile_bytes
    pool[:1000]['hits'] = 1
    assert 900 * tile_bytes < resident_bytes() - before < 1500 * tile_bytes


def test_a_field_of_cells_is_set_where_tiles_exist():
    tiles = TileStore(CELL, max_tiles=2)
    tiles.grow_to(0, 0, 1, 1)
    tiles.allocate(np.array([[0, 0], [1, 1]]))
    hits = np.arange(1, 101, dtype=np.uint8).reshape(10, 10)
    tiles.overwrite(TILE - 5, TILE - 5, hits, 'hits')
    found = tiles.read(TILE - 5, TILE - 5, 10, 10)
    hits[:5, 5:] = 0
    hits[5:, :5] = 0
    np.testing.assert_array_equal(found['hits'], hits)
    assert not found['x'].any()
    with pytest.raises(InputError, match='map of 3 tiles: expected 2 at most'):
        tiles.allocate(np.array([[0, 1]]))


LIMITED = """
import resource
from pathlib import Path
import numpy as np
from thinmap_ros.core.grid.tiles import TileStore

now = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (now + 2**28, resource.RLIM_INFINITY))
tiles = TileStore(np.int64)
tiles.grow_to(0, 0, 0, 2000)
for col in range(2000):
    tiles.allocate(np.array([[0, col]]))
    tiles.pool[col] = col
assert (tiles.pool[:2000, 7, 7] == np.arange(2000)).all()
"""


@pytest.mark.programs
def test_where_the_address_space_is_limited_the_pool_grows_by_copies():
    """A pool for the largest map would take 1 GB: four times the available memory."""
    done = subprocess.run([sys.executable, '-c', LIMITED], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize('copied', [copy.deepcopy, lambda tiles: pickle.loads(pickle.dumps(tiles))])
def test_copies_hold_the_tiles_and_not_the_room(copied):
    tiles = TileStore()
    tiles.write(3, -70, np.full((200, 100), 5, dtype=np.int16))
    other = copied(tiles)
    assert len(other.pool) == tiles.used
    other.write(0, 500, np.full((10, 10), 7, dtype=np.int16))
    other.write(3, -70, np.full((1, 1), 6, dtype=np.int16))
    np.testing.assert_array_equal(tiles.read(3, -70, 200, 100), 5)
    assert other.read(3, -70, 2, 1).ravel().tolist() == [6, 5]
    assert not tiles.read(0, 500, 10, 10).any() and (other.read(0, 500, 10, 10) == 7).all()


def test_a_map_that_does_not_begin_at_the_origin_takes_room_only_for_what_it_holds():
    tiles = TileStore(begins_at_origin=False)
    tiles.write(50_000 * TILE, -70_000 * TILE, np.ones((1, 1), dtype=np.int16))
    assert tiles.directory.shape == (1, 1)
    assert tiles.bounds() == (50_000 * TILE, -70_000 * TILE, 50_001 * TILE, -69_999 * TILE)
    with pytest.raises(InputError, match='tiles: expected'):
        tiles.write(0, 0, np.ones((1, 1), dtype=np.int16))
    with pytest.raises(InputError, match='tiles from its origin'):
        TileStore(begins_at_origin=False).grow_to(1 << 40, 0, 1 << 40, 0)


def test_a_wide_map_may_be_mostly_empty():
    tiles = TileStore(max_extent_tiles=1_000_000)
    tiles.write(0, 0, np.ones((1, 1), dtype=np.int16))
    tiles.write(900 * TILE, 900 * TILE, np.ones((1, 1), dtype=np.int16))
    assert tiles.used == 2
    with pytest.raises(InputError, match='1001 x 1001 tiles: expected 1000000 at most'):
        tiles.grow_to(1000, 1000, 1000, 1000)
    with pytest.raises(InputError, match='32769 tiles: expected 32768 at most'):
        tiles.allocate(np.argwhere(np.ones((181, 182)))[: 1 << 15])
    assert tiles.used == 2
