"""Coordinates beyond the bounds are rejected before anything is written: no kernel gets them."""

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyGrid
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.grid.shared import MapReceiver
from thinmap_ros.core.grid.tiles import TILE
from thinmap_ros.core.odometry import OdometryBuffer
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.slam.matching.local_map import LocalMap


def scan_of(ranges, mount=(0.0, 0.0, 0.0)):
    return Scan.create(0, ranges, -1.5, 0.05, 0.05, 30.0, np.array(mount))


SEEN = scan_of(np.full(61, 20.0))


class Guarded:
    """The buffer into which a scan is rendered, between guard areas of known content."""

    def __init__(self, grid):
        grid.add_scan(SEEN, np.zeros(3))
        rows, cols = grid._increments.shape
        self.memory = np.zeros((3 * rows, cols), dtype=np.int16)
        grid._increments = self.memory[rows : 2 * rows]
        self.around = (self.memory[:rows], self.memory[2 * rows :])

    def is_untouched(self):
        return not any(part.any() for part in self.around)


@pytest.mark.parametrize('far', [1e7, 1e15, 1e18, -1e18, 1e20, 1e300])
@pytest.mark.parametrize('axis', [0, 1])
def test_a_pose_far_away_is_rejected_before_anything_is_rendered(far, axis):
    grid = OccupancyGrid(PAPER_GRID)
    guard = Guarded(grid)
    before = grid.known_area()
    pose = np.zeros(3)
    pose[axis] = far
    with pytest.raises(InputError, match='too far'):
        grid.add_scan(SEEN, pose)
    assert guard.is_untouched()
    assert not grid._increments.any(), 'nothing is left over for the next scan'
    np.testing.assert_array_equal(grid.known_area().cells, before.cells)


def test_a_map_that_would_get_too_large_keeps_nothing_of_the_scan():
    grid = OccupancyGrid(PAPER_GRID)
    grid.add_scan(SEEN, np.zeros(3))
    before = grid.state()
    with pytest.raises(InputError, match='tiles'):
        grid.add_scan(SEEN, np.array([5e4, 5e4, 0.0]))
    assert not grid._increments.any()
    np.testing.assert_array_equal(grid.state()['log_odds'], before['log_odds'])


@pytest.mark.parametrize(
    'name, value',
    [
        ('frame', np.array([0.0, -1e300, 0.1])),
        ('frame', np.array([np.nan, 0.0, 0.1])),
        ('frame', np.array([0.0, 0.0, 1e-300])),
        ('tiles', np.array([[2**62, 0]])),
        ('tiles', np.array([[0, -(2**63)]])),
    ],
)
def test_a_saved_grid_from_nowhere_is_refused(name, value):
    state = OccupancyGrid.from_patch(GridPatch(GridFrame(0.0, 0.0, 0.1), np.zeros((4, 4), np.int8)))
    with pytest.raises(InputError):
        OccupancyGrid.from_state({**state.state(), name: value})


@pytest.mark.parametrize('mount', [(1e20, 0.0, 0.0), (0.0, 101.0, 0.0), (np.nan, 0.0, 0.0)])
def test_a_laser_mounted_nowhere_is_refused(mount):
    with pytest.raises(InputError, match='mounted'):
        scan_of(np.ones(61), mount)


@pytest.mark.parametrize('x', [1e7, 1.7e308, np.nan, -np.inf])
def test_odometry_from_nowhere_is_refused(x):
    with pytest.raises(InputError, match='odometry'):
        OdometryBuffer().add(0, np.array([x, 0.0, 0.0]))


@pytest.mark.parametrize('far', [1e7, -1e7, 1e15])
def test_points_from_nowhere_are_refused(far):
    local_map = seen_map()
    before = {name: array.copy() for name, array in local_map.state().items()}
    points = np.array([[1.0, 1.0], [far, 1.0]])
    with pytest.raises(InputError, match='tiles'):
        local_map.add_scan(on_a_wall(points), np.zeros(3), np.zeros(3))
    with pytest.raises(InputError, match='tiles'):
        local_map.add_walls(points, np.array([1.0, 0.0]))
    for name, array in local_map.state().items():
        np.testing.assert_array_equal(array, before[name])


@pytest.mark.parametrize('far', [2**62, -(2**62), 2**30])
def test_a_saved_local_map_from_nowhere_is_refused(far):
    state = seen_map().state()
    tiles = state['tiles'].copy()
    tiles[0, 0] = far
    with pytest.raises(InputError, match='tiles'):
        LocalMap().restore({**state, 'tiles': tiles})


def seen_map():
    local_map = LocalMap()
    local_map.add_scan(on_a_wall([[1.0, 1.0], [1.02, 1.0]]), np.zeros(3), np.zeros(3))
    return local_map


def on_a_wall(points):
    """Surface points (N, 5) with one normal."""
    return np.array([[*point, 1.0, 0.0, 0.05] for point in points])


def test_windows_that_wander_off_do_not_grow_a_map_without_end():
    receiver = MapReceiver()
    window = np.zeros((8 * TILE, 8 * TILE), dtype=np.int8)

    def wander():
        for step in range(200):
            receiver.paste(GridPatch(GridFrame(51.2 * step, 51.2 * step, 0.1), window))

    with pytest.raises(InputError, match='at most'):
        wander()
