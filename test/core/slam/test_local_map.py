"""The local map: its counts, its distances, and how it follows walls that vanish."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt
from slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.tiles import TILE
from thinmap_ros.core.slam.local_map import HERE, LocalMap, LocalMapConfig

CELL_M = LocalMapConfig().match_cell_m
REACH = round(LocalMapConfig().match_reach_m / CELL_M)
BOX = ROOM[6:]
WITHOUT_BOX = ROOM[:6]
# In sight of the box from all sides.
AROUND_BOX = [
    np.array([x, y, math.atan2(2.5 - y, 7.5 - x)])
    for x, y in [(5.0, 1.0), (6.0, 4.0), (9.2, 4.0), (9.0, 1.0), (7.4, 4.2), (5.2, 2.6)]
]


def add_scan(local_map, segments, pose, rng=None):
    scan = scan_in(segments, pose, rng)
    local_map.add_scan(scan.points_base(), scan.T_base_laser, pose)


def random_pose(rng):
    return np.array([*rng.uniform(1.0, 9.0, 2), rng.uniform(-np.pi, np.pi)])


def cells_of(local_map):
    """All cells (R, C) of the rectangle of tiles, and the first row and column."""
    top, left, end_row, end_col = local_map.tiles.bounds()
    return local_map.tiles.read(top, left, end_row - top, end_col - left), top, left


def walls_of(cells):
    return cells['hits'] > LocalMapConfig().match_wall_share * cells['seen']


def told(cells):
    """Distance of each cell from the wall that it leads to, in cells; inf where it leads to none.

    Every cell that is led to has to be a wall.
    """
    down = cells['to_row'].astype(int) - HERE
    right = cells['to_col'].astype(int) - HERE
    leads = cells['to_row'] > 0
    rows, cols = np.nonzero(leads)
    assert walls_of(cells)[rows + down[leads], cols + right[leads]].all()
    return np.where(leads, np.hypot(down, right), np.inf)


def nearest(cells):
    """The plain reference: distance of each cell from the nearest wall, inf beyond the reach."""
    away = distance_transform_edt(~walls_of(cells))
    return np.where(away <= REACH, away, np.inf)


def test_each_cell_knows_its_nearest_wall(rng):
    local_map = LocalMap()
    for k in range(12):
        add_scan(local_map, ROOM, random_pose(rng), rng)
        if k % 4 == 0:
            cells, *_ = cells_of(local_map)
            assert walls_of(cells).any()
            np.testing.assert_array_equal(told(cells), nearest(cells))


def test_walls_that_vanish_are_forgotten(rng):
    """A box is taken away; what was nearest to it is nearest to something else, or to nothing."""
    local_map = LocalMap()
    for pose in AROUND_BOX:
        add_scan(local_map, ROOM, pose, rng)
    faces = np.array([[7.0, 2.5], [7.5, 3.0], [8.0, 2.6]])
    assert (local_map.distances(faces) < CELL_M).all()
    for _ in range(5):
        for pose in AROUND_BOX:
            add_scan(local_map, WITHOUT_BOX, pose, rng)
    cells, *_ = cells_of(local_map)
    np.testing.assert_allclose(told(cells), nearest(cells), atol=0.1)
    np.testing.assert_array_equal(local_map.distances(faces), CELL_M * REACH)


# Few cells, crowded: walls come and go beside each other.
@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1))
def test_distances_follow_walls_that_come_and_go(seed):
    rng = np.random.default_rng(seed)
    local_map = LocalMap()
    for _ in range(int(rng.integers(1, 12))):
        laser = rng.uniform(-1.0, 1.0, 2)
        local_map.add(laser + rng.uniform(-1.5, 1.5, (int(rng.integers(1, 60)), 2)), laser)
    cells, *_ = cells_of(local_map)
    truth, found = nearest(cells), told(cells)
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(truth))
    near = np.isfinite(truth)
    # What a neighbour tells may be a little farther than the nearest wall, rarely.
    assert (found[near] >= truth[near]).all()
    assert (found[near] - truth[near]).max(initial=0.0) < 0.3
    assert np.mean(found[near] != truth[near]) < 0.01


def test_a_cell_keeps_the_mean_of_its_hits(rng):
    points = np.array([2.0, -1.0]) + rng.uniform(0.0, CELL_M, (40, 2)) * 0.999
    local_map = LocalMap()
    local_map.add(points, np.zeros(2))
    cells, top, left = cells_of(local_map)
    cell = cells[round(-1.0 / CELL_M) - top, round(2.0 / CELL_M) - left]
    assert cell['hits'] == cell['seen'] == 40
    mean = (points.mean(axis=0) - [2.0, -1.0]) / CELL_M - 0.5
    np.testing.assert_allclose([cell['x'], cell['y']], mean, atol=1e-5)


def test_hits_and_looks_through_are_counted():
    local_map = LocalMap()
    local_map.add(np.array([[0.525, 0.025]]), np.array([0.025, 0.025]))
    cells, top, left = cells_of(local_map)
    row = cells[-top]
    assert row['hits'][-left : 11 - left].tolist() == [0] * 10 + [1]
    assert row['seen'][-left : 11 - left].tolist() == [1] * 11
    assert cells['seen'].sum() == 11


def test_counts_forget_and_do_not_run_over():
    local_map = LocalMap()
    laser, point = np.array([0.025, 0.025]), np.array([[1.025, 0.025]])
    for _ in range(600):
        local_map.add(point, laser)
    cells, *_ = cells_of(local_map)
    assert cells['seen'].max() <= 255
    assert (cells['hits'] <= cells['seen']).all()
    assert local_map.distances(point)[0] < 0.03
    beyond = np.array([[2.025, 0.025]])
    looks = 0
    while local_map.distances(point)[0] < 0.1:
        local_map.add(beyond, laser)
        looks += 1
    assert looks < 600, 'seen 600 times, forgotten sooner'


@pytest.mark.parametrize('wall_m', [1.003, 1.013, 1.025, 1.041])
def test_distances_from_a_wall_are_finer_than_a_cell(wall_m):
    along = np.arange(-2.0, 2.0, 0.01) + 0.005
    local_map = LocalMap()
    local_map.add(np.column_stack([along, np.full(len(along), wall_m)]), np.zeros(2))
    x, away = np.meshgrid(np.linspace(-1.0, 1.0, 41), np.linspace(0.06, 0.4, 18))
    for side in (-1.0, 1.0):
        points = np.column_stack([x.ravel(), wall_m + side * away.ravel()])
        np.testing.assert_allclose(local_map.distances(points), away.ravel(), atol=1e-3)


@pytest.mark.parametrize('angle', np.linspace(0.1, 1.4, 6))
def test_distances_from_a_slanted_noisy_wall(rng, angle):
    normal = np.array([math.cos(angle), math.sin(angle)])
    tangent = np.array([-normal[1], normal[0]])
    along = rng.uniform(-2.0, 2.0, 4000)
    local_map = LocalMap()
    local_map.add(
        2.0 * normal + along[:, None] * tangent + rng.normal(0.0, 0.005, (4000, 1)) * normal,
        np.zeros(2),
    )
    away = rng.uniform(0.1, 0.4, 300)
    points = (2.0 - away)[:, None] * normal + rng.uniform(-1.0, 1.0, (300, 1)) * tangent
    off = local_map.distances(points) - away
    assert np.sqrt(np.mean(off**2)) < 0.01


def test_a_state_is_restored(rng):
    local_map, again = LocalMap(), LocalMap()
    for pose in AROUND_BOX:
        add_scan(local_map, ROOM, pose - [8.0, 20.0, 0.0], rng)
        add_scan(local_map, ROOM, pose, rng)
    again.restore(local_map.state())
    for name, array in local_map.state().items():
        np.testing.assert_array_equal(again.state()[name], array)
    # Of walls that are equally near it may be another one that a cell leads to.
    for each in (local_map, again):
        cells, *_ = cells_of(each)
        np.testing.assert_array_equal(told(cells), nearest(cells))
    # Both go on alike.
    for each in (local_map, again):
        add_scan(each, ROOM, np.array([4.0, 7.0, 0.5]))
    np.testing.assert_array_equal(again.state()['hits'], local_map.state()['hits'])


def test_an_empty_state_is_restored():
    again = LocalMap()
    again.restore(LocalMap().state())
    assert again.is_empty


def test_cells_of_another_size_are_refused(rng):
    other = LocalMap(LocalMapConfig(match_cell_m=0.1))
    add_scan(other, ROOM, AROUND_BOX[0], rng)
    with pytest.raises(InputError, match=r'cells of 0\.1 m.*expected 0\.05 m'):
        LocalMap().restore(other.state())


def test_a_tile_that_is_there_twice_is_refused(rng):
    local_map = LocalMap()
    add_scan(local_map, ROOM, AROUND_BOX[0], rng)
    state = {
        name: array if array.ndim == 0 else np.concatenate([array[:1], array[:1]])
        for name, array in local_map.state().items()
    }
    with pytest.raises(InputError, match='twice'):
        LocalMap().restore(state)


def test_walls_of_an_occupancy_map_are_added():
    """Each cell once, however many points lie in it, and nothing is seen through."""
    points = np.column_stack([np.arange(0.0, 3.0, 0.01), np.full(300, 2.02)])
    local_map = LocalMap()
    local_map.add_walls(points)
    cells, *_ = cells_of(local_map)
    assert cells['hits'].sum() == cells['seen'].sum() == 60
    np.testing.assert_array_equal(told(cells), nearest(cells))
    assert (local_map.distances(points[50:-50]) < CELL_M).all()
    local_map.add_walls(np.empty((0, 2)))
    assert cells_of(local_map)[0]['seen'].sum() == 60


def test_a_corridor_of_a_kilometre_is_mapped():
    local_map = LocalMap()
    for x in range(0, 1001, 20):
        walls = [[x - 15.0, 1.2, x + 15.0, 1.2], [x - 15.0, -1.2, x + 15.0, -1.2]]
        add_scan(local_map, np.array(walls), se2.pose(float(x), 0.0, 0.0))
    off = local_map.distances(np.array([[1.0, 1.3], [501.0, 1.3], [1001.0, 1.3]]))
    np.testing.assert_allclose(off, 0.1, atol=0.03)


def test_an_empty_scan_changes_nothing(rng):
    local_map = LocalMap()
    local_map.add(np.empty((0, 2)), np.zeros(2))
    local_map.add_walls(np.empty((0, 2)))
    assert local_map.is_empty
    add_scan(local_map, ROOM, AROUND_BOX[0], rng)
    before = {name: array.copy() for name, array in local_map.state().items()}
    local_map.add(np.empty((0, 2)), np.array([1e3, 1e3]))
    for name, array in local_map.state().items():
        np.testing.assert_array_equal(array, before[name])


def test_far_from_all_tiles_there_is_no_wall(rng):
    far = np.array([[1e4, -1e4], [-500.0, 3.0], [5.0, 1e6]])
    local_map = LocalMap()
    np.testing.assert_array_equal(local_map.distances(far), CELL_M * REACH)
    add_scan(local_map, ROOM, AROUND_BOX[0], rng)
    np.testing.assert_array_equal(local_map.distances(far), CELL_M * REACH)
    assert local_map.distances(np.empty((0, 2))).shape == (0,)


@pytest.mark.parametrize('corner', [(0, 0), (-1, -1), (3, -2)])
def test_walls_at_the_rim_of_a_tile_are_known_in_the_next(corner):
    """One point in each corner cell of a tile, looked at from its middle."""
    edge_m = TILE * CELL_M
    low = edge_m * np.array(corner)
    inside = np.array([[0.02, 0.02], [0.02, -0.02], [-0.02, 0.02], [-0.02, -0.02]])
    points = low + inside % edge_m
    local_map = LocalMap()
    local_map.add(points, low + 0.5 * edge_m)
    cells, *_ = cells_of(local_map)
    np.testing.assert_array_equal(told(cells), nearest(cells))
    outwards = np.sign(points - low - 0.5 * edge_m) * [0.2, 0.2]
    expected = np.hypot(0.2, 0.2)
    np.testing.assert_allclose(local_map.distances(points + outwards), expected, atol=0.015)


def test_a_scan_is_put_where_the_robot_is(rng):
    T_base_laser = np.array([0.2, -0.1, 0.3])
    pose = np.array([3.0, 2.0, 1.0])
    scan = scan_in(ROOM, pose, T_base_laser=T_base_laser)
    local_map, by_hand = LocalMap(), LocalMap()
    local_map.add_scan(scan.points_base(), scan.T_base_laser, pose)
    laser = se2.compose(pose, T_base_laser)[:2]
    by_hand.add(se2.transform_points(pose, scan.points_base()), laser)
    np.testing.assert_array_equal(local_map.state()['seen'], by_hand.state()['seen'])
    on_wall = se2.transform_points(pose, scan.points_base())
    assert local_map.distances(on_wall).max() < 1.5 * CELL_M
